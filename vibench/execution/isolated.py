"""Work of plugins outside studies, in a process of its own: whatever ends that process costs the current item alone."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain, count
from typing import Any

from vibench.execution.jobs import Job
from vibench.execution.supervisor import Supervisor
from vibench.interfaces.problem import VariationalInequality
from vibench.plugins import registry
from vibench.plugins.kinds import SOLVER
from vibench.qp.scaling import in_units, random_units
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, Residuals, verify
from vibench.stages.base import Done, Failed, Items, ItemwiseStage, Stage
from vibench.storage.artefacts import Store
from vibench.storage.serialisation import dumps, loads, storable
from vibench.study.spec import Limits
from vibench.timing import NO_TIME, Seconds, median_seconds

storable(VariationalInequality)


@dataclass(frozen=True)
class IsolatedWork(ItemwiseStage, Items):
    """Items of work; a subclass defines the number of `items` and how to `do` one.

    It is sent to the process that does the items; data that they share is a cached property there.
    """

    label = "work"

    @abstractmethod
    def do(self, number: int, done: Mapping[int, Any]) -> Any:
        """The value of an item; `done` has the values of earlier items, those of other processes included."""

    def instead(self, number: int, failed: Failed) -> Any:  # noqa: ARG002
        """Substitute for the value of an item that raised, exceeded its time limit or ended the process."""
        return failed

    @cached_property
    def _done(self) -> dict[int, Any]:
        return {}

    def begin(self, store: Store) -> Items:  # noqa: ARG002
        return self

    def resume(self, done: Mapping[int, tuple[int, Any]]) -> None:
        self._done.update(done.values())

    def item(self, number: int, watch: Callable[[bool], None]) -> tuple[int, Any]:
        """Number and value of an item, done under its time limit."""
        watch(True)
        self._done[number] = self.do(number, self._done)
        return number, self._done[number]

    def lost(self, number: int, failed: Failed) -> tuple[int, Any]:
        self._done[number] = self.instead(number, failed)
        return number, self._done[number]

    def finish(self, items: Sequence[tuple[int, Any]]) -> list[Any]:
        return [value for _, value in items]


def run_isolated(
    work: IsolatedWork,
    seconds: float,
    observe: Callable[[Any], None] = lambda _: None,
    *,
    in_all: float | None = None,
    supervisor: Supervisor | None = None,
) -> list[Any] | Failed:
    """Do work in a process of its own.

    Parameters
    ----------
    work
        The work.
    seconds
        Time limit of an item; wall seconds.
    observe
        Called with the value of every item as soon as it is known; those of items that ended the process come last.
    in_all
        Time limit of all items together; by default that of an item.
    supervisor
        Supervisor whose process does the work; by default one that ends with it.

    Returns
    -------
    list or Failed
        The values of all items, or why none could be done.
    """
    observed: set[int] = set()

    def tell(item: tuple[int, Any]) -> None:
        observed.add(item[0])
        observe(item[1])

    job = Job("", work, seconds, max(in_all or seconds, 1.0), Limits().memory_gib)
    if supervisor is None:
        with closing(Supervisor()) as own:
            outcome = own.run(job, tell)
    else:
        outcome = supervisor.run(job, tell)
    if not isinstance(outcome, Done):
        return Failed(outcome.status if isinstance(outcome, Failed) else Status.ERROR, outcome.reason)
    values: list[Any] = outcome.value
    for number, value in enumerate(values):
        if number not in observed:
            observe(value)
    return values


@dataclass(frozen=True)
class Trial:
    """Outcome of a QP solver: the verified status, why it is not ok, and its solution with residuals and seconds."""

    status: Status
    reason: str
    solution: QPSolution | None = None
    residuals: Residuals | None = None
    seconds: Seconds = NO_TIME


@dataclass(frozen=True)
class SolverTrials(IsolatedWork):
    """A program solved by one solver after the other; the solvers of every package have a process of their own."""

    label = "QP solvers"

    program: bytes
    accuracy: float
    solvers: tuple[str, ...]

    @property
    def items(self) -> int:
        return len(self.solvers)

    @cached_property
    def packages(self) -> frozenset[str]:
        return frozenset(registry.find(SOLVER, solver).package for solver in self.solvers) - {""}

    def stage_of(self, number: int) -> Stage:
        return SolverTrials(self.program, self.accuracy, self.solvers[number : number + 1])

    def do(self, number: int, done: Mapping[int, Trial]) -> Trial:  # noqa: ARG002
        """Solve the program with one solver and verify its solution; the time limit includes loading a plugin."""
        name, program, accuracy = self.solvers[number], loads(self.program), self.accuracy
        solve = partial(solve_qp, solver=name, accuracy=accuracy, extra=registry.qp_solver(name))
        # Repeats are in other units, so that a solver that caches solutions cannot be timed on a cache hit.
        repeats = (in_units(program, random_units(len(program.f), accuracy, repeat)) for repeat in count())
        solution, seconds = median_seconds(solve, chain([program], repeats))
        status, reason, residuals = verify(program, solution, accuracy)
        return Trial(status, reason, solution, residuals, seconds)

    def instead(self, number: int, failed: Failed) -> Trial:  # noqa: ARG002
        return Trial(failed.status, failed.reason)


def solver_trials(
    program: VariationalInequality, accuracy: float, solvers: Sequence[str], seconds: float = 60.0
) -> dict[str, Trial]:
    """Outcomes of installed solvers on a dense program, by name; `seconds` limits each, including its import."""
    trials = run_isolated(SolverTrials(dumps(program), accuracy, tuple(solvers)), seconds, in_all=Limits().cell_seconds)
    if isinstance(trials, Failed):
        return dict.fromkeys(solvers, Trial(trials.status, trials.reason))
    return dict(zip(solvers, trials, strict=True))
