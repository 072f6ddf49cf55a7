"""Formulations of one reduced program against the mixed one: their limits, rates and certificates, in any units."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg
from numerics import exact, fitted_rate, spd

from vibench import Array, NumericalError, VariationalInequality
from vibench_strategies.formulations.penalty import penalised
from vibench_strategies.formulations.proximal import latent_proximal
from vibench_strategies.formulations.sparse_dictionary import Chosen, greedy_active_set
from vibench_strategies.formulations.whitened import Whitened, positive_solution

Solved = tuple[Array, Array]


def program(seed: int, n: int = 6, m: int = 9, ahead: float = 0.4) -> VariationalInequality:
    """A random program that 0 satisfies strictly, with more constraints than unknowns."""
    rng = np.random.default_rng(seed)
    A, f, B = spd(n, rng, 100.0), rng.standard_normal(n), rng.standard_normal((m, n))
    return VariationalInequality(A, f, B, ahead * rng.random(m) * 0.1)


WAYS: dict[str, Callable[[Whitened], Solved]] = {
    "penalty": lambda of: penalised(of, 1e-11, 0.1)[:2],
    "proximal points": lambda of: latent_proximal(of, 1e-11, 1.0, 2.0)[:2],
    "greedy": lambda of: greedy_active_set(of, 1e-13, None)[:2],
}
EACH = pytest.mark.parametrize("solve", WAYS.values(), ids=WAYS)


@EACH
@pytest.mark.parametrize("seed", range(6))
def test_all_agree_with_the_mixed_formulation(solve: Callable[[Whitened], Solved], seed: int) -> None:
    vi = program(seed)
    x, alpha = (whitened := Whitened.of(vi)).back(*solve(whitened))
    known, multipliers = exact(vi)
    assert np.count_nonzero(multipliers) > 0
    assert np.allclose(x, known, atol=1e-8 * np.abs(known).max())
    assert alpha.min() >= 0.0
    # rows may depend on each other: what they push with together is unique
    assert np.allclose(vi.B.T @ alpha, vi.B.T @ multipliers, atol=1e-7 * np.abs(vi.f).max())


@pytest.mark.parametrize("fraction", [1e-3, 1e-6])
@pytest.mark.parametrize(
    "solve", [lambda of: latent_proximal(of, 1e-8, 1.0, 2.0)[:2], lambda of: greedy_active_set(of, 1e-8, None)[:2]]
)
def test_a_load_beside_the_contact_hides_no_error(solve: Callable[[Whitened], Solved], fraction: float) -> None:
    vi = program(2)
    A, f = scipy.linalg.block_diag(vi.A, 1.0), np.append(vi.f, np.linalg.norm(vi.f) / fraction)
    beside = VariationalInequality(A, f, np.column_stack([vi.B, np.zeros(9)]), vi.g)
    alone, loaded = ((of := Whitened.of(each)).back(*solve(of)) for each in (vi, beside))
    _, multipliers = exact(vi)
    # √(2 · 1e-8) of the force, times what the greedy and the proximal points leave of it
    assert np.linalg.norm(vi.B.T @ (loaded[1] - multipliers)) <= 1e-3 * np.linalg.norm(vi.B.T @ multipliers)
    assert np.allclose(loaded[0][:6], alone[0], atol=1e-9 * np.abs(alone[0]).max())


@EACH
def test_no_unit_plays_a_part(solve: Callable[[Whitened], Solved]) -> None:
    vi, rng = program(1), np.random.default_rng(2)
    known = (whitened := Whitened.of(vi)).back(*solve(whitened))
    unknowns, rows = 10.0 ** rng.integers(-6, 7, 6), 10.0 ** rng.integers(-6, 7, 9)
    length, force = 1e-7, 1e5
    A, B = vi.A * np.outer(unknowns, unknowns) * (force / length), vi.B * np.outer(rows, unknowns)
    scaled = VariationalInequality(A, vi.f * unknowns * force, B, vi.g * rows * length)
    x, alpha = (whitened := Whitened.of(scaled)).back(*solve(whitened))
    assert np.allclose(x * unknowns / length, known[0], rtol=1e-6, atol=1e-7)
    assert np.allclose(alpha * rows / force, known[1], rtol=1e-6, atol=1e-7)


@EACH
def test_what_no_constraint_touches_is_unconstrained(solve: Callable[[Whitened], Solved]) -> None:
    vi = program(0)
    far = VariationalInequality(vi.A, vi.f, vi.B, np.full(9, np.inf))
    whitened = Whitened.of(far)
    assert whitened.is_free
    assert np.allclose(whitened.back(np.zeros(6), np.zeros(0))[0], np.linalg.solve(vi.A, vi.f))
    one = np.where(np.arange(9) == 4, np.inf, vi.g)
    x, alpha = (whitened := Whitened.of(VariationalInequality(vi.A, vi.f, vi.B, one))).back(*solve(whitened))
    assert alpha[4] == 0.0
    without = VariationalInequality(vi.A, vi.f, np.delete(vi.B, 4, 0), np.delete(vi.g, 4))
    assert np.allclose(x, exact(without)[0], atol=1e-8)


@EACH
def test_a_row_that_occurs_twice_changes_nothing(solve: Callable[[Whitened], Solved]) -> None:
    vi = program(3)
    twice = VariationalInequality(vi.A, vi.f, np.vstack([vi.B, vi.B[::-1]]), np.append(vi.g, vi.g[::-1]))
    x, alpha = (whitened := Whitened.of(twice)).back(*solve(whitened))
    known, multipliers = exact(vi)
    assert np.allclose(x, known, atol=1e-8 * np.abs(known).max())
    assert np.allclose(vi.B.T @ (alpha[:9] + alpha[:8:-1]), vi.B.T @ multipliers, atol=1e-7)


def test_infeasible_and_indefinite_programs_are_named() -> None:
    vi = program(0)
    above, below = (
        VariationalInequality(vi.A, vi.f, np.vstack([vi.B, np.zeros(6)]), np.append(vi.g, g)) for g in (1.0, -1.0)
    )
    assert not Whitened.of(above).kept[-1]
    with pytest.raises(NumericalError, match="infeasible: a row of B is zero"):
        Whitened.of(below)
    B, g = np.vstack([vi.B, -vi.B[:1]]), np.append(vi.g, -vi.g[0] - 1.0)
    with pytest.raises(NumericalError, match="no coefficients satisfy all constraints"):
        WAYS["greedy"](Whitened.of(VariationalInequality(vi.A, vi.f, B, g)))
    indefinite, vi = np.array([[1.0, 2.0], [2.0, 1.0]]), program(0, n=2)
    with pytest.raises(NumericalError, match="a matrix of 2 constraints is not positive definite"):
        positive_solution(indefinite, np.ones(2))
    with pytest.raises(NumericalError, match="the stiffness of the reduced program is not positive definite"):
        Whitened.of(VariationalInequality(indefinite, vi.f, vi.B, vi.g))


def test_the_penalty_converges_linearly_in_epsilon_and_from_outside() -> None:
    vi = program(4)
    whitened = Whitened.of(vi)
    known = exact(vi)
    epsilons = [1e-3, 1e-4, 1e-5, 1e-6]
    u, lam = [], []
    for epsilon in epsilons:
        z, nu, steps, converged = penalised(whitened, epsilon, 0.1)
        assert converged
        assert steps <= 5 * 7
        # z is the minimiser: the gradient of the penalised function is zero, and ν is what the penalty makes of it
        excess = np.maximum(whitened.Y @ z - whitened.g, 0.0)
        assert np.allclose(z + whitened.Y.T @ excess / epsilon, 0.0, atol=1e-9)
        assert np.allclose(nu, excess / epsilon, atol=1e-8)
        x, alpha = whitened.back(z, nu)
        assert np.max(vi.B @ x - vi.g) > 0.0
        u.append(np.linalg.norm(x - known[0]))
        lam.append(np.linalg.norm(alpha - known[1]))
    assert fitted_rate(epsilons, u) == pytest.approx(1.0, abs=0.02)
    assert fitted_rate(epsilons, lam) == pytest.approx(1.0, abs=0.02)


def test_the_penalty_starts_at_its_epsilon_and_continues_only_where_full_steps_run_in_circles() -> None:
    for seed, n, m, circles in ((4, 6, 9, False), (9, 3, 6, True), (19, 6, 9, True)):
        whitened = Whitened.of(program(seed, n, m))
        taken = []
        for reduction in (0.1, 0.5, 1e-6):
            z, nu, steps, converged = penalised(whitened, 1e-6, reduction)
            assert converged
            taken.append(steps)
            # the minimiser of a strictly convex function has this gradient, however it was found
            excess = np.maximum(whitened.Y @ z - whitened.g, 0.0)
            assert np.allclose(z + whitened.Y.T @ excess / 1e-6, 0.0, atol=1e-9)
            assert np.allclose(nu, excess / 1e-6, atol=1e-8)
        assert (taken[0] > 6) == (taken[1] > taken[0]) == circles


def test_parts_of_rows_are_exact_after_choices_and_drops_of_nearly_dependent_ones() -> None:
    rng = np.random.default_rng(0)
    Y = rng.standard_normal((9, 6))
    Y[4] = Y[1] + 1e-7 * Y[2]
    Y[5] = Y[3] - Y[0]
    chosen = Chosen(Y)
    for row in (0, 1, 2, 3, 6):
        coefficients, rest = chosen.parts(Y[row])
        chosen.add(row, coefficients, rest)
    assert np.linalg.norm(chosen.parts(Y[5])[1]) < 1e-14
    assert chosen.drop(2) == 2  # the direction in which Y[4] differs from Y[1]
    for row in (4, 7):
        coefficients, rest = chosen.parts(Y[row])
        assert np.abs(Y[chosen.rows] @ rest).max() < 1e-13 * np.linalg.norm(rest)
        assert np.allclose(Y[chosen.rows].T @ coefficients + rest, Y[row], atol=1e-13)
        chosen.add(row, coefficients, rest)
    assert len(chosen.rows) == 6
    assert chosen.drop(5) == 7
    assert chosen.rows == [0, 1, 3, 6, 4]


@pytest.mark.parametrize("seed", range(3))
def test_proximal_points_keep_their_tolerance_in_few_steps(seed: int) -> None:
    vi = program(seed, n=20, m=30)
    whitened = Whitened.of(vi)
    residuals = []
    for tolerance in (1e-2, 1e-4, 1e-8):
        z, nu, steps, residual = latent_proximal(whitened, tolerance, 1.0, 2.0)
        assert (whitened.Y @ z < whitened.g + tolerance * whitened.size(z)).all()
        assert nu.min() >= 0.0
        assert residual <= tolerance
        assert steps <= 80
        residuals.append(residual)
    assert residuals == sorted(residuals, reverse=True)


@pytest.mark.parametrize("seed", range(4))
def test_a_few_chosen_entries_are_certified_by_what_is_left(seed: int) -> None:
    vi = program(seed, n=20, m=60)
    whitened = Whitened.of(vi)
    z, nu, _, violation = greedy_active_set(whitened, 1e-12, None)
    count = int(np.count_nonzero(nu))
    assert violation <= 1e-12
    assert 3 < count <= 20  # a vertex of the dual: as many as the unknowns at most
    values = []
    for entries in range(count + 1):
        few, pressed, _, left = greedy_active_set(whitened, 1e-12, entries)
        assert np.count_nonzero(pressed) <= entries
        assert left * whitened.size(few) == pytest.approx(max(np.max(whitened.Y @ few - whitened.g), 0.0))
        # optimal for the entries chosen: what pushes touches, and the objective only grows with entries
        assert np.allclose((whitened.Y @ few - whitened.g)[pressed > 0.0], 0.0, atol=1e-12)
        values.append(0.5 * np.sum(few**2))
    assert np.all(np.diff(values) >= -1e-12)
    assert values[-1] <= 0.5 * np.sum(z**2) + 1e-12
