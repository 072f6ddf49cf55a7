"""Checks of plugins, their results, and the error that lists the failures."""

from __future__ import annotations

import inspect
import sysconfig
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np
import scipy

import vibench
from vibench.errors import in_a_line

CaseT_contra = TypeVar("CaseT_contra", contravariant=True)
P = ParamSpec("P")
T = TypeVar("T")

MOST = 5
"""Largest number of faults that one check lists."""

SECONDS = 120.0
"""Default wall time [s] that the checks of a plugin may take; no call of it may take longer."""


class Verdict(StrEnum):
    """Outcome of a check."""

    PASSED = "passed"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class CheckResult:
    """Result of one check: its name, its outcome, and a message.

    The message gives every fault and its place, the reason why a check was skipped, or the figures of a passed one and
    what is doubtful.
    """

    check: str
    verdict: Verdict
    message: str = ""

    def __str__(self) -> str:
        return f"{self.verdict:<7}  {self.check}" + (f": {self.message}" if self.message else "")


class Note(str):
    """A remark of a check that is not a fault."""

    __slots__ = ()


class Doubt(str):
    """A remark on what is probably not intended, although it is allowed; it turns a passed check into a warning."""

    __slots__ = ()


class ConformanceError(AssertionError):
    """A plugin violates what vibench assumes of it; raised in a check, it is a fault that ends the check."""


@dataclass(frozen=True)
class Check(Generic[CaseT_contra]):
    """A check: a name, a function from a case to its faults and notes, and the names of checks that must pass before.

    A function that reports its faults by a `ConformanceError` alone returns `None`.
    """

    name: str
    faults: Callable[[CaseT_contra], Iterable[str] | None]
    needs: tuple[str, ...] = ()

    def result(self, case: CaseT_contra, earlier: Iterable[CheckResult]) -> CheckResult:
        """Make the check, unless one that it needs is not among the earlier ones or did not pass."""
        passed = {one.check for one in earlier if one.verdict in (Verdict.PASSED, Verdict.WARNING)}
        missing = [name for name in self.needs if name not in passed]
        if missing:
            return CheckResult(self.name, Verdict.SKIPPED, f"it needs '{missing[0]}'")
        lines: list[str] = []
        try:
            for line in self.faults(case) or ():
                lines.append(line)  # noqa: PERF402  what precedes an exception is kept
        except (Exception, SystemExit) as error:  # noqa: BLE001  a plugin may raise anything
            lines.append(str(error) if isinstance(error, ConformanceError) else raised(error))
        faults = [line for line in lines if not isinstance(line, Note | Doubt)]
        if len(faults) > MOST:
            faults[MOST:] = ["and more"]
        doubtful = any(isinstance(line, Doubt) for line in lines)
        verdict = Verdict.FAILED if faults else Verdict.WARNING if doubtful else Verdict.PASSED
        return CheckResult(self.name, verdict, "; ".join(faults or lines))


@dataclass(frozen=True)
class Conformance(Generic[P, CaseT_contra]):
    """The conformance checks of one kind of plugins.

    `examine` and `check` are the functions `vibench.testing.examine_KIND` and `check_KIND`. Their parameters are those
    of the case, whose docstring explains them.
    """

    kind: str
    """The kind, as `vibench check KIND:NAME` has it."""
    case: Callable[P, CaseT_contra]
    """What makes a case of a plugin, or of a function that makes an instance, and of further arguments."""
    checks: tuple[Check[CaseT_contra], ...]

    @cached_property
    def examine(self) -> Callable[P, list[CheckResult]]:
        """The function that makes all checks and returns their results."""

        def examine(*args: P.args, **kwargs: P.kwargs) -> list[CheckResult]:
            case, results = self.case(*args, **kwargs), list[CheckResult]()
            for check in self.checks:
                results.append(check.result(case, results))
            return results

        return self._public(examine, f"Make all checks of a {self.kind} and return their results.", list[CheckResult])

    @cached_property
    def check(self) -> Callable[P, None]:
        """The function that makes all checks and raises a `ConformanceError` that lists those that fail."""

        def check(*args: P.args, **kwargs: P.kwargs) -> None:
            results = self.examine(*args, **kwargs)
            failures = [f"{each.check}: {each.message}" for each in results if each.verdict is Verdict.FAILED]
            if failures:
                create = inspect.signature(self.case).bind(*args, **kwargs).arguments["create"]
                plugin = getattr(getattr(create, "func", create), "__name__", create)
                raise ConformanceError(
                    "\n".join([f"{plugin} fails {len(failures)} of {len(results)} checks", *failures])
                )

        return self._public(
            check, f"Make all checks of a {self.kind}; raise a `ConformanceError` that lists the failures."
        )

    def _public(self, function: Callable[P, T], summary: str, returned: Any = None) -> Callable[P, T]:
        """The function under its public name, with the parameters of the case and what is said of them."""
        name = f"{function.__name__}_{self.kind}"
        explained = "\n\n".join([summary, *str(inspect.getdoc(self.case)).split("\n\n")[1:]])
        signature = inspect.signature(self.case).replace(return_annotation=returned)
        vars(function).update(__signature__=signature)
        function.__name__, function.__qualname__, function.__module__ = name, name, "vibench.testing"
        function.__doc__ = explained
        return function


def raised(error: BaseException) -> str:
    """An exception in one line, with the last line of the plugin's own code that it passed through."""
    place = plugin_line(error)
    return in_a_line(error) + (f" ({place})" if place else "")


def plugin_line(error: BaseException) -> str:
    """Where an exception left the plugin, "cable.py, line 12: self.V = …"; "" if it did not pass through it."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_library(frame.filename)]
    return f"{Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line}" if frames else ""


def _is_library(file: str) -> bool:
    folders = [Path(str(module.__file__)).parent for module in (vibench, np, scipy)]
    # Installed plugins lie below the standard library, in its folder of packages.
    if not {"site-packages", "dist-packages"} & set(Path(file).parts):
        folders.append(Path(sysconfig.get_path("stdlib")))
    return file.startswith("<") or any(map(Path(file).is_relative_to, folders))
