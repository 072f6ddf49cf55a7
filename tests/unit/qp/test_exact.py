from itertools import combinations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from vibench import VariationalInequality, solve_qp
from vibench.qp import kkt_residuals
from vibench.qp.exact import exact_solution, rows_that_matter
from vibench.qp.scaling import size


def program(seed: int, n: int, m: int, scale: float = 1.0) -> VariationalInequality:
    """A feasible program with a stiffness of moderate condition, its load of a given size."""
    rng = np.random.default_rng(seed)
    M = rng.standard_normal((n, n))
    B = rng.standard_normal((m, n))
    g = B @ rng.standard_normal(n) + rng.random(m)
    return VariationalInequality(M @ M.T + 1e-2 * np.eye(n), scale * rng.standard_normal(n), B, g)


@given(st.integers(0, 10_000), st.integers(1, 15), st.integers(0, 20), st.sampled_from([1e-6, 1.0, 1e6]))
def test_solutions_satisfy_the_kkt_conditions_to_round_off(seed: int, n: int, m: int, scale: float) -> None:
    vi = program(seed, n, m, scale)
    found = exact_solution(vi)
    assert np.all(found.alpha >= 0.0)
    residuals = kkt_residuals(vi, found.x, found.alpha)
    assert max(residuals.dual, residuals.gap) <= 1e-12
    assert np.all(vi.B @ found.x - vi.g <= 1e-12 * (np.abs(vi.B) @ np.abs(found.x) + np.abs(vi.g)))
    assert np.all((found.alpha == 0.0) | (np.abs(vi.B @ found.x - vi.g) <= 1e-10 * (1.0 + size(found.x))))


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(0, 5))
def test_it_is_the_best_of_all_active_sets(seed: int, n: int, m: int) -> None:
    vi = program(seed, n, m)
    energies = []
    for count in range(min(n, m) + 1):
        for chosen in map(list, combinations(range(m), count)):
            K = np.block([[vi.A, vi.B[chosen].T], [vi.B[chosen], np.zeros((count, count))]])
            x = np.linalg.solve(K, np.concatenate([vi.f, vi.g[chosen]]))[:n]
            if np.all(vi.B @ x <= vi.g + 1e-9):
                energies.append(0.5 * x @ vi.A @ x - vi.f @ x)
    found = exact_solution(vi)
    assert 0.5 * found.x @ vi.A @ found.x - vi.f @ found.x == pytest.approx(min(energies), rel=1e-8, abs=1e-10)


def test_solutions_are_nearer_than_any_solver_s_and_may_have_many_multipliers() -> None:
    """A scale of stiffness like that of a reduced contact problem, 1e11, and loads of 1e6."""
    vi = program(3, 12, 9)
    stiff = VariationalInequality(1e11 * vi.A, 1e11 * vi.f, vi.B, vi.g)
    found, answer = exact_solution(stiff), solve_qp(stiff, "piqp", 1e-7)
    assert kkt_residuals(stiff, found.x, found.alpha).worst <= 1e-12
    assert np.linalg.norm(answer.x - found.x) < 1e-3 * np.linalg.norm(found.x)
    vi = program(0, 4, 3)
    vi = VariationalInequality(vi.A, vi.f + 10.0 * vi.B[0], vi.B, vi.g)  # which presses on the first
    once = exact_solution(vi)
    twice = exact_solution(VariationalInequality(vi.A, vi.f, np.vstack([vi.B, vi.B[:1]]), np.append(vi.g, vi.g[0])))
    assert once.alpha[0] > 0.0
    assert (once.unique, twice.unique) == (True, False)
    assert np.allclose(twice.x, once.x, atol=1e-12)
    assert np.isclose(twice.alpha[0] + twice.alpha[3], once.alpha[0])
    indefinite = VariationalInequality(np.diag([1.0, -1.0]), np.ones(2), np.eye(2), np.ones(2))
    infeasible = VariationalInequality(np.eye(1), np.ones(1), np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0]))
    assert exact_solution(indefinite) is exact_solution(infeasible) is None
    empty = VariationalInequality(np.zeros((0, 0)), np.zeros(0), np.zeros((2, 0)), np.ones(2))
    assert exact_solution(empty).alpha.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("stored", [sp.csr_array, np.array])
def test_of_parallel_rows_the_tightest_is_kept_and_rows_that_differ_are_all(stored: type) -> None:
    lines = "1 2 0; -2 -4 0; 0 0 1; 0 0 -3; 1 0 0; 5 0 0; 0 1e-9 0; 0 0 0; 0.1 0.2 0; 0 0 7; -1 1 1"
    B = stored([[float(entry) for entry in line.split()] for line in lines.split(";")])
    g = np.array([1.0, -2.0, 5.0, 1.0, 2.0, 3.0, np.inf, 1.0, 0.1, 35.0, 0.0])
    rows = rows_that_matter(B, g, 1e-12 * np.abs(g), preferred=np.zeros(11))
    assert rows.kept.tolist() in ([0, 2, 3, 5, 10], [0, 3, 5, 9, 10])
    assert rows.equal.tolist() == [True, False, False, False, False]
    assert (rows.opposite[0], rows.ratio[0]) == (1, 0.5)
    assert rows.implied.nonzero()[0].tolist() == [0, 1, 6, 7, 8]
    pressed = np.zeros(11)
    pressed[1] = 1.0
    other = rows_that_matter(B, g, 1e-12 * np.abs(g), preferred=pressed)
    assert other.kept[0] == 1
    assert other.opposite[0] in {0, 8}
    room = rows_that_matter(B, g + 1e-3 * np.isin(np.arange(11), [0, 8]), 1e-12 * np.abs(g))
    assert not room.equal.any()
    B = np.random.default_rng(0).standard_normal((4, 6))
    B[1] = B[0] * (1.0 + 1e-9 * np.arange(6))
    B[2] = -B[0] * (1.0 - 1e-9 * np.arange(6))
    rows = rows_that_matter(stored(B), np.zeros(4), np.ones(4))
    assert rows.kept.tolist() == [0, 1, 2, 3]
    assert not rows.equal.any()


@given(st.integers(0, 10_000))
def test_multipliers_of_the_rows_that_matter_are_the_same_forces_on_all_rows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    B, scale = rng.standard_normal((5, 7)), rng.uniform(0.1, 10.0, (2, 5))
    B, g = np.vstack([B, -scale[0, :, None] * B, scale[1, :, None] * B]), rng.standard_normal(5)
    g = np.concatenate([g, -scale[0] * g, scale[1] * (g + 1.0)])
    order = rng.permutation(15)
    vi = VariationalInequality(sp.eye_array(7), np.zeros(7), sp.csr_array(B[order]), g[order])
    rows = rows_that_matter(vi.B, vi.g, 1e-12 * np.abs(vi.g))
    assert len(rows.kept) == 5
    assert rows.equal.all()
    assert rows.implied.all()
    forces = rng.standard_normal(5)
    lam = rows.multipliers(forces, 15)
    assert np.all(lam >= 0.0)
    np.testing.assert_allclose(vi.B.T @ lam, rows.program(vi).B.T @ forces, rtol=0.0, atol=1e-12)
