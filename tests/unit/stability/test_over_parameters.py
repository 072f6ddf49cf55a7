from dataclasses import astuple

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import assume, given
from hypothesis import strategies as st
from numerics import Varying

from vibench.highfidelity import active_set
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.problem import VariationalInequality
from vibench.model.error_bounds import error_bounds
from vibench.model.errors import UNMEASURABLE, EnergyNorm, ReferenceSolutions, errors
from vibench.model.hsw_bounds import hsw_bounds
from vibench.reduction.supremizers import constraint_classes
from vibench.stability.coercivity import Stability, coercivity_and_continuity, energy_inf_sup
from vibench.stability.infsup import cone_basis, constants_full, constants_on, inf_sup_full, inf_sup_on, nodal_cone


def energy(vi: VariationalInequality) -> EnergyNorm:
    return EnergyNorm(vi.A, CondensedStiffness(vi.A))


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
    vi = problem.assemble(np.array([0.5]))
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
    energies = [energy(vi) for vi in vis]
    together = (
        errors(problem, vis, energies, reference, u, lam),
        error_bounds(problem.V, vis, energies, known, u, lam),
        hsw_bounds(problem, vis, known, u, lam),
    )
    for k, vi in enumerate(vis):
        own = [energies[k]], u[:, [k]], lam[:, [k]]
        alone = (
            errors(problem, [vi], own[0], reference.restrict([k]), *own[1:])[0],
            error_bounds(problem.V, [vi], own[0], [known[k]], *own[1:])[0],
            hsw_bounds(problem, [vi], [known[k]], *own[1:])[0],
        )
        for found, expected in zip(together, alone, strict=True):
            assert getattr(found[k], "note", "") == getattr(expected, "note", "")
            numbers = [[value for value in astuple(one) if not isinstance(value, str)] for one in (found[k], expected)]
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
