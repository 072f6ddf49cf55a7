"""Every QP solver on one small program, in a worker process that a solver may hang or kill."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vibench.execution.supervisor import Job, Supervisor
from vibench.interfaces.problem import VariationalInequality
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import verify
from vibench.stages.base import Done, Failed, Pieces, PiecewiseStage, Stage
from vibench.storage.artefacts import Store
from vibench.study import registry
from vibench.study.spec import Limits

ACCURACY = 1e-7
"""Relative accuracy of the solutions: the default of studies."""

UNKNOWNS = 12

SECONDS = 60.0
"""Time limit of one solver; importing it counts."""


@dataclass(frozen=True)
class Trial:
    """Outcome of a solver: status, largest KKT residual (`None` without a solution), and why it is not ok."""

    status: Status
    residual: float | None
    reason: str


def program() -> VariationalInequality:
    """A wire of `UNKNOWNS` nodes in contact with a flat support around its middle; dense, like reduced programs."""
    step = 1.0 / (UNKNOWNS + 1)
    A = (2.0 * np.eye(UNKNOWNS) - np.eye(UNKNOWNS, k=1) - np.eye(UNKNOWNS, k=-1)) / step
    return VariationalInequality(
        A, np.full(UNKNOWNS, -4.0 * step), -step * np.eye(UNKNOWNS), np.full(UNKNOWNS, 0.2 * step)
    )


@dataclass(frozen=True)
class SolverTrials(PiecewiseStage, Pieces):
    """The program solved by one solver after the other. A solver is a piece; the pieces share no preparation."""

    label = "QP solvers"

    solvers: tuple[str, ...]

    @property
    def pieces(self) -> int:
        """Number of solvers."""
        return len(self.solvers)

    @cached_property
    def packages(self) -> frozenset[str]:
        """Those of the solvers."""
        return frozenset(registry.package("QP solver", solver) for solver in self.solvers) - {""}

    def stage_of(self, number: int) -> Stage:
        """The trial of one solver."""
        return SolverTrials(self.solvers[number : number + 1])

    def begin(self, store: Store) -> Pieces:  # noqa: ARG002
        """Nothing to prepare."""
        return self

    def piece(self, number: int, watch: Callable[[bool], None]) -> Trial:
        """Solve the program with one solver and verify its solution; the time limit includes loading a plugin."""
        watch(True)
        solver = self.solvers[number]
        solution = solve_qp(program(), solver, ACCURACY, registry.qp_solver(solver))
        status, reason, residuals = verify(program(), solution, ACCURACY)
        return Trial(status, None if residuals is None else residuals.worst, reason)

    def lost(self, number: int, failed: Failed) -> Trial:  # noqa: ARG002
        """Outcome of a solver that raised an error, hung, or ended the process."""
        return Trial(failed.status, None, failed.reason)

    def finish(self, pieces: Sequence[Trial]) -> list[Trial]:
        """Outcomes in the order of the solvers."""
        return list(pieces)


def attempts(solvers: Sequence[str], seconds: float = SECONDS) -> dict[str, Trial]:
    """Outcomes of installed solvers by name; `seconds` is the time limit of each."""
    limits = Limits()
    with closing(Supervisor()) as supervisor:
        job = Job("", SolverTrials(tuple(solvers)), seconds, limits.cell_seconds, limits.memory_gib)
        answer = supervisor.run(job)
    if isinstance(answer, Done):
        return dict(zip(solvers, answer.value, strict=True))
    status = answer.status if isinstance(answer, Failed) else Status.ERROR
    return dict.fromkeys(solvers, Trial(status, None, answer.reason))
