"""Stiff problems, dependent rows, contact nearly everywhere: short versions of `tests/benchmarks/hard_cases.py`."""

from collections.abc import Callable
from functools import partial
from itertools import product
from math import inf
from unittest import mock

import pytest
from decimals import ExactProgram, relative_errors
from hard_problems import Beam, DoubleObstacle, Floating, Truss
from other_problems import Covered, ThermalBlock, Torsion
from samples import pga_reduction

from vibench import AffineProblem, HighFidelitySolver, InnerProduct
from vibench.linalg.cholesky import PartialCholesky
from vibench.linalg.definite import BlockDiagonal
from vibench.model.certificates.base import Guarantee
from vibench.model.error_bounds import bound_errors_at, corrected_pair
from vibench.offline.assemblies import assemblies
from vibench.stability.coercivity import Constant
from vibench_problems.american_put import Put
from vibench_problems.bearing import Bearing

Make = Callable[[int], AffineProblem]


@pytest.mark.parametrize(("make", "size"), [(Beam, 40), (Truss, 40), (DoubleObstacle, 50)])
def test_solutions_are_those_of_a_hundred_digits(make: Make, size: int) -> None:
    problem = make(size)
    for mu in problem.parameters.sample(3, 1):
        found = HighFidelitySolver(problem).solve(mu)
        assert max(relative_errors(problem.assemble(mu), found.u, found.lam)) <= 1e-10


def test_condensation_loses_nothing_of_a_stiff_problem() -> None:
    """A truss of 320 bays, whose condensed solutions had natural residuals of 1e-4 to 1e-8 however they were refined.

    Its Schur complement was the square of a dense block of the sparse factor.
    """
    problem = Truss(320)
    solver = HighFidelitySolver(problem, condensing=True)
    for mu in problem.parameters.sample(3, 1):
        found = solver.solve(mu)
        assert found.residuals.worst <= 1e-10
        assert found.fallback == ""


def test_what_condensation_loses_is_won_back() -> None:
    problem, schur_blocks = Truss(40), PartialCholesky.schur_blocks

    def disturbed(factor: PartialCholesky) -> BlockDiagonal:
        """The Schur complement, so far from the right one that no refinement mends it."""
        return BlockDiagonal.of(1.5 * schur_blocks(factor).toarray())

    with mock.patch.object(PartialCholesky, "schur_blocks", disturbed):
        for mu in problem.parameters.sample(3, 1):
            found = HighFidelitySolver(problem, condensing=True).solve(mu)
            assert found.residuals.worst <= 1e-10
            assert found.fallback == "solved without condensation"


EVERYWHERE = [(Bearing, 40), (Put, 40), (partial(ThermalBlock, 3), 9), (Torsion, 10), (Covered, 8)]
"""Problems whose constraint touches most unknowns; the stiffness of the block has nine parameters."""
LONG = [
    pytest.param(*case, marks=pytest.mark.long)
    for case in [(Beam, 40), (DoubleObstacle, 50), *EVERYWHERE[:2], EVERYWHERE[4]]
]


@pytest.mark.parametrize(("make", "size"), [(Truss, 40), *EVERYWHERE[2:4], *LONG])
def test_certified_models_of_hard_problems_have_bounds_that_hold(make: Make, size: int) -> None:
    """At online cost and at that of the mesh, of the pair and of the corrected one."""
    problem = make(size)
    reduction = pga_reduction(problem, 1e-2, assembly="reduced", bounds=True)
    model, solver, kept = reduction.model, HighFidelitySolver(problem), assemblies(problem)
    for mu in problem.parameters.sample(5, 7):
        exact, found, corrected = solver.solve(mu), model.solve(mu), model.solve(mu, corrected=True)
        vi, energy = kept.at(mu), kept.energy_at(mu)
        assert found.status == "ok"
        whole = energy.norm(exact.u) + energy.dual_norm(vi.B.T @ exact.lam)
        pair = corrected_pair(vi, energy, found.u, found.lam)
        in_energy, unknown = InnerProduct(vi.A), (Constant(1.0, True), Constant(0.0, True))
        for (u, lam), bound in (
            ((found.u, found.lam), found.bound),
            ((corrected.u, corrected.lam), corrected.bound),
            ((found.u, found.lam), bound_errors_at(in_energy, vi, energy, *unknown, found.u, found.lam)),
            ((pair.u, pair.lam), bound_errors_at(in_energy, vi, energy, *unknown, pair.u, pair.lam)),
        ):
            assert getattr(bound, "guarantee", Guarantee.CERTIFIED) is Guarantee.CERTIFIED
            assert energy.norm(exact.u - u) <= bound.u_energy + 1e-9 * whole
            assert energy.dual_norm(vi.B.T @ (exact.lam - lam)) <= bound.lambda_natural + 1e-9 * whole
            assert bound.u_energy <= 10.0 * whole


@pytest.mark.parametrize(("springs", "varying"), [(1e-6, False), (1e-9, True), (1e-11, False), (1e-11, True)])
def test_online_bounds_hold_to_the_last_digit_of_a_nearly_singular_stiffness(springs: float, varying: bool) -> None:
    """From condition numbers of 1e10 on errors of λ were up to 3.5 times bounds that were called certified."""
    problem = Floating(springs, varying)
    model = pga_reduction(problem, 1e-3, assembly="reduced", bounds=True).model
    for mu, corrected in product(problem.parameters.sample(8, 1), (False, True)):
        program, found = ExactProgram(problem.assemble(mu)), model.solve(mu, corrected=corrected)
        errors = program.errors(program.solve(found.lam > 0.0), found.u, found.lam)
        assert errors[0] <= found.bound.u_energy < inf
        assert errors[1] <= found.bound.lambda_natural < inf
        # of a smaller share of the diagonal than 1e-10 round-off leaves no proof
        assert (found.bound.guarantee is Guarantee.CERTIFIED) or springs < 1e-9
