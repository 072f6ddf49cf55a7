"""The obstacle problem at the paper's size: dimensions and stability beside what the paper reports."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from vibench import DualStrategy, HighFidelitySolver, Offline, ReducedSet, Stop, pod
from vibench.reduction.cones import orthogonality
from vibench.stability.infsup import cone_basis, inf_sup_full, inf_sup_on, nodal_cone
from vibench_problems.obstacle import Obstacle
from vibench_strategies.cpg import CPG
from vibench_strategies.mcpg import ModifiedCPG
from vibench_strategies.offline_pga import OfflinePGA

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def training() -> tuple[Obstacle, np.ndarray, np.ndarray]:
    problem = Obstacle("paper")
    solver = HighFidelitySolver(problem)
    solutions = [solver.solve(mu) for mu in problem.training_set()]
    assert max(s.residuals.worst for s in solutions) <= 1e-10
    assert all(s.fallback == "" for s in solutions)
    u, lam = np.column_stack([s.u for s in solutions]), np.column_stack([s.lam for s in solutions])
    for shared in (u, lam):
        shared.setflags(write=False)
    return problem, u, lam


@pytest.fixture(scope="module")
def cone(training) -> Callable[[type[DualStrategy], float], ReducedSet]:
    """Function that gives the cone of a dual strategy at a tolerance; several tests look at the same one."""
    problem, _, lam = training

    @cache
    def of(strategy: type[DualStrategy], tolerance: float) -> ReducedSet:
        found = strategy().reduce(lam, problem.W, Stop(tolerance=tolerance))
        found.generators.setflags(write=False)
        return found

    return of


@pytest.mark.parametrize(("tolerance", "published"), [(1e-3, 19), (1e-4, 51), (1e-6, 89)])
def test_pod_dimensions_are_near_the_published_ones(training, tolerance: float, published: int) -> None:
    problem, u, _ = training
    assert pod(u, problem.V, Stop(tolerance=tolerance)).basis.shape[1] == pytest.approx(published, rel=0.35)


@pytest.mark.parametrize(("tolerance", "published"), [(1e-2, 50), (1e-3, 70)])
def test_cone_dimensions_are_near_the_published_ones(training, cone, tolerance: float, published: int) -> None:
    problem = training[0]
    plain, modified = cone(CPG, tolerance), cone(ModifiedCPG, tolerance)
    assert modified.size == pytest.approx(published, rel=0.25)
    assert modified.size <= plain.size
    assert modified.fallbacks == ()
    common = slice(1, modified.size)
    medians = [np.median(orthogonality(found.generators, problem.W)[common]) for found in (plain, modified)]
    assert medians[1] > medians[0]  # Figure 6
    found = cone(ModifiedCPG, 1e-6)  # it reaches the end without a fallback
    assert found.errors[-1] <= 1e-6
    assert found.fallbacks == ()


def test_stability_of_the_pair_where_span_and_cone_differ(training, cone) -> None:
    """N < R: no stability over the span without enrichment, but over the cone, where it is known exactly."""
    problem, u, _ = training
    basis = pod(u, problem.V, Stop(tolerance=1e-3)).basis
    chi = cone(ModifiedCPG, 1e-2)
    prepared = cone_basis(chi.generators, problem.W)
    B = problem.assemble(np.array([1.0, 0.0, 0.0])).B
    plain, full = inf_sup_on(basis, B, prepared), inf_sup_full(problem.V, B, prepared)
    hf = inf_sup_full(problem.V, B, nodal_cone(problem.W))
    assert plain.span == 0.0
    assert 0.01 < plain.cone_lower <= plain.cone_upper < 0.03
    assert plain.cone_upper - plain.cone_lower < 0.01 * plain.cone_upper
    assert 0.002 < hf.span < full.span < 0.01
    offline = Offline(problem, basis, chi, prepared.span, problem.training_set())
    added = OfflinePGA().build(offline, 0.6).vectors
    own = inf_sup_on(np.hstack([basis, added]), B, prepared)
    assert 0.8 * full.span * (1.0 - 1e-9) <= own.span <= full.span * (1.0 + 1e-9)
    assert added.shape[1] < prepared.rank


def test_nearly_parallel_generators_of_the_plain_greedy_keep_the_online_constant(training, cone) -> None:
    """Supremizers of the generators themselves lost directions here: β_on came out at 1e-7 instead of 1e-3."""
    problem, u, _ = training
    basis = pod(u, problem.V, Stop(tolerance=1e-4)).basis
    prepared = cone_basis(cone(CPG, 1e-3).generators, problem.W)
    assert prepared.rank < prepared.chi.shape[1]
    B = problem.assemble(np.array([1.0, 0.0, 0.0])).B
    V = problem.V
    Z = np.hstack([basis, V.orthonormalise(V.riesz(np.asarray(B.T @ prepared.span)), basis)])
    assert inf_sup_on(Z, B, prepared).span == pytest.approx(inf_sup_full(V, B, prepared).span, rel=1e-8)
