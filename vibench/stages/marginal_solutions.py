"""High-fidelity solutions timed as in the sweep over the validation set, alternated with queries."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from itertools import cycle, pairwise
from typing import NamedTuple

import numpy as np

from vibench.arrays import Array, Mask
from vibench.errors import NumericalError
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly
from vibench.qp.scaling import nearby
from vibench.stages.snapshots import TimedSnapshots
from vibench.study.parameter_sets import chunk_edges
from vibench.timing import Seconds, timed


@lru_cache(maxsize=1)
def _solver_of(problem: Problem) -> HighFidelitySolver:
    """The solver of the current problem of this process; its set-up is done once."""
    return HighFidelitySolver(problem)


class MarginalSolutions:
    """Solutions of a problem next to its validation parameters; the first one in a process does the set-up."""

    # Each starts from a contact set as in the sweep. A start from none takes several times as long but happens once,
    # however many solutions follow: it is part of the set-up.

    def __init__(self, problem: Problem, reference: TimedSnapshots, seed: int) -> None:
        self._problem, self._mus, self._u, self._seed = problem, reference.mu, reference.u, seed
        self._solver, self._starts = _solver_of(problem), list(_starts(problem, reference))
        # A solution next to a parameter differs from that at it by at most 1e-6 of the largest solution.
        self._allowed = 1e-6 * float(np.max(problem.V.norm(reference.u), initial=0.0))

    def solve(self, number: int, *seed: int) -> MarginalSolution:
        """One solution with its assembly, at another parameter next to its own for every seed."""
        # It has no seconds if it fails or differs from the solution of this parameter.
        assembled = self.assemble(number, *seed)
        mu, vi = self._next_to(number, *seed), assembled.vi
        try:
            # The problem may derive another start from that contact set, as it does in the sweep.
            solution, rest = timed(lambda: self._solver.solve_from(self._starts[number], mu, vi))
        except NumericalError:
            return assembled
        distance = float(self._problem.V.norm(solution.u - self._u[:, number]))
        return assembled._replace(seconds=assembled.assembly + rest) if distance <= self._allowed else assembled

    def assemble(self, number: int, *seed: int) -> MarginalSolution:
        """The assembly of a solution, without it."""
        mu = self._next_to(number, *seed)
        return MarginalSolution(number, *timed(partial(checked_assembly, self._problem, mu)), None)

    def _next_to(self, number: int, *seed: int) -> Array:
        return nearby(self._problem.parameters, self._mus[number], self._seed, number, *seed)


class MarginalSolution(NamedTuple):
    """A high-fidelity solution that was timed."""

    number: int  # number of its validation parameter
    # The matrices next to that parameter; the next assembly may be written into the same arrays.
    vi: VariationalInequality
    # `assembly`, `seconds`: seconds of the assembly and of the whole solution; `None` of a wrong one.
    assembly: Seconds
    seconds: Seconds | None


class SolutionsBeside:
    """High-fidelity solutions beside the queries of cells in rounds."""

    # `sweep` (P,) are CPU seconds of all solutions, as the sweep over the validation set measured them.

    def __init__(self, marginal: MarginalSolutions, sweep: Sequence[float]) -> None:
        self.marginal, self.sweep = marginal, np.asarray(sweep)
        self._long: dict[int, MarginalSolution] = {}

    def alternated(
        self, order: Sequence[int], done: list[MarginalSolution], at: int, cell: int
    ) -> Iterator[tuple[int, MarginalSolution | None]]:
        """The queries `order` of a cell in a round, each with the solution that was made before it, if there is one."""
        # Solutions are added to `done`.
        # Solve before the first query and before that in the middle, unless one is enough. A third solution would not
        # lower the scatter of gains, which is that of full assemblies, and took an eighth of a round.
        for place, k in enumerate(order):
            yield k, self._next(done, k, at, cell) if place in (0, len(order) // 2) else None

    def _next(self, done: list[MarginalSolution], k: int, at: int, cell: int) -> MarginalSolution | None:
        # 0.05 CPU seconds of solutions beside the queries of a cell are enough for a round.
        if sum(one.seconds.cpu for one in done if one.seconds) > 0.05:
            return None
        # Seeds of queries and warm-ups are 0 and 1: no two parameters of a round are the same.
        one = self._long.get(at) or self.marginal.solve(k, at, cell, 2 + len(done))
        # A solution of more than 0.1 s averages over the speed of the machine: it counts for all cells of a round.
        if one.seconds and one.seconds.cpu > 0.1 and at not in self._long:
            self._long = {at: one._replace(vi=one.vi.copy())}
        done.append(one)
        return one

    def seconds(self, done: Sequence[MarginalSolution], part: Sequence[int]) -> Seconds | None:
        """Mean seconds of solutions at the parameters of a part, from those of some and the sweep."""
        right = [(one.number, one.seconds) for one in done if one.seconds is not None]
        if not right:
            return None
        # The sweep tells how solutions at the other parameters of the part compare with these.
        factor = float(self.sweep[list(part)].mean() / self.sweep[[k for k, _ in right]].mean()) / len(right)
        return Seconds(factor * sum(s.cpu for _, s in right), factor * sum(s.wall for _, s in right))


def _starts(problem: Problem, reference: TimedSnapshots) -> Iterator[Mask]:
    """The contact set (m,) that each solution starts from: that of the nearest before it in its part of the sweep."""
    box = problem.parameters
    width = np.maximum(box.upper - box.lower, np.finfo(float).tiny)
    for first, end in pairwise(chunk_edges(len(reference.mu))):
        for k in range(first, end):
            # The first of a part starts from the nearest after it, or from its own where it is the only one.
            others = slice(first, k) if k > first else slice(min(first + 1, end - 1), end)
            distances = np.linalg.norm((reference.mu[others] - reference.mu[k]) / width, axis=1)
            yield problem.K.free(reference.lam[:, others][:, int(np.argmin(distances))])


def parts_alike(seconds: Array, parts: int) -> tuple[tuple[int, ...], ...]:
    """Numbers of solutions dealt out to parts that take about as long: the slowest first, there and back."""
    order, turns = np.argsort(-seconds, kind="stable").tolist(), [*range(parts), *reversed(range(parts))]
    dealt = list(zip(order, cycle(turns), strict=False))
    return tuple(tuple(sorted(k for k, turn in dealt if turn == part)) for part in range(parts))
