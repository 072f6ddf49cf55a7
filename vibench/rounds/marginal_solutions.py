"""High-fidelity solutions timed as the sweep over the validation set makes them: what one more of them costs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import pairwise

import numpy as np

from vibench.arrays import Array, Mask
from vibench.errors import NumericalError
from vibench.highfidelity.active_set import ActiveSetSolution, HighFidelitySolver, solve_unverified
from vibench.interfaces.problem import Problem
from vibench.interfaces.validation import checked_assembly
from vibench.qp.repeats import nearby
from vibench.stages.snapshots import TimedSnapshots
from vibench.study.parameter_sets import chunk_edges
from vibench.timing import Seconds, timed

SAME = 1e-6
"""Largest distance of a solution next to a parameter from that at it, relative to the largest solution."""


@lru_cache(maxsize=1)
def _solver_of(problem: Problem) -> HighFidelitySolver:
    """The solver of the problem that this process works on, with its set-up once that is done."""
    return HighFidelitySolver(problem)


class MarginalSolutions:
    """Solutions of a problem at its validation parameters, after the set-up.

    Each starts from the contact set of the nearest parameter before its own in the same part of the sweep, as that
    does, and is solved at a parameter next to its own. The first one in a process does the set-up.
    """

    def __init__(self, problem: Problem, reference: TimedSnapshots, seed: int) -> None:
        self._problem, self._mus, self._u, self._seed = problem, reference.mu, reference.u, seed
        self._solver, self._starts = _solver_of(problem), list(_starts(problem, reference))
        self._allowed = SAME * float(np.max(problem.V.norm(reference.u), initial=0.0))

    def seconds(self, number: int, *seed: int) -> Seconds:
        """Seconds of one solution, its assembly included; another parameter next to its own for every seed.

        Raises a `NumericalError` if it is not that of this parameter.
        """
        mu = nearby(self._problem.parameters, self._mus[number], self._seed, number, *seed)
        solution, seconds = timed(partial(self._solved, mu, self._starts[number]))
        if not float(self._problem.V.norm(solution.u - self._u[:, number])) <= self._allowed:
            raise NumericalError(f"the timed high-fidelity solution {number} differs from the one that was verified")
        return seconds

    def _solved(self, mu: Array, start: Mask | None) -> ActiveSetSolution:
        vi = checked_assembly(self._problem, mu)
        return solve_unverified(vi, self._solver.condensed(vi), start)


def _starts(problem: Problem, reference: TimedSnapshots) -> Iterator[Mask | None]:
    """The contact set (m,) that each solution of the sweep starts from; `None` for the first ones of its parts."""
    box = problem.parameters
    width = np.maximum(box.upper - box.lower, np.finfo(float).tiny)
    for first, end in pairwise(chunk_edges(len(reference.mu))):
        for k in range(first, end):
            distances = np.linalg.norm((reference.mu[first:k] - reference.mu[k]) / width, axis=1)
            yield reference.lam[:, first + int(np.argmin(distances))] > 0.0 if k > first else None


def parts_alike(seconds: Sequence[float], parts: int) -> tuple[tuple[int, ...], ...]:
    """Numbers of solutions dealt out to parts that take about as long: the slowest first, there and back."""
    order, dealt = np.argsort(-np.asarray(seconds), kind="stable"), [*range(parts), *reversed(range(parts))]
    where = [dealt[place % len(dealt)] for place in range(len(order))]
    return tuple(
        tuple(sorted(int(k) for k, at in zip(order, where, strict=True) if at == part)) for part in range(parts)
    )
