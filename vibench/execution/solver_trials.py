"""Every QP solver on one program, in worker processes that a solver may hang or kill."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain, count

from vibench.execution.supervisor import Job, Supervisor
from vibench.interfaces.problem import VariationalInequality
from vibench.qp.repeats import in_units, units
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, Residuals, verify
from vibench.stages.base import Done, Failed, Pieces, PiecewiseStage, Stage
from vibench.storage.artefacts import Store
from vibench.storage.serialisation import dumps, loads, storable
from vibench.study import registry
from vibench.study.kinds import SOLVER
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
class SolverTrials(PiecewiseStage, Pieces):
    """A program solved by one solver after the other. A solver is a piece; the pieces share no preparation."""

    label = "QP solvers"

    program: bytes
    accuracy: float
    solvers: tuple[str, ...]

    @property
    def pieces(self) -> int:
        """Number of solvers."""
        return len(self.solvers)

    @cached_property
    def packages(self) -> frozenset[str]:
        """Those of the solvers."""
        return frozenset(registry.find(SOLVER, solver).package for solver in self.solvers) - {""}

    def stage_of(self, number: int) -> Stage:
        """The trial of one solver."""
        return SolverTrials(self.program, self.accuracy, self.solvers[number : number + 1])

    def begin(self, store: Store) -> Pieces:  # noqa: ARG002
        """Nothing to prepare."""
        return self

    def piece(self, number: int, watch: Callable[[bool], None]) -> Trial:
        """Solve the program with one solver and verify its solution; the time limit includes loading a plugin."""
        watch(True)
        name, program, accuracy = self.solvers[number], loads(self.program), self.accuracy
        solve = partial(solve_qp, solver=name, accuracy=accuracy, extra=registry.qp_solver(name))
        repeats = (in_units(program, units(len(program.f), accuracy, repeat)) for repeat in count())
        solution, seconds = median_seconds(solve, chain([program], repeats))
        status, reason, residuals = verify(program, solution, accuracy)
        return Trial(status, reason, solution, residuals, seconds)

    def lost(self, number: int, failed: Failed) -> Trial:  # noqa: ARG002
        """Outcome of a solver that raised an error, hung, or ended the process."""
        return Trial(failed.status, failed.reason)

    def finish(self, pieces: Sequence[Trial]) -> list[Trial]:
        """Outcomes in the order of the solvers."""
        return list(pieces)


def solver_trials(
    program: VariationalInequality, accuracy: float, solvers: Sequence[str], seconds: float = SECONDS
) -> dict[str, Trial]:
    """Outcomes of installed solvers on a dense program, by name; `seconds` is the time limit of each."""
    limits = Limits()
    with closing(Supervisor()) as supervisor:
        stage = SolverTrials(dumps(program), accuracy, tuple(solvers))
        answer = supervisor.run(Job("", stage, seconds, limits.cell_seconds, limits.memory_gib))
    if isinstance(answer, Done):
        return dict(zip(solvers, answer.value, strict=True))
    status = answer.status if isinstance(answer, Failed) else Status.ERROR
    return dict.fromkeys(solvers, Trial(status, answer.reason))
