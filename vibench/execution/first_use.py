"""Records of what classes given in Python read when they are first used, which identify them with their code."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial

from vibench.execution.isolated import call_isolated
from vibench.execution.supervisor import Supervisor
from vibench.interfaces.problem import Problem
from vibench.plugins.options import options_as_json
from vibench.plugins.plugin import GivenPlugin, Plugin
from vibench.plugins.reads import reads_of, states
from vibench.stages.artefacts import Store
from vibench.study.cells import digest
from vibench.timing import NO_TIME

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
    there = call_isolated(reads_of, partial(_first_use, plugin), seconds=seconds, supervisor=supervisor)
    if not isinstance(there, Mapping):
        return None
    # A process of ours has some variables of its own.
    return {name: state for name, state in states(there).items() if not name.startswith("$") or state == there[name]}


def _first_use(plugin: Plugin) -> None:
    # Another plugin may be the same class with other options.
    vars(plugin.registered).pop("given", None)
    made = plugin.create()
    if isinstance(made, Problem):
        made.assemble(made.training_set()[0])
