"""Work of plugins outside studies, in another process: whatever ends that process costs the current item alone."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import chain, count
from typing import Any

from vibench.errors import in_a_line
from vibench.execution.supervisor import Job, Supervisor
from vibench.interfaces.formulations import Formulation
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import DualStrategy, PrimalStrategy, Sampling, Stop
from vibench.offline.sample_problem import sample_offline, sample_reduction, sample_snapshots
from vibench.plugins import registry
from vibench.plugins.kinds import PluginKind
from vibench.plugins.options import options_as_json
from vibench.plugins.plugin import GivenPlugin, Plugin
from vibench.plugins.reads import reads_of, states
from vibench.qp.scaling import in_units, random_units
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, Residuals, verify
from vibench.stages.artefacts import Store
from vibench.stages.base import Done, Failed, Items, ItemwiseStage, TimeLimit
from vibench.study.cells import digest
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

    pickled: bytes
    path: tuple[str, ...]
    owners: tuple[str, ...]

    @property
    def items(self) -> int:
        return 1

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
    """Call a function in the process of a supervisor for some packages, for some wall seconds at most."""
    # The value is a `Failed` if the call raised, took longer or ended the process, and a `NotImportableError` if the
    # process cannot import the function or its arguments. Raises a `NotImportableError` if they cannot be pickled.
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


def solver_trials(vi: VariationalInequality, accuracy: float, names: Sequence[str], seconds: float) -> dict[str, Trial]:
    """Outcomes of installed solvers on a dense program, by name; `seconds` limits each, including its import."""
    trials: dict[str, Trial] = {}
    with closing(Supervisor()) as supervisor:
        for name in names:
            owners = (registry.find(PluginKind.SOLVER, name).package,)
            limits: Any = {"seconds": seconds, "supervisor": supervisor, "owners": owners}
            outcome = call_isolated(_tried, vi, accuracy, name, **limits)
            trials[name] = outcome if isinstance(outcome, Trial) else Trial(outcome.status, outcome.reason)
    return trials


# Gives the states of what a plugin reads, `None` if its process ended; it gets the recorded names that have changed.
Watch = Callable[[Plugin, list[str]], Mapping[str, str] | None]


def recall_reads(plugins: Iterable[Plugin], store: Store, watch: Watch | None = None) -> bool:
    """Let given plugins know what they read, as recorded in the store or watched; whether any reads something."""
    found = False
    for plugin in dict.fromkeys(plugins):
        given, options = plugin.registered, options_as_json(plugin.arguments)
        assert isinstance(given, GivenPlugin)
        key = f"reads-{digest([given.fingerprint, options])}"
        artefact = store.get(key)
        known = {} if artefact is None else artefact.value
        changed = [name for name, state in states(known).items() if state != known[name]]
        if watch is not None and (artefact is None or changed):
            # Nothing is stored where the first use ends its process: the next run tries again.
            if (watched := watch(plugin, changed)) is not None:
                store.put(key, watched, NO_TIME, ())
            known = watched or {}
        given.reads[options] = known
        found |= bool(known)
    return found


def watch_first_use(
    plugin: Plugin, changed: list[str], *, note: Callable[[str], None], supervisor: Supervisor, seconds: float
) -> dict[str, str] | None:
    """Use a plugin for some seconds at most, in a process that does nothing else; see `Watch`."""
    if changed:
        more = f" and {len(changed) - 1} more" * (len(changed) > 1)
        note(f"the {plugin} reads {changed[0]}{more}, changed since: what it computes is computed again")
    own: Any = {"supervisor": supervisor, "owners": (plugin.registered.package,)}
    # A strategy and a formulation are tried on the sample problem, which takes seconds.
    there = call_isolated(reads_of, partial(_first_use, plugin), seconds=min(seconds, 60.0), **own)
    if not isinstance(there, Mapping):
        return None
    # A process of ours has some variables of its own.
    return {name: state for name, state in states(there).items() if not name.startswith("$") or state == there[name]}


def _first_use(plugin: Plugin) -> None:
    # Another plugin may be the same class with other options.
    vars(plugin.registered).pop("given", None)
    made = plugin.create()
    match made:
        case Problem():
            mu = made.training_set()[0]
            made.assemble(mu)
            made.contact(mu)
        case Sampling():
            made.parameters(sample_offline().problem.parameters)
        case DualStrategy():
            made.reduce(*sample_snapshots(), Stop(size=2))
        case PrimalStrategy():
            made.build(sample_offline(), 0.5 if made.takes_tolerance else None)
        case Formulation():
            sample = sample_reduction()
            sample.with_formulation(made).model.solve(sample.parameters[0])
