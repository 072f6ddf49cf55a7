"""Test data of the primal strategies: a reduced setting, and greedy choices without laziness."""

from collections.abc import Callable

import numpy as np

from vibench import Kind, Offline, Problem, ReducedSet, Reduction, Stop, no_free
from vibench.model.galerkin import ReducedModel
from vibench.offline.reduction import high_fidelity_sweep
from vibench.reduction import LazyMaximum
from vibench.stability import cone_basis
from vibench_strategies.cpg import CPG
from vibench_strategies.online_supremizers import OnlineSupremizers


def offline(problem: Problem, count: int, modes: int, generators: int) -> Offline:
    training = problem.training_set()
    solved = high_fidelity_sweep(problem, training[:: max(1, len(training) // count)])
    basis = problem.V.orthonormalise(solved.u)[:, :modes]
    chi = solved.lam[:, :generators] / problem.W.norm(solved.lam[:, :generators])
    cone = ReducedSet(chi, np.ones(1), no_free(generators))
    return Offline(problem, basis, cone, cone_basis(chi, problem.W).span, training)


def reduced_from(problem: Problem, kind: Kind, modes: int, generators: int) -> ReducedModel:
    """A reduced model from all training solutions, without enrichment or with supremizers at every parameter."""
    primal = OnlineSupremizers() if kind is Kind.PER_PARAMETER else None
    return Reduction(problem, CPG(), primal, Stop(size=modes), Stop(size=generators)).projection


class Plain(LazyMaximum):
    def next(self, evaluate: Callable[[int], float]) -> tuple[int, float]:
        self.bound(np.array([evaluate(p) for p in range(len(self._bounds))]))
        return super().next(lambda p: float(self._bounds[p]))
