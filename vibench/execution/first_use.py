"""Records of what classes given in Python read when they are first used, which identify them with their code."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from vibench.execution.isolated import call_isolated
from vibench.execution.supervisor import Supervisor
from vibench.interfaces.problem import Problem
from vibench.plugins.options import options_as_json
from vibench.plugins.plugin import GivenPlugin, Plugin
from vibench.plugins.reads import reads_of, states
from vibench.stages.artefacts import Store
from vibench.study.cells import digest
from vibench.timing import NO_TIME


def recall_reads(
    plugins: Iterable[Plugin], store: Store, watch: Callable[[Plugin, list[str]], Any] | None = None
) -> bool:
    """Let given plugins know what they read; whether there are any that read something.

    `watch` gives the states of what a plugin reads where these are not in the store, or some, which it gets, have
    changed.
    """
    found = False
    for plugin in dict.fromkeys(plugins):
        if isinstance(given := plugin.registered, GivenPlugin):
            options = options_as_json(plugin.arguments)
            key, known = f"reads-{digest([given.fingerprint, options])}", dict[str, str]()
            if (artefact := store.get(key)) is not None:
                known = artefact.value
            changed = [name for name, state in states(known).items() if state != known[name]]
            if watch is not None and (artefact is None or changed):
                known = watch(plugin, changed)
                store.put(key, known, NO_TIME, ())
            given.reads[options] = known
            found |= bool(known)
    return found


def watch_first_use(
    plugin: Plugin, changed: list[str], *, note: Callable[[str], None], supervisor: Supervisor, seconds: float
) -> dict[str, str]:
    """Use a plugin for some seconds at most, in a process that does nothing else; the states of what it reads."""
    if changed:
        more = f" and {len(changed) - 1} more" * (len(changed) > 1)
        note(f"the {plugin} reads {changed[0]}{more}, changed since: what it computes is computed again")
    there = call_isolated(reads_of, partial(_first_use, plugin), seconds=seconds, supervisor=supervisor)
    # A process of ours has some variables of its own.
    here = states(there) if isinstance(there, Mapping) else {}
    return {name: state for name, state in here.items() if not name.startswith("$") or state == there[name]}


def _first_use(plugin: Plugin) -> None:
    # Another plugin may be the same class with other options.
    vars(plugin.registered).pop("given", None)
    made = plugin.create()
    if isinstance(made, Problem):
        made.assemble(made.training_set()[0])
