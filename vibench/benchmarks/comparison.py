"""Files of benchmarks as tables, and two of them side by side: what is slower beyond its spread, and less accurate."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from vibench.errors import RequestError
from vibench.text import parsed_json, unbroken

LIMIT = 1.25
"""Ratio of medians above which something is slower."""

SHORTEST = 10e-6
"""Seconds by which a median may grow whatever the ratio is: clocks and caches do not resolve less."""

FACTOR, NEGLIGIBLE = 10.0, 1e-9
"""A figure of accuracy is worse if it is more than this many times what it was; below this size none is."""

AXES = ("problem", "dual", "primal", "size", "solver", "accuracy")
"""What a benchmark is about: its columns, as far as it has them."""


@dataclass(frozen=True)
class Measured:
    """One benchmark of a file.

    Attributes
    ----------
    group, axes
        What is timed, and with which plugins.
    seconds, q1, q3
        Median and quartiles over the rounds, in CPU seconds of one call.
    low, high
        The smallest lower and the largest upper quartile of a pass; the quartiles, where there was one.
    rounds
        Their number.
    accuracy
        Figures that should be small; `None` where one was not finite.
    status
        Of what a QP solver answered, "" where none was asked.
    calibration
        CPU seconds of fixed work beside it, median over the passes: how fast the machine was then; NaN where unknown.
    """

    group: str
    axes: Mapping[str, str]
    seconds: float
    q1: float
    q3: float
    low: float
    high: float
    rounds: int
    accuracy: Mapping[str, float | None]
    status: str
    calibration: float


@dataclass(frozen=True)
class Timed:
    """What a file holds: benchmarks by name, and what they were timed on: machine, libraries, timer, code."""

    benchmarks: Mapping[str, Measured]
    machine: Mapping[str, str]


def read(path: Path) -> Timed:
    """What a file of pytest-benchmark holds.

    Raises
    ------
    RequestError
        If it is none.
    """
    try:
        return parsed(path.read_bytes())
    except (OSError, ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        reason = unbroken(f"{type(error).__name__}: {error}")
        raise RequestError(f"'{path}' cannot be read as a file of pytest-benchmark ({reason})") from None


def parsed(content: bytes) -> Timed:
    """What the content of a file of pytest-benchmark says.

    Raises
    ------
    ValueError
        If it is no JSON, has a benchmark twice, or seconds that no clock gives; like other exceptions of Python where
        the structure is another.
    """
    known = parsed_json(content)
    found: dict[str, Measured] = {}
    for entry in known["benchmarks"]:
        name = _name(entry["fullname"])
        if name in found:
            raise ValueError(f"it has '{name}' twice")
        found[name] = _measured(entry)
    return Timed(found, _machine(known["machine_info"], known["benchmarks"]))


def _name(fullname: str) -> str:
    """Name without the folder and what every file and function begins with."""
    return unbroken(str(fullname).rsplit("/", 1)[-1].split("::", 1)[-1].removeprefix("test_"))


def _measured(entry: Mapping[str, Any]) -> Measured:
    extra, stats = entry.get("extra_info", {}), entry["stats"]
    axes = {str(name): unbroken(str(value)) for name, value in extra.get("axes", {}).items()}
    known = {"problem": axes.get("case", "")} | axes
    passes = [stats, *extra.get("passes", [])]
    calibrations = [_seconds(one, "calibration_s") for one in passes if "calibration_s" in one]
    return Measured(
        group=unbroken(str(entry.get("group") or _name(entry["fullname"]).partition("[")[0])),
        axes={name: known[name] for name in AXES if known.get(name)},
        seconds=_seconds(stats, "median"),
        q1=_seconds(stats, "q1"),
        q3=_seconds(stats, "q3"),
        low=min(_seconds(one, "q1") for one in passes),
        high=max(_seconds(one, "q3") for one in passes),
        rounds=int(stats["rounds"]),
        accuracy={
            unbroken(str(name)): None if value is None else float(value)
            for name, value in extra.get("accuracy", {}).items()
        },
        status=unbroken(str(extra.get("status", ""))),
        calibration=statistics.median(calibrations) if calibrations else math.nan,
    )


def _seconds(stats: Mapping[str, Any], name: str) -> float:
    """Seconds of a file, which others may have written."""
    seconds = float(stats[name])
    if not (math.isfinite(seconds) and seconds >= 0.0):
        raise ValueError(f"{name} is {seconds:g} s, expected a finite number that is not negative")
    return seconds


def _machine(info: Mapping[str, Any], benchmarks: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    own = info.get("vibench", {})
    timers = sorted({entry["options"]["timer"] for entry in benchmarks if "options" in entry})
    machine = own.get("machine") or f"{info.get('cpu', {}).get('brand_raw', '')} {info.get('machine', '')}".strip()
    libraries = own.get("libraries") or f"python {info.get('python_version', '')}"
    found = {"machine": machine, "libraries": libraries, "timer": ", ".join(timers), "code": own.get("code", "")}
    return {name: unbroken(str(text)) for name, text in found.items()}


Figures = tuple[str, float | None, float | None]
"""A figure of accuracy: its name, before and after; `None` where there is none or it is not finite."""


def figures(before: Measured, after: Measured) -> list[Figures]:
    """Figures of accuracy that either has, the one that got worse most first."""
    names = dict.fromkeys([*before.accuracy, *after.accuracy])
    pairs = [(name, before.accuracy.get(name), after.accuracy.get(name)) for name in names]
    return sorted(pairs, key=_times_worse, reverse=True)


def _times_worse(figure: Figures) -> tuple[float, float]:
    """How many times what it was, and how large; infinitely worse if it is no more."""
    _, before, after = figure
    if after is None:
        return (0.0 if before is None else math.inf), 0.0
    return (after / max(before, NEGLIGIBLE / FACTOR) if before is not None else 0.0), after


def is_worse(figure: Figures) -> bool:
    """Whether a figure got worse by more than round-off may."""
    _, before, after = figure
    if before is None or after is None:
        return before is not None
    return after > NEGLIGIBLE and after > FACTOR * before


def is_slower(before: Measured, after: Measured, limit: float) -> bool:
    """Whether the seconds grew beyond a limit, beyond their spread, and beyond what the machine was slower by.

    The ranges between the quartiles of any two passes must not meet, the medians must be more than 10 µs apart, and
    their ratio must be above the limit, also relative to the calibration, fixed work that was timed beside both. Where
    one of them has a single round, which has no spread, the ratio must be above the square of the limit.
    """
    if after.seconds - before.seconds <= SHORTEST or after.low <= before.high:
        return False
    slowdown = after.calibration / before.calibration if before.calibration > 0.0 else math.nan
    margin = limit**2 if min(before.rounds, after.rounds) == 1 else limit
    allowed = margin * (slowdown if slowdown > 1.0 else 1.0)
    return after.seconds > allowed * before.seconds


def verdict(before: Measured, after: Measured, limit: float) -> str:
    """What got worse, "" if nothing did."""
    found = ["slower"] if is_slower(before, after, limit) else []
    found += ["faster"] if not found and is_slower(after, before, limit) else []
    found += ["less accurate"] if any(map(is_worse, figures(before, after))) else []
    found += [f"{before.status}, now {after.status or 'nothing'}"] if before.status == "ok" != after.status else []
    return ", ".join(found)


def is_regression(before: Measured, after: Measured, limit: float) -> bool:
    """Whether anything got worse."""
    return verdict(before, after, limit) not in ("", "faster")


def table(found: Timed) -> pd.DataFrame:
    """A row per benchmark: what is timed, with what, its seconds with their quartiles, and what it reached."""
    rows = [
        {
            "benchmark": name,
            "group": one.group,
            **{axis: one.axes.get(axis, "") for axis in AXES},
            "median_s": one.seconds,
            "q1_s": one.q1,
            "q3_s": one.q3,
            "rounds": one.rounds,
            "status": one.status,
            **{f"reached_{figure}": value for figure, value in one.accuracy.items()},
        }
        for name, one in found.benchmarks.items()
    ]
    return pd.DataFrame(rows)


def compared(before: Timed, after: Timed, limit: float) -> pd.DataFrame:
    """A row for every benchmark of both files; of its figures of accuracy, the one that got worse most."""
    rows = []
    for name, was in before.benchmarks.items():
        now = after.benchmarks.get(name)
        if now is None:
            continue
        worst = next((f for f in figures(was, now) if is_worse(f)), (*figures(was, now), ("", None, None))[0])
        rows.append(
            {
                "benchmark": name,
                "group": was.group,
                **{axis: was.axes.get(axis, "") for axis in AXES},
                "before_s": was.seconds,
                "after_s": now.seconds,
                "ratio": now.seconds / was.seconds if was.seconds > 0.0 else math.nan,
                "apart": "yes" if now.low > was.high or was.low > now.high else "no",
                "figure": worst[0],
                "before": worst[1],
                "after": worst[2],
                "verdict": verdict(was, now, limit),
            }
        )
    return pd.DataFrame(rows)


def remarks(before: Timed, after: Timed, limit: float) -> list[str]:
    """What is new or gone, machines and libraries that differ, and how many benchmarks got worse."""
    lines = []
    for what, some, others in (("new", after, before), ("gone", before, after)):
        names = [name for name in some.benchmarks if name not in others.benchmarks]
        lines += [f"{what}: {', '.join(names)}"] if names else []
    for what, said in before.machine.items():
        if said != after.machine.get(what, ""):
            lines += [f"{what} before: {said}", f"{what} after:  {after.machine.get(what, '')}"]
    shared = [(one, after.benchmarks[name]) for name, one in before.benchmarks.items() if name in after.benchmarks]
    ratios = [now.seconds / was.seconds for was, now in shared if was.seconds > 0.0]
    middle = f", median of the ratios {pd.Series(ratios).median():.3g}" if ratios else ""
    worse = regressions(before, after, limit)
    return [*lines, f"{len(shared)} benchmarks in both files{middle}; {len(worse)} worse (limit {limit:g})"]


def regressions(before: Timed, after: Timed, limit: float) -> list[str]:
    """Names of the benchmarks that got worse."""
    both: Callable[[str], bool] = after.benchmarks.__contains__
    shared = filter(both, before.benchmarks)
    return [name for name in shared if is_regression(before.benchmarks[name], after.benchmarks[name], limit)]
