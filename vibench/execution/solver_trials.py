"""Every QP solver on one program, in worker processes that a solver may hang or kill."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain, count

from vibench.execution.watched import WatchedWork, watched
from vibench.interfaces.problem import VariationalInequality
from vibench.plugins import registry
from vibench.plugins.kinds import SOLVER
from vibench.qp.repeats import in_units, units
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, Residuals, verify
from vibench.stages.base import Failed, Stage
from vibench.storage.serialisation import dumps, loads, storable
from vibench.study.spec import Limits
from vibench.timing import NO_TIME, Seconds, median_seconds

storable(VariationalInequality)

SECONDS = 60.0
"""Time limit of one solver; importing it counts."""


@dataclass(frozen=True)
class Trial:
    """Outcome of a solver: the verified status, why it is not ok, and its solution with residuals and seconds."""

    status: Status
    reason: str
    solution: QPSolution | None = None
    residuals: Residuals | None = None
    seconds: Seconds = NO_TIME


@dataclass(frozen=True)
class SolverTrials(WatchedWork):
    """A program solved by one solver after the other; the solvers of every package have a process of their own."""

    label = "QP solvers"

    program: bytes
    accuracy: float
    solvers: tuple[str, ...]

    @property
    def items(self) -> int:
        """Number of solvers."""
        return len(self.solvers)

    @cached_property
    def packages(self) -> frozenset[str]:
        """The packages of the solvers."""
        return frozenset(registry.find(SOLVER, solver).package for solver in self.solvers) - {""}

    def stage_of(self, number: int) -> Stage:
        """The trial of one solver."""
        return SolverTrials(self.program, self.accuracy, self.solvers[number : number + 1])

    def do(self, number: int, done: Mapping[int, Trial]) -> Trial:  # noqa: ARG002
        """Solve the program with one solver and verify its solution; the time limit includes loading a plugin."""
        name, program, accuracy = self.solvers[number], loads(self.program), self.accuracy
        solve = partial(solve_qp, solver=name, accuracy=accuracy, extra=registry.qp_solver(name))
        repeats = (in_units(program, units(len(program.f), accuracy, repeat)) for repeat in count())
        solution, seconds = median_seconds(solve, chain([program], repeats))
        status, reason, residuals = verify(program, solution, accuracy)
        return Trial(status, reason, solution, residuals, seconds)

    def instead(self, number: int, failed: Failed) -> Trial:  # noqa: ARG002
        """Outcome of a solver that raised an error, hung, or ended the process."""
        return Trial(failed.status, failed.reason)


def solver_trials(
    program: VariationalInequality, accuracy: float, solvers: Sequence[str], seconds: float = SECONDS
) -> dict[str, Trial]:
    """Outcomes of installed solvers on a dense program, by name; `seconds` is the time limit of each."""
    trials = watched(SolverTrials(dumps(program), accuracy, tuple(solvers)), seconds, in_all=Limits().cell_seconds)
    if isinstance(trials, Failed):
        return dict.fromkeys(solvers, Trial(trials.status, trials.reason))
    return dict(zip(solvers, trials, strict=True))
