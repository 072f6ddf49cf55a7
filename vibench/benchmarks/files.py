"""Files of pytest-benchmark: what was timed, written and read."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vibench import provenance
from vibench.benchmarks.measure import TIMER, PassTimes
from vibench.errors import RequestError
from vibench.files import read_regular
from vibench.text import parsed_json, unbroken

if TYPE_CHECKING:
    from vibench.benchmarks.running import Benchmark

AXES = ("problem", "dual", "primal", "formulation", "size", "solver", "accuracy")
"""What a benchmark is about: its columns, as far as it has them."""

FUNCTIONS = "vibench/benchmarks::test_"
"""How the full names of benchmarks begin in files."""


def written(benchmarks: Sequence[Benchmark], passes: Mapping[str, Sequence[PassTimes]]) -> bytes:
    """The content of the file of benchmarks, from the passes of those that were timed, by name."""
    import pytest_benchmark  # noqa: PLC0415  it is not installed wherever this module is read
    from pytest_benchmark.plugin import pytest_benchmark_generate_machine_info  # noqa: PLC0415  likewise
    from pytest_benchmark.utils import get_commit_info  # noqa: PLC0415  likewise

    own = {"machine": provenance.machine(), "libraries": provenance.libraries(), "code": provenance.core_code()}
    content = {
        "machine_info": pytest_benchmark_generate_machine_info() | {"vibench": own},  # type: ignore[no-untyped-call]
        "commit_info": get_commit_info(),  # type: ignore[no-untyped-call]
        "benchmarks": [_entry(one, passes[one.name]) for one in benchmarks if one.name in passes],
        "datetime": datetime.now(UTC).isoformat(),
        "version": pytest_benchmark.__version__,
    }
    return json.dumps(content, indent=4, default=str).encode()


def _entry(benchmark: Benchmark, passes: Sequence[PassTimes]) -> dict[str, Any]:
    """The entry of a benchmark: its statistics are over the rounds of all passes, which are kept beside them."""
    axes = {"case": benchmark.case, **dict(benchmark.axes)}
    several = []
    for one in passes:
        fields = _statistics(one.seconds)
        kept = {name: fields[name] for name in ("q1", "median", "q3", "rounds")}
        several.append(kept | {"calibration_s": one.calibration})
    every = [seconds for one in passes for seconds in one.seconds]
    return {
        "group": passes[0].group,
        "name": f"test_{benchmark.name}",
        "fullname": f"{FUNCTIONS}{benchmark.name}",
        "params": None,
        "param": benchmark.parameters,
        "extra_info": {**passes[0].info, "axes": {axis: str(value) for axis, value in axes.items()}, "passes": several},
        "options": {"timer": TIMER.__name__},
        "stats": {**_statistics(every), "data": every, "iterations": passes[0].calls},
    }


def _statistics(seconds: Sequence[float]) -> dict[str, Any]:
    from pytest_benchmark.stats import Stats  # noqa: PLC0415  it is not installed wherever this module is read

    stats = Stats()  # type: ignore[no-untyped-call]
    stats.data.extend(seconds)
    fields: dict[str, Any] = stats.as_dict()  # type: ignore[no-untyped-call]
    return fields


@dataclass(frozen=True)
class Measured:
    """One benchmark of a file."""

    group: str
    """What is timed."""
    axes: Mapping[str, str]
    """With which plugins."""
    seconds: float
    """Median over the rounds, in CPU seconds of one call."""
    q1: float
    q3: float
    low: float
    """The smallest lower quartile of a pass; `q1`, where there was one."""
    high: float
    """The largest upper quartile of a pass; `q3`, where there was one."""
    rounds: int
    accuracy: Mapping[str, float | None]
    """Figures that should be small; `None` where one was not finite."""
    status: str
    """Status of what a QP solver answered, "" where none was asked."""
    calibration: float
    """CPU seconds of fixed work beside it, median over the passes: how fast the machine was then; NaN where unknown."""


@dataclass(frozen=True)
class Timed:
    """What a file holds: benchmarks by name, and what they were timed on: machine, libraries, timer, code."""

    benchmarks: Mapping[str, Measured]
    machine: Mapping[str, str]


def read_benchmarks(path: Path) -> Timed:
    """What a file of pytest-benchmark holds.

    Raises a `RequestError` if it is none.
    """
    try:
        return parsed(read_regular(path))
    except (OSError, ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        reason = unbroken(f"{type(error).__name__}: {error}")
        raise RequestError(f"'{path}' cannot be read as a file of pytest-benchmark ({reason})") from None


def parsed(content: bytes) -> Timed:
    """What the content of a file of pytest-benchmark says.

    Raises a `ValueError` if it is no JSON, has a benchmark twice, or seconds that no clock gives; like other exceptions
    of Python where the structure is another.
    """
    file = parsed_json(content)
    benchmarks: dict[str, Measured] = {}
    for entry in file["benchmarks"]:
        name = _name(entry["fullname"])
        if name in benchmarks:
            raise ValueError(f"it has '{name}' twice")
        benchmarks[name] = _measured(entry)
    return Timed(benchmarks, _machine(file["machine_info"], file["benchmarks"]))


def _name(fullname: str) -> str:
    """Name without the folder and what every file and function begins with."""
    return unbroken(str(fullname).rsplit("/", 1)[-1].split("::", 1)[-1].removeprefix("test_"))


def _measured(entry: Mapping[str, Any]) -> Measured:
    extra, stats = entry.get("extra_info", {}), entry["stats"]
    axes = {str(name): unbroken(str(value)) for name, value in extra.get("axes", {}).items()}
    axes = {"problem": axes.get("case", "")} | axes
    passes = [stats, *extra.get("passes", [])]
    calibrations = [_seconds(one, "calibration_s") for one in passes if "calibration_s" in one]
    return Measured(
        group=unbroken(str(entry.get("group") or _name(entry["fullname"]).partition("[")[0])),
        axes={name: axes[name] for name in AXES if axes.get(name)},
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
    texts = {"machine": machine, "libraries": libraries, "timer": ", ".join(timers), "code": own.get("code", "")}
    return {name: unbroken(str(text)) for name, text in texts.items()}
