"""Work of plugins outside studies, in another process: whatever ends that process costs the current item alone."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain, count
from typing import Any

from vibench.errors import in_a_line
from vibench.execution.jobs import Job
from vibench.execution.supervisor import Supervisor
from vibench.interfaces.problem import VariationalInequality
from vibench.plugins import registry
from vibench.plugins.kinds import SOLVER
from vibench.qp.scaling import in_units, random_units
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, Residuals, verify
from vibench.stages.artefacts import Store
from vibench.stages.base import Done, Failed, Items, ItemwiseStage, Stage, TimeLimit
from vibench.stages.serialisation import dumps, loads, storable
from vibench.study.spec import Limits
from vibench.timing import NO_TIME, Seconds, median_seconds

storable(VariationalInequality)


class NotImportableError(Exception):
    """Another process cannot import a plugin: a class that is local to a function, a module that is not on the path."""


@dataclass(frozen=True)
class IsolatedCall(ItemwiseStage, Items):
    """A call of a pickled function with its arguments as a stage; `path` is searched for modules, too."""

    label = "call"
    items = 1

    pickled: bytes
    path: tuple[str, ...]

    def begin(self, store: Store) -> Items:  # noqa: ARG002
        return self

    def run_item(self, number: int, time_limit: TimeLimit) -> Any:  # noqa: ARG002
        """Value of the function; a `NotImportableError` if this process cannot import what was pickled."""
        with time_limit():
            sys.path += [folder for folder in self.path if folder not in sys.path]
            try:
                function, arguments = pickle.loads(self.pickled)
            except (ImportError, AttributeError) as error:
                return NotImportableError(in_a_line(error))
            return function(*arguments)

    def failed(self, number: int, failed: Failed) -> Failed:  # noqa: ARG002
        return failed

    def collect(self, items: Sequence[Any]) -> Any:
        return items[0]


def call_isolated(function: Callable[..., Any], *arguments: Any, seconds: float, supervisor: Supervisor) -> Any:
    """Call a function in the process of a supervisor, for some wall seconds at most.

    The value is a `Failed` if the call raised, took longer or ended the process, and a `NotImportableError` if the
    process cannot import the function or its arguments. Raises a `NotImportableError` if they cannot be pickled.
    """
    try:
        pickled = pickle.dumps((function, arguments))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise NotImportableError(in_a_line(error)) from None
    call = IsolatedCall(pickled, tuple(folder for folder in sys.path if folder))
    return _outcome(supervisor, call, seconds, max(seconds, 1.0))


def _outcome(supervisor: Supervisor, stage: ItemwiseStage, seconds: float, in_all: float) -> Any:
    """Value of a stage, or why it has none; the limits are those of an item and of all together."""
    outcome = supervisor.run(Job("", stage, seconds, in_all, Limits().memory_gib))
    if isinstance(outcome, Done):
        return outcome.value
    return Failed(outcome.status if isinstance(outcome, Failed) else Status.ERROR, outcome.reason)


@dataclass(frozen=True)
class Trial:
    """Outcome of a QP solver: the verified status, why it is not ok, and its solution with residuals and seconds."""

    status: Status
    reason: str
    solution: QPSolution | None = None
    residuals: Residuals | None = None
    seconds: Seconds = NO_TIME


@dataclass(frozen=True)
class SolverTrials(ItemwiseStage, Items):
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

    def begin(self, store: Store) -> Items:  # noqa: ARG002
        return self

    def run_item(self, number: int, time_limit: TimeLimit) -> Trial:
        """Solve the program with one solver and verify its solution; the time limit includes loading a plugin."""
        with time_limit():
            return self._trial(self.solvers[number])

    def _trial(self, name: str) -> Trial:
        program, accuracy = loads(self.program), self.accuracy
        solve = partial(solve_qp, solver=name, accuracy=accuracy, extra=registry.qp_solver(name))
        # Repeats are in other units, so that a solver that caches solutions cannot be timed on a cache hit.
        repeats = (in_units(program, random_units(len(program.f), accuracy, repeat)) for repeat in count())
        solution, seconds = median_seconds(solve, chain([program], repeats))
        status, reason, residuals = verify(program, solution, accuracy)
        return Trial(status, reason, solution, residuals, seconds)

    def failed(self, number: int, failed: Failed) -> Trial:  # noqa: ARG002
        return Trial(failed.status, failed.reason)

    def collect(self, items: Sequence[Trial]) -> list[Trial]:
        return list(items)


def solver_trials(
    program: VariationalInequality, accuracy: float, solvers: Sequence[str], seconds: float = 60.0
) -> dict[str, Trial]:
    """Outcomes of installed solvers on a dense program, by name; `seconds` limits each, including its import."""
    stage = SolverTrials(dumps(program), accuracy, tuple(solvers))
    with closing(Supervisor()) as supervisor:
        trials = _outcome(supervisor, stage, seconds, Limits().cell_seconds)
    if isinstance(trials, Failed):
        return dict.fromkeys(solvers, Trial(trials.status, trials.reason))
    return dict(zip(solvers, trials, strict=True))
