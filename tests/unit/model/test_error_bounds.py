from dataclasses import replace
from fractions import Fraction
from typing import Any
from unittest import mock

import numpy as np
import pytest
import scipy.sparse as sp
from decimals import ExactProgram
from hypothesis import given
from hypothesis import strategies as st
from numerics import energy, exact, space, spd

from vibench import InnerProduct, NumericalError, VariationalInequality
from vibench.highfidelity.active_set import ACCURACY, HighFidelitySolver, solve_unverified
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.linalg import EPS
from vibench.linalg.schur_complement import EliminationPattern
from vibench.model import error_bounds as module
from vibench.model.bound_terms import BoundNote
from vibench.model.error_bounds import REFERENCE, ErrorBounds, bound_errors_at, corrected_pair, find_correction
from vibench.model.errors import EnergyNorm
from vibench.offline.assemblies import assemblies
from vibench.qp import kkt_residuals
from vibench.stability.coercivity import Constant, Stability, coercivity_and_continuity, energy_inf_sup
from vibench.stability.infsup import InfSup
from vibench_problems.obstacle import Obstacle

V, W = space(6, 1), space(4, 2)
NO_BETA = InfSup(0.0, 0.0, 0.0, "")
Approximation = tuple[VariationalInequality, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
ROUND_OFF = 1e-7
"""Square root of the round-off in squares, relative."""

EXACT = 1e-12
"""Round-off in the solution of a small inequality, relative."""


def stability(vi: VariationalInequality) -> Stability:
    """Without β_HF, which the bounds do not use."""
    constants = *coercivity_and_continuity(vi.A, V), energy_inf_sup(vi.A, sp.csr_array(vi.B), W)
    return Stability(NO_BETA, *constants)


def bounds_or_note(vi: VariationalInequality, u: np.ndarray, lam: np.ndarray, known: Stability | None = None) -> Any:
    space_of = V if len(u) == V.dim else InnerProduct(sp.eye_array(len(u), format="csc"))
    known = known or stability(vi)
    return bound_errors_at(space_of, vi, energy(vi), known.coercivity, known.energy_inf_sup, u, lam)


def bounds(vi: VariationalInequality, u: np.ndarray, lam: np.ndarray, known: Stability | None = None) -> ErrorBounds:
    found = bounds_or_note(vi, u, lam, known)
    assert found.note == ("" if np.isfinite(found.lam) else BoundNote.NOT_UNIQUE)
    return found


def residual_round_off(vi: VariationalInequality, u: np.ndarray, lam: np.ndarray) -> float:
    """In ‖r‖_{A⁻¹}, no more than in |r| as eigenvalues of A are at least 1, with what its proof loses."""
    return 100.0 * EPS * float(np.linalg.norm(np.abs(vi.f) + abs(vi.A) @ np.abs(u) + abs(vi.B.T) @ lam))


def numbers(of: ErrorBounds) -> dict[str, float]:
    return {name: value for name, value in vars(of).items() if name != "note"}


@st.composite
def inequalities(draw: st.DrawFn) -> VariationalInequality:
    """Random ones with constraints that act; two of four rows may be the same, with different bounds."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    B = rng.standard_normal((4, 6))
    if draw(st.booleans()):
        B[3] = draw(st.sampled_from([1.0, 2.5])) * B[0]
    A, f = spd(6, rng, 10.0 ** draw(st.floats(0.0, 4.0))), rng.standard_normal(6)
    g = B @ np.linalg.solve(A, f) - rng.uniform(-0.5, 1.0, 4)  # not all are active
    if draw(st.booleans()):
        g[3] = B[3, 0] / B[0, 0] * g[0]
    return VariationalInequality(sp.csc_array(A), f, sp.csr_array(B), g)


@st.composite
def approximations(draw: st.DrawFn) -> Approximation:
    """An inequality, its solution, any u_N near it or far from it, and a λ_N ≥ 0 with zeros, of the solution or not."""
    vi = draw(inequalities())
    rng, sizes = np.random.default_rng(draw(st.integers(0, 10_000))), st.sampled_from([0.0, 1e-5, 1e-2, 1.0, 30.0])
    u, lam = exact(VariationalInequality(vi.A.toarray(), vi.f, vi.B.toarray(), vi.g))
    u_N = u + draw(sizes) * np.linalg.norm(u) * rng.standard_normal(6)
    lam_N = lam + draw(sizes) * np.linalg.norm(lam) * rng.standard_normal(4)
    if draw(st.booleans()):
        lam_N[lam == 0.0] = 0.0
    if draw(st.booleans()):
        lam_N[rng.integers(4)] = 0.0
    return vi, u, lam, u_N, np.maximum(lam_N, 0.0)


@given(approximations())
def test_no_error_is_above_its_bound(given: Approximation) -> None:
    """Whatever u_N is, feasible or not, whatever λ_N ≥ 0, and with redundant rows; so it is for corrected pairs."""
    vi, u, lam, u_N, lam_N = given
    norm, known = energy(vi), stability(vi)
    scale = norm.norm(u) + norm.norm(u_N) + norm.dual_norm(vi.f) + norm.dual_norm(vi.B.T @ lam_N)
    found = bounds(vi, u_N, lam_N, known)
    allowed, pair = EXACT * scale, corrected_pair(vi, norm, u_N, lam_N)
    v, nu = pair.u, pair.lam
    after = bounds(vi, v, nu, known)
    # Even with p = 0 in place of A⁻¹r, all of which is then missed.
    zero, nothing = mock.Mock(return_value=[np.zeros(6)]), mock.Mock(side_effect=np.zeros_like)
    with mock.patch.object(module, "solutions", zero), mock.patch.object(norm.stiffness, "solve", nothing):
        missed = bound_errors_at(V, vi, norm, known.coercivity, Constant(0.0, True), u_N, lam_N)
    for u_of, lam_of, bound in ((u_N, lam_N, found), (v, nu, after), (u_N, lam_N, missed)):
        assert norm.norm(u - u_of) <= bound.u_energy + allowed
        assert norm.dual_norm(vi.B.T @ (lam - lam_of)) <= bound.lambda_natural + allowed
    assert float(V.norm(u - u_N)) <= found.u + allowed / np.sqrt(known.coercivity.value)
    if (beta := known.energy_inf_sup.value) > 0.0:
        assert float(W.norm(lam - lam_N)) <= found.lam + allowed / beta
    else:
        assert found.lam == np.inf  # of dependent rows the multiplier is not unique
    # A corrected pair is feasible, and nothing but the residual is left of its bounds.
    assert np.min(nu) >= 0.0
    assert np.max(vi.B @ v - vi.g) <= EXACT * (1.0 + float((abs(vi.B) @ np.abs(v) + np.abs(vi.g)).max()))
    # κ is left of slacks that are zero: five times their round-off, the margin included, of which bounds have the root.
    kappa = nu @ (50.0 * EPS * (abs(vi.B) @ (np.abs(v) + np.abs(u_N)) + np.abs(vi.g)))
    assert after.u_energy <= found.rho * (1.0 + 1e-6) + ROUND_OFF * scale + np.sqrt(2.0 * kappa)
    lost = EXACT * scale + residual_round_off(vi, u_N, lam_N)
    assert (pair.omega, pair.rho) == pytest.approx((found.omega, found.rho), rel=1e-9, abs=lost)


STIFF = [(1e-12, 1e-8, 27), (1e-12, 1e-4, 16), (1e-12, 1.0, 18), (1e-13, 1e-8, 18), (1e-13, 1e-8, 56), (1e-6, 0.0, 1)]
"""Smallest eigenvalue, relative error of the pair, seed; errors of all but the last one were above the bounds."""


@pytest.mark.parametrize(("coercivity", "size", "seed"), STIFF)
def test_no_error_is_above_its_bound_however_stiff_a_is(coercivity: float, size: float, seed: int) -> None:
    """To the last digit, from solutions of 100 digits: norms in A⁻¹ are those of factors that have lost most digits."""
    n, m, rng = 14, 5, np.random.default_rng(seed)
    turned, _ = np.linalg.qr(rng.standard_normal((n, n)))
    A = (turned * np.geomspace(coercivity, 1.0, n)) @ turned.T
    A, B = sp.csc_array(0.5 * (A + A.T)), np.zeros((m, n))
    B[:, :7] = rng.standard_normal((m, 7))
    solution = rng.standard_normal(n)
    vi = VariationalInequality(A, A @ solution, sp.csr_array(B), B @ solution - rng.uniform(-0.5, 1.0, m))
    program = ExactProgram(vi)
    exact_pair = program.solve(solve_unverified(vi, CondensedStiffness(A)).lam > 0.0)
    u, lam = (np.asarray(one, float) for one in exact_pair)
    u_N = u + size * np.abs(u).max() * rng.standard_normal(n)
    lam_N = np.maximum(lam * (1.0 + size * rng.standard_normal(m)), 0.0)
    errors, unit = program.errors(exact_pair, u_N, lam_N), InnerProduct(sp.eye_array(n, format="csc"))
    for pattern in (None, EliminationPattern.of(A, np.arange(7))):
        known = Constant(0.5 * coercivity, True), Constant(0.0, True)
        found = bound_errors_at(unit, vi, EnergyNorm(A, CondensedStiffness(A, pattern)), *known, u_N, lam_N)
        assert errors[0] <= found.u_energy
        assert errors[1] <= found.lambda_natural
        if size:
            assert found.u_energy <= 3.0 * np.hypot(*errors)


@given(st.integers(0, 10_000), st.sampled_from([1e-6, 1e-8, 1e-10]))
def test_a_multiplier_that_is_small_beside_the_error_of_u_is_bounded(seed: int, size: float) -> None:
    """Contact that begins: λ_N = 0, and A⁻¹r is −w but for 1e-10 of it, all that the bound of λ consists of."""
    rng = np.random.default_rng(seed)
    A, B, u = spd(6, rng, 30.0), rng.standard_normal((4, 6)), rng.standard_normal(6)
    lam = size * rng.uniform(0.5, 1.5, 4)
    vi = VariationalInequality(sp.csc_array(A), A @ u + B.T @ lam, sp.csr_array(B), B @ u)
    u_N = u + np.linalg.solve(A, B.T @ rng.uniform(0.05, 0.15, 4))  # penetrates
    error = energy(vi).dual_norm(B.T @ lam)
    found = bounds(vi, u_N, np.zeros(4))
    assert found.rho > 1e3 * error
    assert found.lambda_natural >= error * (1.0 - 1e-4)
    assert found.lambda_natural <= 10.0 * error + EXACT * found.rho


@given(approximations())
def test_without_a_residual_the_multiplier_of_a_correction_is_the_high_fidelity_one(given: Approximation) -> None:
    vi, u, lam, _, lam_N = given
    A = vi.A.toarray()
    without = np.linalg.solve(A, vi.f - vi.B.T @ lam_N)
    corrected = find_correction(vi, energy(vi), without, lam_N)
    assert corrected.nu.min(initial=0.0) >= 0.0
    size = np.abs(vi.f).max() + np.abs(A).max() * np.abs(u).max() + np.abs(vi.B.T @ lam_N).max()
    np.testing.assert_allclose(A @ corrected.w, vi.B.T @ (corrected.nu - lam_N), rtol=0.0, atol=1e-9 * size)
    np.testing.assert_allclose(vi.B.T @ corrected.nu, vi.B.T @ lam, rtol=0.0, atol=1e-9 * size)


@given(approximations())
def test_the_terms_are_those_of_a_correction_that_is_feasible_in_exact_arithmetic(given: Approximation) -> None:
    vi, _, _, u_N, lam_N = given
    corrected, norm = find_correction(vi, energy(vi), u_N, lam_N), energy(vi)
    scale = norm.norm(u_N) + norm.dual_norm(vi.f) + norm.dual_norm(vi.B.T @ lam_N)
    w = corrected.w
    for row, g in zip(vi.B.toarray(), vi.g, strict=True):
        slack = sum(Fraction(b) * (Fraction(x) - Fraction(v)) for b, x, v in zip(row, w, u_N, strict=True))
        assert slack + Fraction(g) >= 0
    found = bounds(vi, u_N, lam_N)
    residual = vi.f - vi.A @ u_N - vi.B.T @ lam_N
    rho = float(np.sqrt(residual @ np.linalg.solve(vi.A.toarray(), residual)))
    assert found.rho == pytest.approx(rho, rel=1e-9, abs=residual_round_off(vi, u_N, lam_N))
    assert found.omega == pytest.approx(float(np.sqrt(w @ (vi.A @ w))))
    # Slacks of seven terms are rounded here and in κ, where a bound of that is added and 20 units of the whole.
    rounded = 20.0 * EPS * (abs(vi.B) @ (np.abs(w) + np.abs(u_N)) + np.abs(vi.g))
    assert found.kappa == pytest.approx(lam_N @ (vi.B @ w - (vi.B @ u_N - vi.g)), rel=1e-14, abs=lam_N @ rounded)
    assert found.u_energy == pytest.approx(float(np.sqrt(found.rho**2 + found.omega**2 + 2.0 * found.kappa)))
    assert found.omega**2 + 2.0 * found.kappa <= 1.001 * _least(vi, u_N, lam_N) + (20.0 * ROUND_OFF * scale) ** 2
    if np.linalg.matrix_rank(vi.B.toarray()) < 4:
        return  # round-off decides how much of d is found
    half = np.linalg.cholesky(vi.A.toarray())
    whitened, range_of_B = np.linalg.solve(half, residual), np.linalg.solve(half, vi.B.toarray().T)
    seen = range_of_B @ np.linalg.lstsq(range_of_B, whitened)[0]
    feasible = _clearly_feasible(vi, u_N, np.linalg.solve(half.T, whitened - seen), w)
    if not feasible and found.rho_range == pytest.approx(found.rho, rel=1e-12):
        seen = whitened  # d is so large that round-off may make w infeasible
    assert found.rho_range == pytest.approx(float(np.linalg.norm(seen)), rel=1e-4, abs=ROUND_OFF * scale)
    square = found.rho_range**2 + found.omega**2 + 2.0 * found.kappa
    gap = square + 2.0 * seen @ (half.T @ w)
    assert found.lambda_natural == pytest.approx(
        min(np.sqrt(max(gap, 0.0)), found.omega + np.sqrt(square)), rel=1e-4, abs=5.0 * ROUND_OFF * scale
    )


def _clearly_feasible(vi: VariationalInequality, u: np.ndarray, d: np.ndarray, w: np.ndarray) -> bool:
    """Whether B w ≥ B(u + d) − g by more than twice the round-off for rows of six entries, and that in d."""
    slack, B = vi.B @ w - (vi.B @ (u + d) - vi.g), abs(vi.B)
    size = B @ (np.abs(w) + np.abs(u + d)) + np.abs(vi.g)
    # d is a solution with A, of a condition of up to 1e4
    return bool(np.all(slack >= 10.0 * EPS * size + 1e5 * EPS * (B @ np.abs(d))))


def _least(vi: VariationalInequality, u: np.ndarray, lam: np.ndarray) -> float:
    """The smallest ω² + 2κ, from every active set; not negative but for round-off."""
    excess = vi.B @ u - vi.g
    w, _ = exact(VariationalInequality(vi.A.toarray(), -vi.B.T @ lam, -vi.B.toarray(), -excess))
    return max(0.0, float(w @ (vi.A @ w) + 2.0 * lam @ (vi.B @ w - excess)))


def scalar(lam: float, u: float) -> tuple[VariationalInequality, np.ndarray, np.ndarray]:
    """½ 4x² − 4x subject to 2x ≤ 1: the solution is ½, its multiplier 1."""
    vi = VariationalInequality(sp.csc_array([[4.0]]), np.array([4.0]), sp.csr_array([[2.0]]), np.array([1.0]))
    return vi, np.array([u]), np.array([lam])


KNOWN = Stability(NO_BETA, Constant(0.25, True), Constant(9.0, True), Constant(0.5, True))


def test_opposite_rows_are_an_equality_that_corrections_hold_without_a_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two opposite constraints ask for x = ½ exactly; what equalities may miss is in every term."""
    vi, known = scalar(0.0, 0.0)[0], replace(KNOWN, energy_inf_sup=Constant(0.0, True))
    vi = replace(vi, B=sp.csr_array([[2.0], [-2.0]]), g=np.array([1.0, -1.0]))
    u, lam = np.array([0.6]), np.array([0.8, 0.0])
    found = bounds_or_note(vi, u, lam, known)
    assert numbers(found) == pytest.approx(numbers(ErrorBounds(0.2, 0.4, 0.2, np.inf, 0.0, 0.0, 0.2, 0.0)), abs=1e-7)
    assert found.note == BoundNote.NOT_UNIQUE
    empty = replace(vi, g=np.array([1.0, -1.001]))
    assert bounds_or_note(empty, u, lam, known) == ErrorBounds.none(BoundNote.NO_CORRECTION)
    assert module.reference_bound(empty, energy(vi), np.array([0.5]), np.array([1.0, 0.0])) == np.inf
    # as in arithmetic of two digits: rows of norm 1 in A⁻¹ have a round-off of 0.01, hence η = 0.02
    monkeypatch.setattr(module, "_round_off", lambda on, size, w: np.full(2, 0.01))
    found = bounds_or_note(vi, u, lam, known)
    square = 0.22**2 + 2.0 * 0.03 * 0.8  # r = 0, ω = 0.2 and κ = 0 without η and the round-off in B w − s
    expected = ErrorBounds(np.sqrt(square), 2.0 * np.sqrt(square), np.sqrt(square), np.inf, 0.0, 0.0, 0.22, 0.024)
    assert numbers(found) == pytest.approx(numbers(expected), abs=1e-7)
    residual = bounds_or_note(vi, u, np.array([0.7, 0.0]), known)  # r = 0.2: ‖r + A w‖ = 0.3
    assert residual.lambda_natural == pytest.approx(np.sqrt(0.32**2 + 2.0 * 0.03 * 0.7), abs=1e-7)


def test_each_term_enters_where_the_derivation_says() -> None:
    """What is not proved is said, and rows that are absent bound nothing."""
    vi, u, lam = scalar(lam=0.8, u=0.6)  # r = 4 − 2.4 − 1.6 = 0, s = 0.2, w = 0.1 and κ = 0
    found = bounds_or_note(vi, u, lam, KNOWN)
    assert numbers(found) == pytest.approx(numbers(ErrorBounds(0.2, 0.4, 0.2, 0.4, 0.0, 0.0, 0.2, 0.0)), abs=1e-7)
    absent = VariationalInequality(vi.A, vi.f, sp.csr_array([[2.0], [3.0]]), np.array([1.0, np.inf]))
    with_it = bounds_or_note(absent, u, np.append(lam, 0.0), KNOWN)
    assert numbers(with_it) == pytest.approx(numbers(found), rel=1e-12)
    assert bounds_or_note(absent, u, np.append(lam, 0.1), KNOWN) == ErrorBounds.none(BoundNote.ON_ABSENT_ROW)
    known = Stability(NO_BETA, Constant(0.25, False), Constant(9.0, False), Constant(0.0, True))
    estimated = bounds_or_note(vi, u, lam, known)
    assert estimated.note == f"{BoundNote.ESTIMATED}; {BoundNote.NOT_UNIQUE}"
    assert estimated.lam == np.inf
    assert bounds_or_note(vi, u, -lam, known) == ErrorBounds.none(BoundNote.NOT_IN_CONE)
    vi, u, lam = scalar(lam=0.2, u=0.3)  # r = 4 − 1.2 − 0.4 = 2.4, s = −0.4, w = −0.1 is best: κ = 0.2·(−0.2 + 0.4)
    square = 1.2**2 + 0.2**2 + 2.0 * 0.04
    natural = np.sqrt(square - 2.0 * 2.4 * 0.1)
    expected = ErrorBounds(np.sqrt(square), 2.0 * np.sqrt(square), natural, 2.0 * natural, 1.2, 1.2, 0.2, 0.04)
    assert numbers(bounds_or_note(vi, u, lam, KNOWN)) == pytest.approx(numbers(expected), abs=1e-7)


def test_of_the_residual_only_what_constraints_see_bounds_the_multiplier() -> None:
    """½|x|² − 2x₁ − x₂ subject to x₁ ≤ 1: the solution is (1, 1), its multiplier 1. r = (0.3, 0.4) and s = 0."""
    A, B = sp.eye_array(2, format="csc"), sp.csr_array([[1.0, 0.0]])
    vi = VariationalInequality(A, np.array([2.0, 1.0]), B, np.array([1.0]))
    found = bounds_or_note(vi, np.array([1.0, 0.6]), np.array([0.7]), Stability(NO_BETA, *3 * [Constant(1.0, True)]))
    # the error of u is 0.4, that of λ 0.3
    found = found.rho, found.rho_range, found.u_energy, found.lambda_natural
    assert found == pytest.approx((0.5, 0.3, 0.5, 0.3))


def test_as_many_constraints_as_unknowns_see_all_of_a_residual_there() -> None:
    """Every node of the obstacle constrains: what is left of r is its part on these, whichever way it is computed."""
    problem = Obstacle(resolution=150)
    mu = problem.parameters.upper
    vi, of_A = assemblies(problem).at(mu), assemblies(problem).energy_at(mu)
    on, rng = of_A.contact_form(vi), np.random.default_rng(0)
    assert on.B.shape[0] == on.B.shape[1] < problem.V.dim
    solution = HighFidelitySolver(problem).solve(mu)
    u = solution.u + 1e-3 * np.abs(solution.u).max() * rng.standard_normal(len(solution.u))
    K, r = vi.B @ of_A.factor.solve(vi.B.T.toarray()), vi.f - vi.A @ u - vi.B.T @ solution.lam
    seen = vi.B @ of_A.factor.solve(r)
    found = bound_errors_at(problem.V, vi, of_A, Constant(1.0, True), Constant(1.0, True), u, solution.lam)
    assert found.rho_range == pytest.approx(np.sqrt(seen @ np.linalg.solve(K, seen)), rel=1e-8)
    assert found.rho_range < 0.99 * found.rho
    for few in (1, 3, len(seen)):
        multiplier = np.zeros(len(seen))
        multiplier[:few] = rng.random(few)
        assert on.force_norm(multiplier) == pytest.approx(np.sqrt(multiplier @ K @ multiplier), rel=1e-10)
        assert on.force_representer(multiplier).norm == pytest.approx(on.force_norm(multiplier), rel=1e-10)


def test_a_reference_is_verified_by_its_bound_where_residuals_do_not_tell() -> None:
    """A multiplier of a row without contact is a gap, which bounds the square of an error."""
    vi, u, lam = scalar(lam=1.0, u=0.5)
    assert module.reference_bound(vi, energy(vi), u, lam) < REFERENCE
    apart, force = replace(vi, g=np.array([3.0])), 1e-10  # s = −1 at the solution u = 1, and S = 2
    assert module.reference_bound(apart, energy(vi), np.array([1.0]), np.zeros(1)) == 0.0
    u, lam = np.array([1.0 - 0.5 * force]), np.array([force])
    assert kkt_residuals(apart, u, lam).worst <= ACCURACY
    with pytest.raises(NumericalError, match=r"the error bound of the high-fidelity solution is 7\.1e-06 of it"):
        module.reference_bound(apart, energy(vi), u, lam)
    # What round-off leaves open refuses no reference: two bodies far from zero on weak springs, in exact numbers.
    far, weak = 2.0**17, 2.0**-40
    A, B = sp.csc_array([[4.0 + weak, -4.0], [-4.0, 4.0 + weak]]), sp.csr_array([[1.0, -1.0]])
    u, lam = np.array([far, far - 0.5]), np.array([1.0])
    vi = VariationalInequality(A, A @ u + B.T @ lam, B, np.array([0.5]))
    assert REFERENCE < module.reference_bound(vi, energy(vi), u, lam) < 1e-3


@pytest.mark.parametrize("decades", [1.0, 12.0, 20.0])
def test_a_correction_without_room_for_round_off_is_found_again(decades: float) -> None:
    """Solutions round rows of u ≤ 0 in units of all of w, far above the round-off of the small ones itself."""
    n = 30
    A = sp.diags_array([-np.ones(n - 1), np.full(n, 2.1), -np.ones(n - 1)], offsets=[-1, 0, 1], format="csc")
    for seed in range(3):
        rng, B = np.random.default_rng(seed), sp.eye_array(n - 2, n, format="csr")
        u, lam = rng.choice([-1.0, 1.0], n) * np.geomspace(1.0, 10.0**-decades, n), rng.random(n - 2)
        vi = VariationalInequality(A, A @ u + B.T @ lam + 1e-2 * rng.standard_normal(n), B, np.zeros(n - 2))
        norm = EnergyNorm(A, CondensedStiffness(A), shared=True)
        # it is one of u + d, too
        found = bound_errors_at(InnerProduct(A), vi, norm, Constant(1.0, True), Constant(1.0, True), u, lam)
        assert found.rho_range < found.rho < np.inf


def test_pairs_with_one_stiffness_share_its_solutions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two extensions a pair, eight pairs at once; the bounds are those of each pair alone."""
    extend, columns, rng, vi = CondensedStiffness.extend, [], np.random.default_rng(0), scalar(lam=0.8, u=0.6)[0]

    def counted(stiffness: CondensedStiffness, values: np.ndarray) -> np.ndarray:
        columns.append(values.shape[1])
        return extend(stiffness, values)

    norm, constants = energy(vi), (Constant(1.0, True), Constant(1.0, True))
    u, lam = rng.standard_normal((1, 9)), rng.random((1, 9))
    monkeypatch.setattr(CondensedStiffness, "extend", counted)
    together = module.error_bounds(InnerProduct(vi.A), 9 * [vi], 9 * [norm], 9 * [constants], u, lam)
    assert columns == [16, 2]
    for found, *pair in zip(together, u.T, lam.T, strict=True):
        assert numbers(found) == pytest.approx(
            numbers(bound_errors_at(InnerProduct(vi.A), vi, norm, *constants, *pair))
        )


def test_an_active_set_method_that_fails_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """The w of dependent constraints is feasible and may be huge: a multiplier that no row alone would have tells."""
    vi, u, lam = scalar(lam=0.8, u=0.6)
    sharp = bounds_or_note(vi, u, lam, KNOWN)
    assert np.isfinite(sharp.u_energy)
    for settled in (None, (np.array([1e13]), np.array([1e15]), 3)):
        monkeypatch.setattr(module, "active_set_iterations", lambda *_, settled=settled: settled)
        assert bounds_or_note(vi, u, lam, KNOWN).u_energy == pytest.approx(sharp.u_energy, rel=1e-4)
    monkeypatch.setattr(module, "least_distance_solution", lambda *given: None)
    assert np.isfinite(bounds_or_note(vi, u, lam, KNOWN).u_energy)
