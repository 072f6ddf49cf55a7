"""Work of plugins outside studies, in another process: whatever ends that process costs the current item alone."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import chain, count
from typing import Any

from vibench.errors import in_a_line
from vibench.execution.supervisor import Job, Supervisor
from vibench.interfaces.problem import VariationalInequality
from vibench.plugins import registry
from vibench.plugins.kinds import PluginKind
from vibench.qp.scaling import in_units, random_units
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, Residuals, verify
from vibench.stages.artefacts import Store
from vibench.stages.base import Done, Failed, Items, ItemwiseStage, TimeLimit
from vibench.study.spec import Limits
from vibench.timing import NO_TIME, Seconds, median_seconds


class NotImportableError(Exception):
    """Another process cannot import a plugin: a class that is local to a function, a module that is not on the path."""


@dataclass(frozen=True)
class IsolatedCall(ItemwiseStage, Items):
    """A call of a pickled function with its arguments as a stage; `path` is searched for modules, too.

    Calls with different third-party `owners` have different processes.
    """

    label = "call"
    items = 1

    pickled: bytes
    path: tuple[str, ...]
    owners: tuple[str, ...]

    @property
    def packages(self) -> frozenset[str]:
        return frozenset(self.owners) - {""}

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

    def collect(self, items: Sequence[Any]) -> Any:
        return items[0]


def call_isolated(
    function: Callable[..., Any], *arguments: Any, seconds: float, supervisor: Supervisor, owners: tuple[str, ...] = ()
) -> Any:
    """Call a function in the process of a supervisor for some packages, for some wall seconds at most.

    The value is a `Failed` if the call raised, took longer or ended the process, and a `NotImportableError` if the
    process cannot import the function or its arguments. Raises a `NotImportableError` if they cannot be pickled.
    """
    try:
        pickled = pickle.dumps((function, arguments))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise NotImportableError(in_a_line(error)) from None
    call = IsolatedCall(pickled, tuple(folder for folder in sys.path if folder), owners)
    outcome = supervisor.run(Job("", call, seconds, max(seconds, 1.0), Limits().memory_gib))
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


def _tried(program: VariationalInequality, accuracy: float, name: str) -> Trial:
    """Solve a program with one solver and verify its solution; the seconds of the call include loading a plugin."""
    solve = partial(solve_qp, solver=name, accuracy=accuracy, extra=registry.qp_solver(name))
    # Repeats are in other units, so that a solver that caches solutions cannot be timed on a cache hit.
    repeats = (in_units(program, random_units(len(program.f), accuracy, repeat)) for repeat in count())
    solution, seconds = median_seconds(solve, chain([program], repeats))
    status, reason, residuals = verify(program, solution, accuracy)
    return Trial(status, reason, solution, residuals, seconds)


def solver_trials(
    program: VariationalInequality, accuracy: float, solvers: Sequence[str], seconds: float
) -> dict[str, Trial]:
    """Outcomes of installed solvers on a dense program, by name; `seconds` limits each, including its import."""
    trials: dict[str, Trial] = {}
    with closing(Supervisor()) as supervisor:
        for name in solvers:
            owners = (registry.find(PluginKind.SOLVER, name).package,)
            limits: Any = {"seconds": seconds, "supervisor": supervisor, "owners": owners}
            outcome = call_isolated(_tried, program, accuracy, name, **limits)
            trials[name] = outcome if isinstance(outcome, Trial) else Trial(outcome.status, outcome.reason)
    return trials
