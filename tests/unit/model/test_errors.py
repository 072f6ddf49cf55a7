from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import assume, given
from hypothesis import strategies as st
from numerics import Varying, energy, space

from vibench import Problem, VariationalInequality
from vibench.highfidelity import active_set
from vibench.model.error_bounds import error_bounds
from vibench.model.errors import UNMEASURABLE, ReferenceSolutions, errors
from vibench.model.hsw_bounds import hsw_bounds
from vibench.reduction import constraint_classes
from vibench.stability import cone_basis, inf_sup_full, inf_sup_on
from vibench.stability.coercivity import Constant, Stability, coercivity_and_continuity, energy_inf_sup
from vibench.stability.infsup import InfSup, constants_full, constants_on, nodal_cone

PROBLEM = Varying()


def bound(problem: Problem, vi: VariationalInequality, known: Stability, u: np.ndarray, lam: np.ndarray) -> Any:
    (found,) = hsw_bounds(problem, [vi], [known], u[:, None], lam[:, None])
    return found


def stability(mu: np.ndarray) -> Stability:
    vi = PROBLEM.assemble(mu)
    inf_sup = inf_sup_full(PROBLEM.V, vi.B, nodal_cone(PROBLEM.W))
    return Stability(inf_sup, *coercivity_and_continuity(vi.A, PROBLEM.V), Constant(0.0, True))


def by_hand(beta: float, alpha: float, gamma: float) -> Stability:
    known = Constant(beta, True)
    return Stability(InfSup(beta, beta, beta, ""), Constant(alpha, True), Constant(gamma, True), known)


@given(st.integers(0, 10_000), st.floats(0.0, 1.0), st.sampled_from([1e-6, 1e-3, 1e-1, 10.0]))
def test_no_error_is_above_its_bound(seed: int, angle: float, size: float) -> None:
    """Whatever u is, and whatever λ ≥ 0: the bounds ask for nothing else."""
    mu, rng = np.array([angle]), np.random.default_rng(seed)
    vi = PROBLEM.assemble(mu)
    exact = active_set.solve_high_fidelity(vi)
    u = exact.u + size * rng.standard_normal(len(exact.u)) * np.abs(exact.u).max()
    lam = np.maximum(exact.lam + size * rng.standard_normal(len(exact.lam)) * exact.lam.max(), 0.0)
    found = bound(PROBLEM, vi, stability(mu), u, lam)
    assert found.u >= float(PROBLEM.V.norm(u - exact.u))
    assert found.lam >= float(PROBLEM.W.norm(lam - exact.lam))


def test_the_bounds_vanish_with_the_error() -> None:
    mu = np.array([0.4])
    vi = PROBLEM.assemble(mu)
    exact = active_set.solve_high_fidelity(vi)
    found = bound(PROBLEM, vi, stability(mu), exact.u, exact.lam)
    assert found.u < 1e-5 * float(PROBLEM.V.norm(exact.u))
    # off the solution along a direction of V with λ kept and no penetration, the bound is residual over coercivity
    known, free = stability(mu), np.zeros_like(exact.lam)
    u = active_set.solve_high_fidelity(replace(vi, g=vi.g + 10.0)).u  # no contact
    found = bound(PROBLEM, replace(vi, f=2.0 * vi.f, g=vi.g + 10.0), known, u, free)
    assert found.u == pytest.approx(float(np.linalg.norm(PROBLEM.V.whiten_functional(vi.f))) / known.coercivity.value)


def test_each_constant_enters_where_the_derivation_says() -> None:
    """One dimension, one constraint u ≤ 0 (b = 1), f = 1: u = 0 and λ = 1; worked out by hand."""
    V = W = space(1)
    x = float(V.matrix.toarray()[0, 0])

    scalar = Varying()
    scalar.V, scalar.W = V, W
    vi = VariationalInequality(sp.csc_array([[2.0]]), np.ones(1), sp.csr_array([[1.0]]), np.zeros(1))
    alpha, gamma, beta = 2.0 / x, 2.0 / x, 1.0 / x
    u, lam = np.array([0.1]), np.array([0.5])
    found = bound(scalar, vi, by_hand(beta, alpha, gamma), u, lam)
    residual, penetration = abs(1.0 - 2.0 * 0.1 - 0.5) / np.sqrt(x), 0.1 / np.sqrt(x)
    mismatch = 0.1 * 0.5  # ⟨π, λ⟩, and −sᵀλ is negative
    c1 = (residual + penetration * gamma / beta) / (2.0 * alpha)
    expected = c1 + np.sqrt(c1**2 + (penetration * residual / beta + mismatch) / alpha)
    assert found.u == pytest.approx(expected)
    assert found.lam == pytest.approx((residual + gamma * expected) / beta)
    inside = bound(scalar, vi, by_hand(beta, alpha, gamma), -u, lam)
    residual, mismatch = abs(1.0 + 2.0 * 0.1 - 0.5) / np.sqrt(x), 0.1 * 0.5  # π = 0, −sᵀλ = 0.05
    c1 = residual / (2.0 * alpha)
    assert inside.u == pytest.approx(c1 + np.sqrt(c1**2 + mismatch / alpha))


def test_nothing_is_certified_without_stability_or_outside_the_cone() -> None:
    mu = np.array([0.2])
    vi, known = PROBLEM.assemble(mu), stability(mu)
    exact = active_set.solve_high_fidelity(vi)
    unstable = replace(known, inf_sup=InfSup(0.0, 0.0, 0.1, ""))
    found = bound(PROBLEM, vi, unstable, exact.u, exact.lam)
    assert (found.u, found.lam) == (np.inf, np.inf)
    assert bound(PROBLEM, vi, known, exact.u, exact.lam - 1e-3) is None


def test_errors_are_those_defined_and_only_zero_is_zero() -> None:
    problem = Varying()
    mu = np.array([0.5])
    vi = problem.assemble(mu)
    exact = active_set.solve_high_fidelity(vi)
    reference = ReferenceSolutions(exact.u[:, None], exact.lam[:, None], 0.0, 0.0)
    rng = np.random.default_rng(0)
    du, dlam = 1e-3 * rng.standard_normal(30), 1e-2 * rng.standard_normal(8)
    (found,) = errors(problem, [vi], [energy(vi)], reference, (exact.u + du)[:, None], (exact.lam + dlam)[:, None])
    X, Y, A = problem.V.matrix, problem.W.matrix, vi.A
    assert np.isclose(found.error_u, np.sqrt((du @ (X @ du)) / (exact.u @ (X @ exact.u))))
    assert np.isclose(found.error_lambda, np.sqrt((dlam @ (Y @ dlam)) / (exact.lam @ (Y @ exact.lam))))
    assert np.isclose(found.error_u_energy, np.sqrt((du @ (A @ du)) / (exact.u @ (A @ exact.u))))
    assert np.isclose(found.error_u_energy_absolute, np.sqrt(du @ (A @ du)))
    natural, of_lam = (np.sqrt(b @ np.linalg.solve(A.toarray(), b)) for b in (vi.B.T @ dlam, vi.B.T @ exact.lam))
    assert np.isclose(found.error_lambda_natural, natural / of_lam)
    assert np.isclose(found.error_lambda_natural_absolute, natural)
    integrals = Y @ np.ones(8)
    assert np.isclose(found.violation, max(0.0, np.max((vi.B @ (exact.u + du) - vi.g) / integrals)))
    assert np.isclose(found.complementarity, exact.lam @ (vi.B @ du), atol=1e-12)
    (nothing,) = errors(problem, [vi], [energy(vi)], reference, exact.u[:, None], exact.lam[:, None])
    assert (nothing.error_u, nothing.error_lambda, nothing.error_u_energy) == (0.0, 0.0, 0.0)
    assert nothing.violation < 1e-10
    lam = np.column_stack([np.zeros(8), 1e-30 * np.ones(8)])
    reference = ReferenceSolutions(np.zeros((30, 2)), lam, 0.0, 0.0)
    found = errors(problem, [vi, vi], [energy(vi)] * 2, reference, np.zeros((30, 2)), np.zeros((8, 2)))
    assert [(one.error_u, one.error_lambda) for one in found] == [(None, None), (None, 1.0)]


@given(st.floats(-12.0, 3.0), st.floats(-12.0, 3.0), st.floats(-20.0, 20.0), st.integers(0, 1000))
def test_what_is_zero_beside_the_training_set_has_no_relative_error(share_u, share_lam, unit, seed) -> None:
    """Whatever the unit: its error on the scale of the training set is known, as that of any other."""
    # At the limit itself round-off decides.
    assume(all(abs(share + 8.0) > 1e-9 for share in (share_u, share_lam)))
    problem, rng = Varying(), np.random.default_rng(seed)
    vi = problem.assemble(np.array([0.5]))
    u, lam, du, dlam = (10.0**unit * rng.random((size, 1)) for size in (30, 8, 30, 8))
    scale_u, scale_lam = float(problem.V.norm(u)[0]), float(problem.W.norm(lam)[0])
    reference = ReferenceSolutions(10.0**share_u * u, 10.0**share_lam * lam, scale_u, scale_lam)
    (found,) = errors(problem, [vi], [energy(vi)], reference, reference.u + du, reference.lam + dlam)
    for name, share, error, scale in (
        ("u", share_u, float(problem.V.norm(du)[0]), scale_u),
        ("lambda", share_lam, float(problem.W.norm(dlam)[0]), scale_lam),
    ):
        relative = getattr(found, f"error_{name}")
        assert (relative is None) == (10.0**share <= UNMEASURABLE)
        assert relative is None or relative == pytest.approx(error / (10.0**share * scale))
        assert getattr(found, f"error_{name}_scaled") == pytest.approx(error / scale)
        assert getattr(found, f"error_{name}_absolute") == pytest.approx(error)
    assert (found.error_u_energy is None) == (found.error_u is None)
    assert (found.error_lambda_natural is None) == (found.error_lambda is None)


def test_errors_and_bounds_of_many_queries_are_those_of_each() -> None:
    problem, rng = Varying(), np.random.default_rng(3)
    mus = [np.array([value]) for value in (0.1, 0.5, 0.9)]
    vis = [problem.assemble(mu) for mu in mus]
    exact = [active_set.solve_high_fidelity(vi) for vi in vis]
    solutions = (np.column_stack([getattr(s, name) for s in exact]) for name in ("u", "lam"))
    reference = ReferenceSolutions(*solutions, 0.0, 0.0)
    u = reference.u + 1e-3 * rng.standard_normal(reference.u.shape)
    lam = reference.lam + 1e-2 * rng.random(reference.lam.shape)
    cone = nodal_cone(problem.W)
    known = []
    for vi in vis:
        ends = coercivity_and_continuity(vi.A, problem.V)
        known.append(Stability(inf_sup_full(problem.V, vi.B, cone), *ends, energy_inf_sup(vi.A, vi.B, problem.W)))

    def of_queries(which: list[int]) -> list[tuple[Any, ...]]:
        some, stable, energies = ([of[k] for k in which] for of in (vis, known, [energy(vi) for vi in vis]))
        given = u[:, which], lam[:, which]
        of_error = errors(problem, some, energies, reference.restrict(which), *given)
        proved = [(one.coercivity, one.energy_inf_sup) for one in stable]
        of_bound = error_bounds(problem.V, some, energies, proved, *given), hsw_bounds(problem, some, stable, *given)
        return list(zip(of_error, *of_bound, strict=True))

    for k, together in enumerate(of_queries([0, 1, 2])):
        for found, expected in zip(together, *of_queries([k]), strict=True):
            assert getattr(found, "note", "") == getattr(expected, "note", "")
            numbers = [[value for value in astuple(one) if not isinstance(value, str)] for one in (found, expected)]
            assert numbers[0] == pytest.approx(numbers[1], rel=1e-10, abs=1e-12)


def test_constants_shared_by_proportional_matrices_are_those_of_each() -> None:
    problem = Varying()
    B = problem.assemble(np.array([0.2])).B
    chi = np.random.default_rng(0).random((8, 3))
    cone = cone_basis(chi / problem.W.norm(chi), problem.W)
    Z = problem.V.orthonormalise(np.random.default_rng(1).standard_normal((30, 5)))
    matrices = [B, sp.csr_array(-3.0 * B), problem.assemble(np.array([0.9])).B]
    classes = constraint_classes(matrices)
    for found, matrix in zip(constants_on(Z, classes, cone), matrices, strict=True):
        direct = inf_sup_on(Z, matrix, cone)
        assert np.isclose(found.span, direct.span)
        assert np.isclose(found.cone_upper, direct.cone_upper)
    for found, matrix in zip(constants_full(problem.V, classes, cone), matrices, strict=True):
        assert np.isclose(found.cone_lower, inf_sup_full(problem.V, matrix, cone).cone_lower)
