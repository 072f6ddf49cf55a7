"""Checks in processes of their own: under a time limit that holds, and a second process to compare numbers with."""

from __future__ import annotations

import atexit
import importlib
import os
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from operator import attrgetter
from typing import Any

from vibench.errors import in_a_line
from vibench.execution.supervisor import Supervisor
from vibench.execution.watched import WatchedWork, watched
from vibench.qp.status import Status
from vibench.stages.base import Failed, Items
from vibench.storage.artefacts import Store
from vibench.testing.checks import CheckResult, Conformance, ConformanceError, Verdict

HASH_SEEDS = ("1", "2")
"""Seeds of Python's hashes, which order sets of texts; a second process has one that this one has not."""


@dataclass(frozen=True)
class Examination(WatchedWork):
    """The checks of a plugin: one that ends its process or is stopped costs those that need it."""

    label = "checks"

    kind: str
    """Kind of the plugin, as in `vibench check KIND:NAME`."""
    plugin: str
    """Where the plugin is, "module:attribute"."""
    options: Mapping[str, Any] | None
    """Arguments of its constructor; `None` for one that is a function."""
    seconds: float
    """Wall time [s] of all checks."""
    given: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments of its case."""

    @property
    def conformance(self) -> Conformance[..., Any]:
        """The checks of this kind."""
        module = importlib.import_module(f"vibench.testing.{self.kind}s")  # it may import this one
        checks: Conformance[..., Any] = getattr(module, self.kind.upper())
        return checks

    @property
    def items(self) -> int:
        """Number of checks."""
        return len(self.conformance.checks)

    def begin(self, store: Store) -> Items:  # noqa: ARG002
        """Import the plugin: none of the checks can be made without it."""
        self._case  # noqa: B018
        return self

    @cached_property
    def _case(self) -> Any:
        module, _, name = self.plugin.partition(":")
        plugin = attrgetter(name)(importlib.import_module(module))
        create = plugin if self.options is None else partial(plugin, **self.options)
        return self.conformance.case(create, seconds=self.seconds, **self.given)

    def do(self, number: int, done: Mapping[int, Any]) -> CheckResult:
        """Make one check."""
        return self.conformance.checks[number].result(self._case, done.values())

    def instead(self, number: int, failed: Failed) -> CheckResult:
        """The check fails; one that was not begun for lack of time is skipped."""
        name, late = self.conformance.checks[number].name, failed.status is Status.TIMEOUT
        return CheckResult(name, Verdict.SKIPPED, LATE) if late else CheckResult(name, Verdict.FAILED, failed.reason)

    def finish(self, items: Sequence[tuple[int, CheckResult]]) -> list[CheckResult]:
        """All results; the first check that had no time left has failed, those after it are skipped together."""
        results = [result for _, result in items if result.message != LATE]
        late = [result.check for _, result in items if result.message == LATE]
        if late:
            reason = f"stopped: the checks take longer than {self.seconds:g} s"
            results.append(CheckResult(late[0], Verdict.FAILED, reason))
        if late[1:]:
            results.append(CheckResult(", ".join(late[1:]), Verdict.SKIPPED, LATE))
        return results


LATE = "no time is left"


def examine_in_process(examination: Examination, observe: Callable[[CheckResult], None]) -> list[CheckResult]:
    """Make the checks in a watched process; `observe` is called with every result as soon as it is there."""
    results = watched(examination, examination.seconds, observe)
    if isinstance(results, Failed):
        results = [CheckResult("all", Verdict.FAILED, results.reason)]
        observe(results[0])
    return results


@dataclass(frozen=True)
class Call(WatchedWork):
    """One call of a pickled function with its arguments, where these folders are searched for modules."""

    label = "call"
    items = 1

    pickled: bytes
    path: tuple[str, ...]

    def do(self, number: int, done: Mapping[int, Any]) -> Any:  # noqa: ARG002
        """The value of the function; a `NotImportableError` if this process cannot import what was pickled."""
        sys.path += [folder for folder in self.path if folder not in sys.path]
        try:
            function, arguments = pickle.loads(self.pickled)
        except (ImportError, AttributeError) as error:
            return NotImportableError(in_a_line(error))
        return function(*arguments)


class NotImportableError(Exception):
    """Another process cannot import a plugin: a class that is local to a function, a module that is not on the path."""


def call_in_other_process(function: Callable[..., Any], *arguments: Any, seconds: float) -> Any:
    """The value of a function in another process, whose hashes have another seed than those here.

    Raises a `NotImportableError` if function or arguments cannot be sent there, and a `ConformanceError` if the call
    fails there, or takes longer than so many seconds.
    """
    try:
        call = Call(pickle.dumps((function, arguments)), tuple(folder for folder in sys.path if folder))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise NotImportableError(in_a_line(error)) from None
    answer = watched(call, seconds, supervisor=_other_process())
    value = answer if isinstance(answer, Failed) else answer[0]
    if isinstance(value, NotImportableError):
        raise value
    if isinstance(value, Failed):
        raise ConformanceError(f"in another process it fails: {value.reason}")
    return value


@cache
def _other_process() -> Supervisor:
    """The second process, which serves all checks of this one."""
    own = os.environ.get("PYTHONHASHSEED")
    supervisor = Supervisor(environment={"PYTHONHASHSEED": next(seed for seed in HASH_SEEDS if seed != own)})
    atexit.register(supervisor.close)
    return supervisor
