"""What checks find: one line each, and where to look for the cause."""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
import scipy

import vibench
from vibench.errors import in_a_line

MOST = 5
"""Faults that one check lists; whoever has mended these looks again."""


SECONDS = 60.0
"""Longest time that anything may take unless the caller says otherwise: above it there is a mistake."""


class Verdict(StrEnum):
    """What became of a check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Finding:
    """One check.

    Attributes
    ----------
    check
        What was looked at.
    verdict
        What became of it.
    message
        Of a failure all that is wrong and where; why a check was skipped; figures of a check that passed, or "".
    """

    check: str
    verdict: Verdict
    message: str = ""

    def __str__(self) -> str:
        return f"{self.verdict:<7}  {self.check}" + (f": {self.message}" if self.message else "")


class Note(str):
    """Something that a check has to say and that is no fault."""

    __slots__ = ()


class ConformanceError(AssertionError):
    """A plugin that fails checks; the message lists all of them."""


@dataclass(frozen=True)
class Check:
    """A check: its name, what yields the faults (and a `Note`), and names of checks without which it tells nothing."""

    name: str
    faults: Callable[[], Iterable[str]]
    needs: tuple[str, ...] = ()


def examine(checks: Iterable[Check]) -> list[Finding]:
    """Do checks in their order; a check that needs one that did not pass is skipped.

    An exception in a check is a fault: it comes from the code that is checked.
    """
    findings: list[Finding] = []
    passed: set[str] = set()
    for check in checks:
        missing = [name for name in check.needs if name not in passed]
        if missing:
            findings.append(Finding(check.name, Verdict.SKIPPED, f"it needs '{missing[0]}'"))
            continue
        faults, notes = _collected(check.faults)
        if faults:
            findings.append(Finding(check.name, Verdict.FAILED, "; ".join(faults)))
        else:
            passed.add(check.name)
            findings.append(Finding(check.name, Verdict.PASSED, "; ".join(notes)))
    return findings


def _collected(source: Callable[[], Iterable[str]]) -> tuple[list[str], list[str]]:
    faults: list[str] = []
    notes: list[str] = []
    try:
        for line in source():
            if isinstance(line, Note):
                notes.append(line)
            elif len(faults) == MOST:
                faults.append("and more")
                break
            else:
                faults.append(line)
    except (Exception, SystemExit) as error:  # noqa: BLE001  checks run code of strangers
        faults.append(raised(error))
    return faults, notes


def raised(error: BaseException) -> str:
    """An exception in a line, and the last line of code of its own that the plugin had come to."""
    place = plugin_line(error)
    return in_a_line(error) + (f" ({place})" if place else "")


def plugin_line(error: BaseException) -> str:
    """Where an exception left the plugin: "cable.py, line 12: self.V = …"; "" if it never was there."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not _is_library(frame.filename)]
    return f"{Path(frames[-1].filename).name}, line {frames[-1].lineno}: {frames[-1].line}" if frames else ""


def _is_library(file: str) -> bool:
    path = Path(file)
    if any(path.is_relative_to(Path(str(module.__file__)).parent) for module in (vibench, np, scipy)):
        return True
    standard = path.is_relative_to(sysconfig.get_path("stdlib"))
    return file.startswith("<") or (standard and not {"site-packages", "dist-packages"} & set(path.parts))


def require(name: str, findings: Sequence[Finding]) -> None:
    """Raise if a check failed.

    Raises
    ------
    ConformanceError
        With a line for every failure.
    """
    failures = [finding for finding in findings if finding.verdict is Verdict.FAILED]
    if failures:
        lines = [f"{finding.check}: {finding.message}" for finding in failures]
        raise ConformanceError("\n".join([f"{name} fails {len(failures)} of {len(findings)} checks", *lines]))


def name_of(create: Callable[[], object]) -> str:
    """What to call the plugin that a function makes.

    Raises
    ------
    TypeError
        If it is an instance where a class, or a function that makes instances, is asked for.
    """
    if not callable(create):
        raise TypeError(
            f"give the class {type(create).__name__}, or a function that makes an instance, instead of an instance: "
            "two instances have to agree"
        )
    return str(getattr(getattr(create, "func", create), "__name__", create))


def too_long(what: str, seconds: Sequence[float], limit: float) -> Iterator[str]:
    """A fault if something took longer than the limit once [s], and how long it takes."""
    if max(seconds) > limit:
        yield f"{what} takes {max(seconds):.3g} s, above the limit of {limit:g} s; is something made anew every time?"
    yield Note(f"{what} takes {np.median(seconds):.2g} s")
