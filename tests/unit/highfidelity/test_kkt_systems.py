import contextlib
from unittest import mock

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench import NumericalError
from vibench.highfidelity import kkt_systems
from vibench.highfidelity.active_set import HighFidelitySolver, solve_unverified, verified
from vibench.highfidelity.kkt_systems import CondensedStiffness, SaddlePointSolver, ZoneStiffness, watched, zone_of
from vibench.linalg import cholesky
from vibench.linalg.factorisations import DEFAULT, IMPLEMENTATIONS
from vibench.linalg.schur_complement import EliminationPattern, PrincipalSubmatrix
from vibench.qp import verification
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle

SETS = st.lists(st.sets(st.integers(0, 5)), min_size=1, max_size=5)
LIBRARIES = [name for name, one in IMPLEMENTATIONS.items() if one.is_installed]


@given(*map(st.sampled_from, (range(10_000), range(7), [1e-6, 1.0, 2e11], [None, *LIBRARIES])), SETS)
def test_solutions_are_those_of_the_whole(seed: int, border: int, young: float, library: str, sets: list) -> None:
    rng, ordered = np.random.default_rng(seed), library is not None
    A, f = young * spd(8, rng), young * rng.standard_normal(8)
    B, g = rng.standard_normal((6, 8)), rng.standard_normal(6)
    order = PrincipalSubmatrix(rng.permutation(8)) if ordered else None
    solve = SaddlePointSolver(sp.csc_array(A), f, sp.csr_array(B), g, border, order, library or DEFAULT)
    for chosen in sets:
        active = np.array(sorted(chosen), dtype=np.intp)
        rows = B[active]
        whole = np.block([[A / young, rows.T], [rows, np.zeros((len(active),) * 2)]])
        expected = np.linalg.solve(whole, np.concatenate([f / young, g[active]]))
        u, lam = solve(active)
        assert np.allclose(u, expected[:8], atol=1e-8)
        assert np.allclose(lam[active] / young, expected[8:], atol=1e-8)
        assert not np.any(np.delete(lam, active))
        assert solve.is_definite == ordered
        if ordered:
            loads = rng.standard_normal((8, 3))
            assert np.allclose(solve.dual_norms(loads) ** 2, np.diag(loads.T @ np.linalg.solve(A, loads)), rtol=1e-8)


def test_sets_that_differ_little_are_not_factorised_again(monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[tuple[int, int]]()
    monkeypatch.setattr(kkt_systems, "splu", lambda matrix: made.append(matrix.shape) or sp.linalg.splu(matrix))
    for young in (1e-12, 1.0, 2e11):
        made.clear()
        A, B = sp.csc_array(young * spd(40, np.random.default_rng(0))), sp.eye_array(40).tocsr()
        solve = SaddlePointSolver(A, young * np.ones(40), B, np.zeros(40), 16)
        for active in (np.arange(20), np.arange(3, 22), np.arange(20), np.arange(20 + 16 + 1)):
            solve(active)
        assert made == [(60, 60), (77, 77)]
    made.clear()  # a border that is dependent is left to a factorisation
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((2, 5))
    solve = SaddlePointSolver(sp.csc_array(spd(5, rng)), np.ones(5), sp.csr_array(rows[[0, 1, 0]]), np.zeros(3), 16)
    solve(np.array([0, 1]))
    with contextlib.suppress(RuntimeError):  # exactly singular or nearly so
        solve(np.array([0, 1, 2]))
    assert made == [(7, 7), (8, 8)]


@pytest.mark.parametrize("library", LIBRARIES)
def test_an_order_serves_definite_systems_alone(library: str) -> None:
    """Others have exchanged rows as without it, and nothing is said of A."""
    rng = np.random.default_rng(2)
    A, rows, order = spd(5, rng), rng.standard_normal((2, 5)), PrincipalSubmatrix(np.array([3, 1, 4, 0, 2]))
    program = np.ones(5), sp.csr_array(rows[[0, 1, 0]]), np.zeros(3)
    dependent = SaddlePointSolver(sp.csc_array(A), *program, 16, order, library)
    with contextlib.suppress(RuntimeError):  # exactly singular or nearly so
        dependent(np.arange(3))
    assert not dependent.is_definite
    indefinite = A - 2.0 * np.linalg.eigvalsh(A)[0] * np.eye(5)
    solve = SaddlePointSolver(sp.csc_array(indefinite), np.ones(5), sp.csr_array(rows), np.zeros(2), 16, order, library)
    u, lam = solve(np.arange(1))
    assert not solve.is_definite
    assert np.allclose(indefinite @ u + rows.T @ lam, 1.0)
    A = sp.csc_array(np.array([[1.0, 0.0, 0.0], [0.0, -2.0, 1.0], [0.0, 1.0, 0.0]]))  # without an order
    u, lam = SaddlePointSolver(A, np.ones(3), sp.csr_array(np.eye(3)), np.zeros(3), 16)(np.array([0]))
    assert np.allclose([*(A @ u + lam)[1:], u[0]], [1.0, 1.0, 0.0])


def test_one_factorisation_per_parameter_solves_and_verifies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where A varies and few rows constrain: nothing else is factorised, and residuals are those of a factor of A."""
    problem = Obstacle("medium")
    first, second = problem.parameters.sample(2, 3)
    start = (solver := HighFidelitySolver(problem)).solve(first).lam > 0.0
    made, lu = [], cholesky.symmetric_lu
    monkeypatch.setattr(cholesky, "symmetric_lu", lambda matrix, order: made.append(order) or lu(matrix, order))
    monkeypatch.setattr(kkt_systems, "splu", None)
    monkeypatch.setattr(cholesky, "_pivots", None)
    vi = problem.assemble(second)
    stiffness = solver.condensed(vi)
    found = verified(vi, stiffness, solve_unverified(vi, stiffness, start))
    stiffness.check_definite("A")
    assert len(made) == 1
    monkeypatch.undo()
    away = found.lam * (1.0 + 1e-6)
    ours, exact = (verification.kkt_residuals(vi, found.u, away, inverse) for inverse in (stiffness, None))
    assert ours.dual == pytest.approx(exact.dual, rel=1e-6)
    assert ours.gap == pytest.approx(exact.gap, rel=1e-6)


@pytest.mark.parametrize("coupled", [0, 3], ids=["sparse", "dense"])
@pytest.mark.parametrize("kept", [0, 3], ids=["nothing kept", "three kept"])
def test_what_is_left_after_elimination_shows_whether_a_stiffness_is_definite(coupled: int, kept: int) -> None:
    A = sp.block_diag([4.0 * np.eye(6), np.diag([4.0, 5.0, 6.0])]).toarray()
    A[:coupled, 6 : 6 + coupled] = A[6 : 6 + coupled, :coupled] = np.eye(coupled)
    pattern = EliminationPattern.of(sp.csr_array(A), np.arange(9 - kept, 9)) if kept else None
    CondensedStiffness(sp.csr_array(A), pattern).check_definite("A somewhere")
    A[8, 8] = 0.2 if coupled else -1.0  # a quarter is taken from it where it is coupled
    with pytest.raises(NumericalError, match=r"A( somewhere)? is not positive definite"):
        CondensedStiffness(sp.csr_array(A), pattern).check_definite("A somewhere")


@pytest.mark.parametrize("kind", ["one entry a row", "several entries a row"])
def test_what_serves_many_loads_multiplies_by_the_inverse(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    rng = np.random.default_rng(5)
    line = sp.diags_array([-np.ones(11), 3.0 * np.ones(12), -np.ones(11)], offsets=[-1, 0, 1])
    coupling = sp.coo_array(([-0.01, -0.01], ([12, 13], [13, 12])), shape=(25, 25))
    A = sp.csr_array(sp.block_diag([spd(13, rng), line]) + coupling)
    B = sp.csr_array(np.diag(rng.uniform(1.0, 2.0, 12))[::-1])
    B = B if kind == "one entry a row" else sp.csr_array(B + 0.5 * sp.eye_array(12))
    stiffness = CondensedStiffness(A, EliminationPattern.of(A, np.arange(13, 25)))
    loads, schur = rng.standard_normal((12, 3)), np.linalg.inv(np.linalg.inv(A.toarray())[13:, 13:])
    assert not stiffness.dense
    by_factor, before = stiffness.compliance(loads), stiffness.nbytes
    stiffness.serve_many(12)
    assert stiffness.nbytes == before + 8 * 12**2
    monkeypatch.setattr(kkt_systems, "SparseCholesky", None)
    del vars(stiffness)["_schur_factor"]
    for found, expected in (
        (by_factor, np.linalg.solve(schur, loads)),
        (stiffness.compliance(loads), np.linalg.solve(schur, loads)),
        (stiffness.liftings(B), B @ np.linalg.inv(schur)),
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
    # few rows have their liftings from a factor
    monkeypatch.undo()
    line = sp.diags_array([-np.ones(19), 3.0 * np.ones(20), -np.ones(19)], offsets=[-1, 0, 1], format="csr")
    stiffness, B = CondensedStiffness(line), sp.csr_array(np.eye(9, 20))
    stiffness.serve_many(9)
    np.testing.assert_allclose(stiffness.liftings(B), np.linalg.inv(line.toarray())[:9], rtol=1e-12)
    assert "inverse" not in vars(stiffness)


@pytest.fixture(scope="module")
def hertz() -> Hertz:
    return Hertz(300)


@pytest.mark.parametrize("constant", [True, False], ids=["constant", "varying"])
@pytest.mark.parametrize("rows", [None, 1, 0], ids=["coarse problem", "one row", "nothing"])
def test_solutions_do_not_depend_on_the_zone(hertz: Hertz, rows: int | None, constant: bool) -> None:
    mus = np.array([[0.7], [1.3], [0.9]])
    expected = [HighFidelitySolver(hertz).solve(mu) for mu in mus]
    guess = None if rows is None else lambda factor, vi: np.arange(len(vi.g)) < rows
    with mock.patch.multiple(kkt_systems, MANY_UNKNOWNS=0, coarse_contact=guess or kkt_systems.coarse_contact):
        with mock.patch.object(Hertz, "constant", frozenset({"A", "f"} if constant else ())):
            solver, zones = HighFidelitySolver(hertz), []
            for mu, single in zip(mus, expected, strict=True):
                found = solver.solve(mu)
                assert isinstance(solver._stiffness, ZoneStiffness)
                zones.append(solver._stiffness.zone)
                assert np.array_equal(found.lam > 0.0, single.lam > 0.0)
                assert found.fallback == ""
                np.testing.assert_allclose(found.u, single.u, atol=1e-11 * np.abs(single.u).max())
                np.testing.assert_allclose(found.lam, single.lam, atol=1e-9 * single.lam.max())
                reached = np.unique(sp.csr_array(hertz.assemble(mu).B)[found.lam > 0.0].indices)
                assert np.isin(reached, zones[-1]).all()
        vi = hertz.assemble(mus[-1])
        force = vi.B.T @ found.lam
        energy = force @ np.linalg.solve(vi.A.toarray(), force)
        assert solver._stiffness.dual_norms(force[:, None]) == pytest.approx(np.sqrt(energy), rel=1e-9)
        there = force[hertz.contact_dofs]
        assert solver._stiffness.compliance(there) @ there == pytest.approx(energy, rel=1e-9)
    assert len(zones[-1]) < len(hertz.contact_dofs)
    assert np.isin(zones[0], zones[-1]).all()


def test_a_zone_has_the_unknowns_of_rows_and_of_their_neighbours() -> None:
    B = sp.eye_array(10, 11, format="csr") - sp.eye_array(10, 11, k=1, format="csr")
    rows = np.isin(np.arange(10), [4, 5])
    zone = zone_of(B, rows)
    assert zone.tolist() == [3, 4, 5, 6, 7]
    assert np.flatnonzero(watched(B, zone)).tolist() == [3, 4, 5, 6]
    assert zone_of(B, np.ones(10, bool)).tolist() == list(range(11))
    assert zone_of(B, np.zeros(10, bool)).tolist() == []
    apart = sp.block_diag([np.ones((1, 2)), np.ones((1, 2))], format="csr")
    assert zone_of(apart, np.array([True, False])).tolist() == [0, 1]  # nothing is next to it
