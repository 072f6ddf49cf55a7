from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from numerics import Varying
from vibench import highfidelity
from vibench.assess import Reference, constants_full, constants_on, errors
from vibench.infsup import inf_sup_full, inf_sup_on, multipliers


def test_errors_as_defined() -> None:
    problem = Varying()
    mu = np.array([0.5])
    vi = problem.assemble(mu)
    exact = highfidelity.solve(vi)
    reference = Reference(exact.u, exact.lam, 0.0, 0.0)
    rng = np.random.default_rng(0)
    du, dlam = 1e-3 * rng.standard_normal(30), 1e-2 * rng.standard_normal(8)
    found = errors(problem, vi, reference, exact.u + du, exact.lam + dlam)
    X, Y, A = problem.V.matrix, problem.W.matrix, vi.A
    assert np.isclose(found.u, np.sqrt((du @ (X @ du)) / (exact.u @ (X @ exact.u))))
    assert np.isclose(found.lam, np.sqrt((dlam @ (Y @ dlam)) / (exact.lam @ (Y @ exact.lam))))
    assert np.isclose(found.energy, np.sqrt((du @ (A @ du)) / (exact.u @ (A @ exact.u))))
    integrals = Y @ np.ones(8)
    assert np.isclose(found.violation, max(0.0, np.max((vi.B @ (exact.u + du) - vi.g) / integrals)))
    assert np.isclose(found.complementarity, exact.lam @ (vi.B @ du), atol=1e-12)
    nothing = errors(problem, vi, reference, exact.u, exact.lam)
    assert (nothing.u, nothing.lam, nothing.energy) == (0.0, 0.0, 0.0)
    assert nothing.violation < 1e-10


def test_a_solution_below_the_floor_is_measured_against_the_floor() -> None:
    problem = Varying()
    vi = problem.assemble(np.array([0.5]))
    lam = np.zeros(8)
    lam[0] = 1e-3
    found = errors(problem, vi, Reference(np.zeros(30), np.zeros(8), 1.0, 2.0), np.zeros(30), lam)
    assert np.isclose(found.lam, float(problem.W.norm(lam)) / 2.0)


def test_constants_shared_by_proportional_matrices_are_those_of_each() -> None:
    problem = Varying()
    B = problem.assemble(np.array([0.2])).B
    chi = np.random.default_rng(0).random((8, 3))
    cone = multipliers(chi / problem.W.norm(chi), problem.W)
    Z = problem.V.orthonormalise(np.random.default_rng(1).standard_normal((30, 5)))
    matrices = [B, sp.csr_array(-3.0 * B), problem.assemble(np.array([0.9])).B]
    for found, matrix in zip(constants_on(Z, matrices, cone), matrices, strict=True):
        direct = inf_sup_on(Z, matrix, cone)
        assert np.isclose(found.span, direct.span)
        assert np.isclose(found.cone_upper, direct.cone_upper)
    for found, matrix in zip(constants_full(problem.V, matrices, cone), matrices, strict=True):
        assert np.isclose(found.cone_lower, inf_sup_full(problem.V, matrix, cone).cone_lower)
