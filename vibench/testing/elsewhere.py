"""Checks in processes of their own: under a time limit that holds, and a second process to compare numbers with."""

from __future__ import annotations

import atexit
import importlib
import os
import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache, partial
from operator import attrgetter
from typing import Any

from vibench.errors import in_a_line
from vibench.execution.supervisor import Job, Supervisor
from vibench.qp.status import Status
from vibench.stages.base import Done, Failed, Pieces, PiecewiseStage
from vibench.storage.artefacts import Store
from vibench.study.spec import Limits
from vibench.testing.checks import Check, ConformanceError, Finding, Verdict, examine_one

HASH_SEEDS = ("1", "2")
"""Seeds of Python's hashes, which order sets of texts; a second process has one that this one has not."""


@dataclass(frozen=True)
class Examination(PiecewiseStage):
    """The checks of a plugin, each a piece: one that ends its process or is stopped costs those that need it.

    Attributes
    ----------
    checks
        Module of this package that has `CHECKS` and `case_of`.
    plugin
        Where the plugin is, "module:attribute".
    options
        Arguments of its constructor; `None` for one that is a function.
    seconds
        Wall time [s] of all checks.
    given
        Further arguments of `case_of`.
    """

    label = "checks"

    checks: str
    plugin: str
    options: Mapping[str, Any] | None
    seconds: float
    given: Mapping[str, Any] = field(default_factory=dict)

    def all_checks(self) -> tuple[Check[Any], ...]:
        """The checks in their order."""
        found: tuple[Check[Any], ...] = self._module().CHECKS
        return found

    @property
    def pieces(self) -> int:
        """Number of checks."""
        return len(self.all_checks())

    def begin(self, store: Store) -> Pieces:  # noqa: ARG002
        """Import the plugin."""
        module, _, name = self.plugin.partition(":")
        plugin = attrgetter(name)(importlib.import_module(module))
        create = plugin if self.options is None else partial(plugin, **self.options)
        return _Checking(self, self._module().case_of(create, self.seconds, **self.given))

    def _module(self) -> Any:
        return importlib.import_module(f"vibench.testing.{self.checks}")


class _Checking(Pieces):
    """The checks of a case, in one process."""

    def __init__(self, stage: Examination, case: Any) -> None:
        self._stage, self._case, self._checks = stage, case, stage.all_checks()
        self._findings: dict[str, Finding] = {}

    def resume(self, done: Mapping[int, Finding | Failed]) -> None:
        """Findings of the process before; a check that it did not survive has none."""
        self._findings |= {found.check: found for found in done.values() if isinstance(found, Finding)}

    def piece(self, number: int, watch: Callable[[bool], None]) -> Finding:  # noqa: ARG002
        """Make one check."""
        found = examine_one(self._checks[number], self._case, self._findings)
        self._findings[found.check] = found
        return found

    def lost(self, number: int, failed: Failed) -> Failed:  # noqa: ARG002
        """Why there is no finding; `finish` makes one of it."""
        return failed

    def finish(self, pieces: Sequence[Finding | Failed]) -> list[Finding]:
        """All findings; one for all checks that were not begun when the time limit was reached."""
        findings, late = list[Finding](), list[str]()
        for check, found in zip(self._checks, pieces, strict=True):
            if isinstance(found, Finding):
                findings.append(found)
            elif found.status is Status.TIMEOUT:
                late.append(check.name)
            else:
                findings.append(Finding(check.name, Verdict.FAILED, found.reason))
        if late:
            reason = f"stopped: the checks take longer than {self._stage.seconds:g} s"
            findings.append(Finding(late[0], Verdict.FAILED, reason))
        if late[1:]:
            findings.append(Finding(", ".join(late[1:]), Verdict.SKIPPED, "no time is left"))
        return findings


def examine_elsewhere(examination: Examination, observe: Callable[[Finding], None]) -> list[Finding]:
    """Make the checks in a supervised process; `observe` is called with every finding as soon as it is there."""
    seen: set[str] = set()

    def note(found: Finding | Failed) -> None:
        if isinstance(found, Finding):  # `finish` makes a finding of a failure
            seen.add(found.check)
            observe(found)

    with closing(Supervisor()) as supervisor:
        answer = supervisor.run(_job(examination, examination.seconds), note)
    findings = answer.value if isinstance(answer, Done) else [Finding("all", Verdict.FAILED, answer.reason)]
    for finding in findings:
        if finding.check not in seen:
            note(finding)
    return list(findings)


@dataclass(frozen=True)
class Call(PiecewiseStage, Pieces):
    """One call of a pickled function with its arguments, where these folders are searched for modules."""

    label = "call"
    pieces = 1

    pickled: bytes
    path: tuple[str, ...]

    def begin(self, store: Store) -> Pieces:  # noqa: ARG002
        """Nothing to prepare."""
        return self

    def piece(self, number: int, watch: Callable[[bool], None]) -> Any:  # noqa: ARG002
        """The value of the function; a `_NotImportable` if this process cannot import what was pickled."""
        sys.path += [folder for folder in self.path if folder not in sys.path]
        try:
            function, arguments = pickle.loads(self.pickled)
        except (ImportError, AttributeError) as error:
            return _NotImportable(in_a_line(error))
        return function(*arguments)

    def lost(self, number: int, failed: Failed) -> Failed:  # noqa: ARG002
        """Why there is no value."""
        return failed

    def finish(self, pieces: Sequence[Any]) -> Any:
        """The value."""
        return pieces[0]


@dataclass(frozen=True)
class _NotImportable:
    """Another process cannot import a function or its arguments."""

    reason: str


class NotImportableError(Exception):
    """Another process cannot import a plugin: a class that is local to a function, a module that is not on the path."""


def call_elsewhere(function: Callable[..., Any], *arguments: Any, seconds: float) -> Any:
    """The value of a function in another process, whose hashes have another seed than those here.

    Raises
    ------
    NotImportableError
        If function or arguments cannot be sent there.
    ConformanceError
        If the call fails there, or takes longer than so many seconds.
    """
    try:
        call = Call(pickle.dumps((function, arguments)), tuple(folder for folder in sys.path if folder))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise NotImportableError(in_a_line(error)) from None
    answer = _other_process().run(_job(call, seconds))
    found = answer.value if isinstance(answer, Done) else answer
    if isinstance(found, _NotImportable):
        raise NotImportableError(found.reason)
    if not isinstance(answer, Done) or isinstance(found, Failed):
        raise ConformanceError(f"in another process it fails: {found.reason}")
    return found


def _job(stage: PiecewiseStage, seconds: float) -> Job:
    return Job("", stage, seconds, max(seconds, 1.0), Limits().memory_gib)


@cache
def _other_process() -> Supervisor:
    """The second process, which serves all checks of this one."""
    own = os.environ.get("PYTHONHASHSEED")
    supervisor = Supervisor(environment={"PYTHONHASHSEED": next(seed for seed in HASH_SEEDS if seed != own)})
    atexit.register(supervisor.close)
    return supervisor
