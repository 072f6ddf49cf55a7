"""Checks, their findings, and the error that lists the failures."""

from __future__ import annotations

import inspect
import sysconfig
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Generic, ParamSpec, TypeVar

import numpy as np
import scipy

import vibench
from vibench.errors import in_a_line

CaseT = TypeVar("CaseT")
P = ParamSpec("P")

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
class Finding:
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
class Check(Generic[CaseT]):
    """A check: a name, a function from a case to its faults and notes, and the names of checks that must pass before.

    A function that reports its faults by a `ConformanceError` alone returns `None`.
    """

    name: str
    faults: Callable[[CaseT], Iterable[str] | None]
    needs: tuple[str, ...] = ()


def examine(checks: Iterable[Check[CaseT]], case: CaseT) -> list[Finding]:
    """Make checks in their order; skip a check if one that it needs did not pass."""
    findings: dict[str, Finding] = {}
    for check in checks:
        findings[check.name] = examine_one(check, case, findings)
    return list(findings.values())


def examine_one(check: Check[CaseT], case: CaseT, findings: Mapping[str, Finding]) -> Finding:
    """Make one check, unless one that it needs is not among the findings or did not pass."""
    passed = {name for name, found in findings.items() if found.verdict in (Verdict.PASSED, Verdict.WARNING)}
    missing = [name for name in check.needs if name not in passed]
    if missing:
        return Finding(check.name, Verdict.SKIPPED, f"it needs '{missing[0]}'")
    lines: list[str] = []
    try:
        for line in check.faults(case) or ():
            lines.append(line)  # noqa: PERF402  what precedes an exception is kept
    except (Exception, SystemExit) as error:  # noqa: BLE001  a plugin may raise anything
        lines.append(str(error) if isinstance(error, ConformanceError) else raised(error))
    faults = [line for line in lines if not isinstance(line, Note | Doubt)]
    if len(faults) > MOST:
        faults[MOST:] = ["and more"]
    doubtful = any(isinstance(line, Doubt) for line in lines)
    verdict = Verdict.FAILED if faults else Verdict.WARNING if doubtful else Verdict.PASSED
    return Finding(check.name, verdict, "; ".join(faults or lines))


def raising(examination: Callable[P, list[Finding]]) -> Callable[P, None]:
    """Turn `examine_…` into `check_…`, which has the same parameters and raises if a check fails."""
    signature = inspect.signature(examination)

    def check(*args: P.args, **kwargs: P.kwargs) -> None:
        findings = examination(*args, **kwargs)
        failures = [f"{each.check}: {each.message}" for each in findings if each.verdict is Verdict.FAILED]
        if failures:
            create = signature.bind(*args, **kwargs).arguments["create"]
            plugin = getattr(getattr(create, "func", create), "__name__", create)
            raise ConformanceError("\n".join([f"{plugin} fails {len(failures)} of {len(findings)} checks", *failures]))

    name, check.__module__ = examination.__name__, examination.__module__
    check.__name__ = check.__qualname__ = name.replace("examine", "check")
    check.__doc__ = f"Make the checks of `{name}`; raise a `ConformanceError` that lists all failures if there are any."
    check.__signature__ = signature.replace(return_annotation=None)  # type: ignore[attr-defined]
    return check


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
