from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
import scipy.sparse as sp
from numerics import Varying

from vibench.highfidelity import active_set
from vibench.model.error_bounds import Stability, bounds, extreme_quotients
from vibench.model.errors import Reference, errors
from vibench.reduction.supremizers import constraint_classes
from vibench.stability.infsup import inf_sup_full, inf_sup_on, multipliers, nodal_multipliers
from vibench.stability.over_parameters import constants_full, constants_on


def test_errors_as_defined() -> None:
    problem = Varying()
    mu = np.array([0.5])
    vi = problem.assemble(mu)
    exact = active_set.solve_high_fidelity(vi)
    reference = Reference(exact.u[:, None], exact.lam[:, None], 0.0, 0.0)
    rng = np.random.default_rng(0)
    du, dlam = 1e-3 * rng.standard_normal(30), 1e-2 * rng.standard_normal(8)
    (found,) = errors(problem, [vi], reference, (exact.u + du)[:, None], (exact.lam + dlam)[:, None])
    X, Y, A = problem.V.matrix, problem.W.matrix, vi.A
    assert np.isclose(found.error_u, np.sqrt((du @ (X @ du)) / (exact.u @ (X @ exact.u))))
    assert np.isclose(found.error_lambda, np.sqrt((dlam @ (Y @ dlam)) / (exact.lam @ (Y @ exact.lam))))
    assert np.isclose(found.error_energy, np.sqrt((du @ (A @ du)) / (exact.u @ (A @ exact.u))))
    integrals = Y @ np.ones(8)
    assert np.isclose(found.violation, max(0.0, np.max((vi.B @ (exact.u + du) - vi.g) / integrals)))
    assert np.isclose(found.complementarity, exact.lam @ (vi.B @ du), atol=1e-12)
    (nothing,) = errors(problem, [vi], reference, exact.u[:, None], exact.lam[:, None])
    assert (nothing.error_u, nothing.error_lambda, nothing.error_energy) == (0.0, 0.0, 0.0)
    assert nothing.violation < 1e-10


def test_a_solution_below_the_floor_is_measured_against_the_floor() -> None:
    problem = Varying()
    vi = problem.assemble(np.array([0.5]))
    u, lam = np.zeros((30, 1)), np.zeros((8, 1))
    lam[0] = 1e-3
    (found,) = errors(problem, [vi], Reference(u, 0.0 * lam, 1.0, 2.0), u, lam)
    assert np.isclose(found.error_lambda, float(problem.W.norm(lam)[0]) / 2.0)


def test_errors_and_bounds_of_many_queries_are_those_of_each() -> None:
    problem, rng = Varying(), np.random.default_rng(3)
    mus = [np.array([value]) for value in (0.1, 0.5, 0.9)]
    vis = [problem.assemble(mu) for mu in mus]
    exact = [active_set.solve_high_fidelity(vi) for vi in vis]
    reference = Reference(np.column_stack([s.u for s in exact]), np.column_stack([s.lam for s in exact]), 0.0, 0.0)
    u = reference.u + 1e-3 * rng.standard_normal(reference.u.shape)
    lam = reference.lam + 1e-2 * rng.random(reference.lam.shape)
    cone = nodal_multipliers(problem.W)
    known = [Stability(inf_sup_full(problem.V, vi.B, cone), *extreme_quotients(vi.A, problem.V)) for vi in vis]
    together, certified = errors(problem, vis, reference, u, lam), bounds(problem, vis, known, u, lam)
    for k, vi in enumerate(vis):
        (alone,) = errors(problem, [vi], reference.at([k]), u[:, [k]], lam[:, [k]])
        assert astuple(together[k]) == pytest.approx(astuple(alone), rel=1e-10, abs=1e-12)
        (bound,) = bounds(problem, [vi], [known[k]], u[:, [k]], lam[:, [k]])
        assert certified[k] is not None
        assert astuple(certified[k]) == pytest.approx(astuple(bound), rel=1e-10)


def test_constants_shared_by_proportional_matrices_are_those_of_each() -> None:
    problem = Varying()
    B = problem.assemble(np.array([0.2])).B
    chi = np.random.default_rng(0).random((8, 3))
    cone = multipliers(chi / problem.W.norm(chi), problem.W)
    Z = problem.V.orthonormalise(np.random.default_rng(1).standard_normal((30, 5)))
    matrices = [B, sp.csr_array(-3.0 * B), problem.assemble(np.array([0.9])).B]
    classes = constraint_classes(matrices)
    for found, matrix in zip(constants_on(Z, classes, cone), matrices, strict=True):
        direct = inf_sup_on(Z, matrix, cone)
        assert np.isclose(found.span, direct.span)
        assert np.isclose(found.cone_upper, direct.cone_upper)
    for found, matrix in zip(constants_full(problem.V, classes, cone), matrices, strict=True):
        assert np.isclose(found.cone_lower, inf_sup_full(problem.V, matrix, cone).cone_lower)
