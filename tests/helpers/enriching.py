"""Test data of the primal strategies: a reduced setting, and greedy choices without laziness."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vibench import Cone, Enrichment, Kind, Offline, Problem, Stop, greedy_cone, no_free, pod
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.model.galerkin import ReducedModel
from vibench.reduction import LazyMaximum
from vibench.stability.infsup import multipliers


def offline(problem, count: int, modes: int, generators: int) -> Offline:
    """A reduced setting from some training solutions."""
    training = problem.training_set()
    solver = HighFidelitySolver(problem)
    solved = [solver.solve(mu) for mu in training[:: max(1, len(training) // count)]]
    u, lam = np.column_stack([s.u for s in solved]), np.column_stack([s.lam for s in solved])
    basis = problem.V.orthonormalise(u)[:, :modes]
    chi = lam[:, :generators] / problem.W.norm(lam[:, :generators])
    cone = Cone(chi, np.ones(1), no_free(generators))
    return Offline(problem, basis, cone, multipliers(chi, problem.W).span, training)


def reduced_from(problem: Problem, kind: Kind, modes: int, generators: int) -> ReducedModel:
    """A reduced model from all training solutions, without enrichment or with supremizers at every parameter."""
    solver = HighFidelitySolver(problem)
    solved = [solver.solve(mu) for mu in problem.training_set()]
    basis = pod(np.column_stack([s.u for s in solved]), problem.V, Stop(size=modes)).basis
    cone = greedy_cone(np.column_stack([s.lam for s in solved]), problem.W, Stop(size=generators))
    span = multipliers(cone.generators, problem.W).span
    enrichment = Enrichment(kind, eta=span if kind is Kind.PER_PARAMETER else None)
    return ReducedModel(problem, basis, enrichment, cone.generators, span)


class Plain(LazyMaximum):
    """Evaluates everything at every step."""

    def next(self, evaluate: Callable[[int], float]) -> tuple[int, float]:
        self.bound(np.array([evaluate(p) for p in range(len(self._bounds))]))
        return super().next(lambda p: float(self._bounds[p]))
