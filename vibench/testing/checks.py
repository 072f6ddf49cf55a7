"""Conformance checks and their results, and running them in this process, in another one, or as tests of pytest."""

from __future__ import annotations

import atexit
import os
import pickle
import sysconfig
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar
from unittest import SkipTest

import cloudpickle
import numpy as np
import scipy

import vibench
from vibench.errors import VibenchError, in_a_line
from vibench.execution.isolated import NotImportableError, call_isolated
from vibench.execution.supervisor import Supervisor
from vibench.plugins.kinds import CHECKED
from vibench.qp.status import Status
from vibench.stages.base import Failed

if TYPE_CHECKING:
    import pytest

CaseT_contra = TypeVar("CaseT_contra", contravariant=True)

SECONDS = 120.0  # wall time [s] that the checks of a plugin may take by default; no call of it may take longer


class Verdict(StrEnum):
    """Outcome of a check."""

    PASSED = "passed"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class CheckResult:
    """Result of one check: its name, its outcome, and a message with all faults, remarks, or why it was skipped."""

    check: str
    verdict: Verdict
    message: str = ""

    def __str__(self) -> str:
        return f"{self.verdict:<7}  {self.check}" + (f": {self.message}" if self.message else "")


class Note(str):
    """A remark of a check that is not a fault."""


class Doubt(str):
    """A remark on what is allowed but probably unintended; it turns a passed check into a warning."""


class ConformanceError(AssertionError):
    """A plugin violates what vibench assumes of it; raised in a check, it is a fault that ends the check."""


class ConformanceWarning(UserWarning):
    """A plugin does what is allowed but probably unintended."""


@dataclass(frozen=True)
class Check(Generic[CaseT_contra]):
    """A name, a function from a case to its faults and notes, and the names of checks that must pass before."""

    # A function may report faults by a `ConformanceError` alone; a `SkipTest` ends the check as skipped.

    name: str
    faults: Callable[[CaseT_contra], Iterable[str] | None]
    needs: tuple[str, ...] = ()

    def result(self, case: CaseT_contra, earlier: Iterable[CheckResult]) -> CheckResult:
        """Make the check, unless one that it needs is not among the earlier ones or did not pass."""
        passed = {one.check for one in earlier if one.verdict in (Verdict.PASSED, Verdict.WARNING)}
        if missing := [name for name in self.needs if name not in passed]:
            return CheckResult(self.name, Verdict.SKIPPED, f"it needs '{missing[0]}'")
        lines: list[str] = []
        try:
            for line in self.faults(case) or ():
                lines.append(line)  # noqa: PERF402  what precedes an exception is kept
        except SkipTest as reason:
            return CheckResult(self.name, Verdict.SKIPPED, str(reason))
        except (Exception, SystemExit) as error:  # noqa: BLE001  a plugin may raise anything
            lines.append(str(error) if isinstance(error, ConformanceError) else raised(error))
        faults = [line for line in lines if not isinstance(line, Note | Doubt)]
        # A fault may repeat at every parameter.
        faults[5:] = ["and more"] * (len(faults) > 5)
        doubtful = any(isinstance(line, Doubt) for line in lines)
        verdict = Verdict.FAILED if faults else Verdict.WARNING if doubtful else Verdict.PASSED
        return CheckResult(self.name, verdict, "; ".join(faults or lines))


def case_of(kind: str) -> Any:
    """Return the class with the `checks` of a kind, as in `vibench check KIND:NAME`; they take its instances."""
    # These modules import this one.
    module = "strategies" if kind in ("dual", "primal", "sampling") else f"{kind}s"
    return getattr(import_module(f"vibench.testing.{module}"), f"{kind.capitalize()}Case")


def kind_of(plugin: Any) -> str:
    """Return the kind of a class, or of a `partial` of one; a function is a QP solver."""
    cls = getattr(plugin, "func", plugin)
    if not callable(cls):
        name = type(cls).__name__
        raise TypeError(f"pass {name} or a function that makes one, not an instance: two instances are compared")
    named = (kind for kind, one in CHECKED.items() if one.base and isinstance(cls, type) and issubclass(cls, one.base))
    return next(named, "solver")


def examine(plugin: Any, *, kind: str | None = None, **given: Any) -> list[CheckResult]:
    """Make all checks of a plugin in this process and return their results; the parameters are those of `check`."""
    case, results = case_of(kind or kind_of(plugin))(plugin, **given), list[CheckResult]()
    for one in case.checks:
        results.append(one.result(case, results))
    return results


def check(plugin: Any, *, kind: str | None = None, **given: Any) -> None:
    """Make all checks of a plugin in this process.

    Parameters
    ----------
    plugin
        Class, or `partial` of it with options; an instance is refused with a `TypeError`. A QP solver is the function
        itself. Choose a coarse mesh of a problem: some hundred assemblies are made.
    kind
        What `plugin` makes, "problem" for instance, where it is a function that makes an instance.
    **given
        seconds: longest wall time [s] of one call, for a problem of all checks. For a dual strategy: multiplier
        snapshots `snapshots` (m×P) with their space `W`, and `tolerances` and `sizes` at which cones stop. For a primal
        strategy: `offline`, the reduced model to enrich, and `tolerances`. For a formulation: `offline`, a `Reduction`.
        For a sampling strategy: `boxes` by their names in messages. The default is a sample problem.

    Raises
    ------
    ConformanceError
        If a check fails; it lists all failures.
    """
    results = examine(plugin, kind=kind, **given)
    if failures := [f"{each.check}: {each.message}" for each in results if each.verdict is Verdict.FAILED]:
        title = f"{_title(plugin)} fails {len(failures)} of {len(results)} checks"
        raise ConformanceError("\n".join([title, *failures]))


def parametrize_with_checks(*plugins: Any, kind: str | None = None, **given: Any) -> pytest.MarkDecorator:
    """Make a test of pytest one test for every check of every plugin.

    The test has one argument, `check`, and calls it. A check runs in another process, so that a plugin that hangs,
    exits or crashes fails this check alone. A check is skipped if one that it needs fails; what is doubtful is a
    `ConformanceWarning`. The parameters are those of `vibench.testing.check`.

        @parametrize_with_checks(Cable, partial(Cable, nodes=20))
        def test_the_cable_conforms(check):
            check()
    """
    import pytest  # noqa: PLC0415  it is not installed wherever this module is imported

    examinations = [Examination(plugin, kind, **given) for plugin in plugins]
    cases = [(one, name) for one in examinations for name in one.checks]
    parameters = [pytest.param(partial(_report, one, name), id=f"{one.title}-{name}") for one, name in cases]
    return pytest.mark.parametrize("check", parameters)


def _report(examination: Examination, name: str) -> None:
    import pytest  # noqa: PLC0415  see above

    result = examination.result(name)
    if result.verdict is Verdict.FAILED:
        raise ConformanceError(result.message)
    if result.verdict is Verdict.SKIPPED:
        pytest.skip(result.message)
    if result.verdict is Verdict.WARNING:
        warnings.warn(f"{examination.title}, {name}: {result.message}", ConformanceWarning, stacklevel=2)


class Examination:
    """The checks of a plugin in another process, all within `seconds`: one that ends it fails alone."""

    def __init__(self, plugin: Any, kind: str | None = None, seconds: float = SECONDS, **given: Any) -> None:
        self.kind, self.title, self.seconds = kind or kind_of(plugin), _title(plugin), seconds
        self.checks = {one.name: one for one in case_of(self.kind).checks}
        # By value where no other process can import it: from notebooks, and functions of tests.
        self._pickled = cloudpickle.dumps((plugin, given | {"seconds": seconds}))
        self._results = dict[str, CheckResult]()
        self._left = seconds

    def result(self, name: str) -> CheckResult:
        """Result of one check, made when it is first asked for, after those that it needs."""
        if name not in self._results:
            # pytest may have selected this check alone.
            self._results[name] = self._make(name, list(map(self.result, self.checks[name].needs)))
        return self._results[name]

    def results(self) -> Iterator[CheckResult]:
        """Results of all checks as soon as they are made; those that no time is left for are one result."""
        for name in self.checks:
            if self._left <= 0.0:
                late = [other for other in self.checks if other not in self._results]
                yield CheckResult(", ".join(late), Verdict.SKIPPED, "no time is left")
                return
            yield self.result(name)

    def _make(self, name: str, earlier: list[CheckResult]) -> CheckResult:
        if self._left <= 0.0:
            return CheckResult(name, Verdict.SKIPPED, "no time is left")
        arguments = self.kind, self._pickled, name, earlier
        answer = call_isolated(_check_here, *arguments, seconds=self._left, supervisor=_supervisor())
        if not isinstance(answer, Failed):
            result: CheckResult = answer[0]
            self._left -= answer[1]
            return result
        # A hanging call used all the time: no other check is begun.
        if answer.status is Status.TIMEOUT:
            self._left = 0.0
            return CheckResult(name, Verdict.FAILED, f"stopped: the checks take longer than {self.seconds:g} s")
        return CheckResult(name, Verdict.FAILED, answer.reason)


def _check_here(kind: str, pickled: bytes, name: str, earlier: list[CheckResult]) -> tuple[CheckResult, float]:
    """Make a check in this process; returns its result and the wall seconds that it took."""
    begin, case = time.monotonic(), _case(kind, pickled)
    (one,) = (one for one in case.checks if one.name == name)
    return one.result(case, earlier), time.monotonic() - begin


@lru_cache(maxsize=1)
def _case(kind: str, pickled: bytes) -> Any:
    """The case of a plugin, cached: its checks share what it has computed."""
    plugin, given = pickle.loads(pickled)
    return case_of(kind)(plugin, **given)


def _title(plugin: Any) -> str:
    return str(getattr(getattr(plugin, "func", plugin), "__name__", plugin))


def call_in_other_process(function: Callable[..., Any], *arguments: Any, seconds: float) -> Any:
    """Value of a function in another process, whose hashes have another seed than those here."""
    # The seed orders sets of texts.
    seed = "1" if os.environ.get("PYTHONHASHSEED") != "1" else "2"
    value = call_isolated(function, *arguments, seconds=seconds, supervisor=_supervisor(PYTHONHASHSEED=seed))
    if isinstance(value, NotImportableError):
        raise value
    if isinstance(value, Failed):
        raise ConformanceError(f"in another process it fails: {value.reason}")
    return value


@cache
def _supervisor(**environment: str) -> Supervisor:
    """Supervisor of a process with these variables in its environment, which serves all checks of this one."""
    supervisor = Supervisor(environment=environment)
    atexit.register(supervisor.close)
    return supervisor


def raised(error: BaseException) -> str:
    """Describe an exception in one line, with the last line of the plugin's own code that it passed through."""
    place = plugin_line(error)
    # Errors of vibench say what is wrong; their type adds nothing.
    text = str(error) if isinstance(error, VibenchError) else in_a_line(error)
    return text + (f" ({place})" if place else "")


def plugin_line(error: BaseException) -> str:
    """Return where an exception left the plugin, "cable.py, line 12: self.V = …"; "" if it did not pass through it."""
    libraries = [Path(str(module.__file__)).parent for module in (vibench, np, scipy)]
    # Errors of vibench name what a plugin has raised.
    while error.__cause__ is not None:
        error = error.__cause__
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = Path(frame.filename)
        # Installed plugins lie below the standard library, in its folder of packages.
        installed = {"site-packages", "dist-packages"} & set(file.parts)
        folders = libraries if installed else [*libraries, Path(sysconfig.get_path("stdlib"))]
        if not frame.filename.startswith("<") and not any(map(file.is_relative_to, folders)):
            return f"{file.name}, line {frame.lineno}: {frame.line}"
    return ""
