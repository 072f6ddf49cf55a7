"""High-fidelity solutions timed as the sweep over the validation set makes them: what one more of them costs.

What else uses a machine changes its speed within tenths of a second. Solutions therefore alternate with the queries
that they are compared with.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vibench.arrays import Mask
from vibench.errors import NumericalError
from vibench.highfidelity.active_set import HighFidelitySolver, solve_unverified
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly
from vibench.qp.scaling import nearby
from vibench.stages.snapshots import TimedSnapshots
from vibench.study.parameter_sets import chunk_edges
from vibench.timing import Seconds, timed

ENOUGH = 0.05
"""CPU seconds of high-fidelity solutions beside the queries of a cell in one round after which there is no further."""

LONG = 0.1
"""CPU seconds from which on a solution averages over what changes the speed of the machine: one is enough for a
round, and counts for all cells in it."""

SOLUTION_SEED = 2
"""First of the seeds of solutions in a round: those of the queries beside them are smaller, so that no parameter is the
same."""

ASSEMBLY_SEED = 5
"""First of the seeds of assemblies that belong to no solution: there are at most three solutions."""

SAME = 1e-6
"""Largest distance of a solution next to a parameter from that at it, relative to the largest solution."""


@lru_cache(maxsize=1)
def _solver_of(problem: Problem) -> HighFidelitySolver:
    """The solver of the problem that this process works on, with its set-up once that is done."""
    return HighFidelitySolver(problem)


class MarginalSolutions:
    """Solutions of a problem at its validation parameters, after the set-up.

    Each starts from the contact set of the nearest parameter before its own in the same part of the sweep, the first
    one of a part from that of the nearest after it: to start from none, which takes several times as long, happens
    once, however many solutions follow, and is part of the set-up. Each is solved at a parameter next to its own. The
    first one in a process does the set-up.
    """

    def __init__(self, problem: Problem, reference: TimedSnapshots, seed: int) -> None:
        self._problem, self._mus, self._u, self._seed = problem, reference.mu, reference.u, seed
        self._solver, self._starts = _solver_of(problem), list(_starts(problem, reference))
        self._allowed = SAME * float(np.max(problem.V.norm(reference.u), initial=0.0))

    def solve(self, number: int, *seed: int) -> MarginalSolution:
        """One solution, its assembly included; another parameter next to its own for every seed.

        There are no seconds if it is not that of this parameter, or if there is none.
        """
        assembled = self.assemble(number, *seed)
        vi = assembled.vi
        try:
            solution, rest = timed(lambda: solve_unverified(vi, self._solver.condensed(vi), self._starts[number]))
        except NumericalError:
            return assembled
        distance = float(self._problem.V.norm(solution.u - self._u[:, number]))
        return assembled._replace(seconds=assembled.assembly + rest) if distance <= self._allowed else assembled

    def assemble(self, number: int, *seed: int) -> MarginalSolution:
        """What is assembled for a solution, without it."""
        mu = nearby(self._problem.parameters, self._mus[number], self._seed, number, *seed)
        return MarginalSolution(number, *timed(partial(checked_assembly, self._problem, mu)), None)


class MarginalSolution(NamedTuple):
    """A high-fidelity solution that was timed."""

    number: int
    """That of its validation parameter."""
    vi: VariationalInequality
    """What was assembled next to that parameter; the next assembly may be written into the same arrays."""
    assembly: Seconds
    seconds: Seconds | None
    """Those of the whole solution; `None` of one that is not the right one."""


class SolutionsBeside:
    """High-fidelity solutions beside the queries of cells in rounds.

    `sweep` (P,) are CPU seconds of all solutions, as the sweep over the validation set measured them.
    """

    def __init__(self, marginal: MarginalSolutions, sweep: Sequence[float]) -> None:
        self._marginal, self._sweep = marginal, np.asarray(sweep)
        self._long: dict[int, MarginalSolution] = {}

    def alternated(
        self, order: Sequence[int], done: list[MarginalSolution], at: int, cell: int
    ) -> Iterator[tuple[int, MarginalSolution | None]]:
        """The queries `order` of a cell in a round, each with the solution that was made before it, if there is one.

        There is one before the first query, one before that in the middle, and one after the last query, unless fewer
        are enough. They are added to `done`.
        """
        for place, k in enumerate(order):
            yield k, self._next(done, k, at, cell) if place in (0, len(order) // 2) else None
        self._next(done, order[-1], at, cell)

    def _next(self, done: list[MarginalSolution], k: int, at: int, cell: int) -> MarginalSolution | None:
        if sum(one.seconds.cpu for one in done if one.seconds) > ENOUGH:
            return None
        one = self._long.get(at) or self._marginal.solve(k, at, cell, SOLUTION_SEED + len(done))
        if one.seconds and one.seconds.cpu > LONG and at not in self._long:
            self._long = {at: one._replace(vi=one.vi.copy())}
        done.append(one)
        return one

    def seconds(self, done: Sequence[MarginalSolution], part: Sequence[int]) -> Seconds | None:
        """Mean seconds of solutions at the parameters of a part, from those of some and the sweep; `None` of none."""
        right = [(one.number, one.seconds) for one in done if one.seconds is not None]
        if not right:
            return None
        share = float(self._sweep[list(part)].mean() / self._sweep[[k for k, _ in right]].mean()) / len(right)
        return Seconds(share * sum(s.cpu for _, s in right), share * sum(s.wall for _, s in right))


def _starts(problem: Problem, reference: TimedSnapshots) -> Iterator[Mask]:
    """The contact set (m,) that each solution starts from: that of the nearest before it in its part of the sweep.

    The first of a part starts from that of the nearest after it, or from its own where it is the only one.
    """
    box = problem.parameters
    width = np.maximum(box.upper - box.lower, np.finfo(float).tiny)
    for first, end in pairwise(chunk_edges(len(reference.mu))):
        for k in range(first, end):
            others = slice(first, k) if k > first else slice(min(first + 1, end - 1), end)
            distances = np.linalg.norm((reference.mu[others] - reference.mu[k]) / width, axis=1)
            yield reference.lam[:, others][:, int(np.argmin(distances))] > 0.0


def parts_alike(seconds: Sequence[float], parts: int) -> tuple[tuple[int, ...], ...]:
    """Numbers of solutions dealt out to parts that take about as long: the slowest first, there and back."""
    order, dealt = np.argsort(-np.asarray(seconds), kind="stable"), [*range(parts), *reversed(range(parts))]
    where = [dealt[place % len(dealt)] for place in range(len(order))]
    return tuple(
        tuple(sorted(int(k) for k, at in zip(order, where, strict=True) if at == part)) for part in range(parts)
    )
