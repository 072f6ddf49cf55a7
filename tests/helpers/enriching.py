"""Test data of the primal strategies: a reduced setting, and greedy choices without laziness."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vibench import Cone, LazyMaximum, Offline, no_free
from vibench.highfidelity.active_set import HighFidelitySolver
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


class Plain(LazyMaximum):
    """Evaluates everything at every step."""

    def next(self, evaluate: Callable[[int], float]) -> tuple[int, float]:
        self.bound(np.array([evaluate(p) for p in range(len(self._bounds))]))
        return super().next(lambda p: float(self._bounds[p]))
