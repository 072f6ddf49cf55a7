"""Files of pytest-benchmark read, as tables, and two of them side by side: slower beyond its spread, less accurate."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from vibench.errors import RequestError
from vibench.files import read_regular
from vibench.text import parsed_json, unbroken

# Columns of a benchmark: the plugins that it is timed with.
AXES = ("problem", "dual", "primal", "formulation", "size", "solver", "accuracy")


class Measured(NamedTuple):
    """One benchmark of a file; times are CPU seconds of one call."""

    group: str
    axes: Mapping[str, str]
    seconds: float  # median over the rounds of all passes
    q1: float
    q3: float
    low: float  # the smallest lower quartile of a pass
    high: float  # the largest upper quartile of a pass
    rounds: int
    accuracy: Mapping[str, float | None]  # errors and residuals; `None` where one was not finite
    status: str  # of the answer of a QP solver, "" where none was asked
    calibration: float  # seconds of fixed work beside it, which say how fast the machine was; NaN where unknown


class Timed(NamedTuple):
    """Content of a file: benchmarks by name, how many failed, and machine, libraries, timer and code."""

    benchmarks: Mapping[str, Measured]
    failed: int
    machine: Mapping[str, str]


def read_benchmarks(path: Path) -> Timed:
    """Read a file of pytest-benchmark; raises a `RequestError` if it is none."""
    try:
        return _parsed(read_regular(path))
    except (OSError, ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        reason = unbroken(f"{type(error).__name__}: {error}")
        raise RequestError(f"'{path}' cannot be read as a file of pytest-benchmark ({reason})") from None


def _parsed(content: bytes) -> Timed:
    file = parsed_json(content)
    benchmarks: dict[str, Measured] = {}
    for entry in file["benchmarks"]:
        # Without the folder, and what every file and function begins with.
        name = unbroken(str(entry["fullname"]).rsplit("/", 1)[-1].split("::", 1)[-1].removeprefix("test_"))
        if name in benchmarks:
            raise ValueError(f"it has '{name}' twice")
        benchmarks[name] = _measured(name, entry)
    info, own = file["machine_info"], file["machine_info"].get("vibench", {})
    timers = sorted({entry["options"]["timer"] for entry in file["benchmarks"] if "options" in entry})
    processor = f"{info.get('cpu', {}).get('brand_raw', '')} {info.get('machine', '')}".strip()
    libraries = own.get("libraries") or f"python {info.get('python_version', '')}"
    machine = {"machine": own.get("machine") or processor, "libraries": libraries}
    machine |= {"timer": ", ".join(timers), "code": own.get("code", "")}
    return Timed(benchmarks, len(file.get("failed", ())), {name: unbroken(str(text)) for name, text in machine.items()})


def _measured(name: str, entry: Mapping[str, Any]) -> Measured:
    extra, stats = entry.get("extra_info", {}), entry["stats"]
    axes = {str(axis): unbroken(str(value)) for axis, value in extra.get("axes", {}).items()}
    axes = {"problem": axes.get("case", "")} | axes
    # Files that pytest-benchmark alone has written have one pass.
    passes = [stats, *extra.get("passes", [])]
    calibrations = [_seconds(one, "calibration_s") for one in passes if "calibration_s" in one]
    accuracy = extra.get("accuracy", {}).items()
    return Measured(
        group=unbroken(str(entry.get("group") or name.partition("[")[0])),
        axes={axis: axes[axis] for axis in AXES if axes.get(axis)},
        seconds=_seconds(stats, "median"), q1=_seconds(stats, "q1"), q3=_seconds(stats, "q3"),
        low=min(_seconds(one, "q1") for one in passes),
        high=max(_seconds(one, "q3") for one in passes), rounds=int(stats["rounds"]),
        accuracy={unbroken(str(figure)): None if value is None else float(value) for figure, value in accuracy},
        status=unbroken(str(extra.get("status", ""))),
        calibration=statistics.median(calibrations) if calibrations else math.nan,
    )  # fmt: skip


def _seconds(stats: Mapping[str, Any], name: str) -> float:
    """Seconds of a file, which others may have written."""
    seconds = float(stats[name])
    if not (math.isfinite(seconds) and seconds >= 0.0):
        raise ValueError(f"{name} is {seconds:g} s, expected a finite number that is not negative")
    return seconds


def table_of(timed: Timed, earlier: Timed | None, limit: float) -> pd.DataFrame:
    """A row for every benchmark; with an earlier file, for every one of both, with what changed."""
    if earlier is None:
        return pd.DataFrame([{
            "benchmark": name, "group": one.group, **{axis: one.axes.get(axis, "") for axis in AXES},
            "median_s": one.seconds, "q1_s": one.q1, "q3_s": one.q3, "rounds": one.rounds, "status": one.status,
            **{f"reached_{figure}": value for figure, value in one.accuracy.items()},
        } for name, one in timed.benchmarks.items()])  # fmt: skip
    both = (name for name in earlier.benchmarks if name in timed.benchmarks)
    return pd.DataFrame([_change(name, earlier.benchmarks[name], timed.benchmarks[name], limit) for name in both])


def _change(name: str, was: Measured, now: Measured, limit: float) -> dict[str, Any]:
    pairs = {name: (was.accuracy.get(name), now.accuracy.get(name)) for name in [*was.accuracy, *now.accuracy]}
    figure = max(pairs, key=lambda name: (_is_worse(*pairs[name]), _growth(*pairs[name])), default="")
    before, after = pairs.get(figure, (None, None))
    changes = ["slower"] * _is_slower(was, now, limit) + ["faster"] * _is_slower(now, was, limit)
    changes += ["less accurate"] * _is_worse(before, after)
    changes += [f"{was.status}, now {now.status or 'nothing'}"] if was.status == "ok" != now.status else []
    return {
        "benchmark": name, "group": was.group, **{axis: was.axes.get(axis, "") for axis in AXES},
        "before_s": was.seconds, "after_s": now.seconds,
        "ratio": now.seconds / was.seconds if was.seconds > 0.0 else math.nan,
        "apart": "yes" if now.low > was.high or was.low > now.high else "no",
        "figure": figure, "before": before, "after": after, "verdict": ", ".join(changes),
    }  # fmt: skip


def _is_worse(before: float | None, after: float | None) -> bool:
    """Return if a figure of accuracy grew by more than round-off may, ten times and beyond 1e-9, or is gone."""
    if before is None or after is None:
        return before is not None
    return after > 1e-9 and after > 10.0 * before


def _growth(before: float | None, after: float | None) -> tuple[float, float]:
    """Factor by which a figure grew, and its size; the factor is infinite if there is none any more."""
    # Growth from below 1e-10 is round-off.
    factor = math.inf if after is None else after / max(before or 0.0, 1e-10)
    return 0.0 if before is None else factor, after or 0.0


def _is_slower(was: Measured, now: Measured, limit: float) -> bool:
    """Return if the seconds grew beyond a limit, beyond their spread, and beyond what the machine was slower by."""
    # Clocks and caches do not resolve 10 µs.
    if now.seconds - was.seconds <= 10e-6 or now.low <= was.high:
        return False
    slowdown = now.calibration / was.calibration if was.calibration > 0.0 else math.nan
    # A single round has no spread.
    margin = limit**2 if min(was.rounds, now.rounds) == 1 else limit
    return now.seconds > margin * (slowdown if slowdown > 1.0 else 1.0) * was.seconds


def remarks(before: Timed, after: Timed, frame: pd.DataFrame, limit: float) -> list[str]:
    """Lines on what is new or gone, machines and libraries that differ, and how many benchmarks got worse."""
    lines = []
    for what, some, others in (("new", after, before), ("gone", before, after)):
        names = [name for name in some.benchmarks if name not in others.benchmarks]
        lines += [f"{what}: {', '.join(names)}"] if names else []
    for what, said in before.machine.items():
        if said != after.machine[what]:
            lines += [f"{what} before: {said}", f"{what} after:  {after.machine[what]}"]
    ratios = frame["ratio"].dropna() if len(frame) else frame
    middle = f", median of the ratios {ratios.median():.3g}" if len(ratios) else ""
    return [*lines, f"{len(frame)} benchmarks in both files{middle}; {regressions(frame)} worse (limit {limit:g})"]


def regressions(frame: pd.DataFrame) -> int:
    """Count the benchmarks of a table of two files that got worse in any way."""
    return sum(row["verdict"] not in ("", "faster") for row in frame.to_dict("records"))
