"""Two files of `pytest tests/benchmarks --benchmark-json=FILE` side by side: what is slower, and what is less accurate?

    python tests/benchmarks/compare.py BEFORE.json AFTER.json [--limit 1.25]

Exit code 1 if a median takes longer by more than the limit, a figure of accuracy is more than ten times what it was and
above 1e-9, or a QP solver ends with another status than "ok" where it did not before; 2 if a file cannot be read.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from vibench.results import tables

LIMIT = 1.25
"""Ratio of medians above which something is slower; what noise there is on the machine has to fit below it."""

FACTOR, NEGLIGIBLE = 10.0, 1e-9
"""A figure of accuracy is worse if it is more than this many times what it was; below this size none is."""


@dataclass(frozen=True)
class Measured:
    """One benchmark of a file.

    Attributes
    ----------
    seconds
        Median.
    accuracy
        Figures that should be small; `None` where one was not finite.
    status
        Of what a QP solver answered, "" where none was asked.
    """

    seconds: float
    accuracy: Mapping[str, float | None]
    status: str


@dataclass(frozen=True)
class Timed:
    """What a file holds: benchmarks by name, and what they were timed on: machine, libraries, timer, code."""

    benchmarks: Mapping[str, Measured]
    machine: Mapping[str, str]


def read(path: Path) -> Timed:
    """What a file holds.

    Raises
    ------
    ValueError
        If it is no file of pytest-benchmark.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found = {_name(entry["fullname"]): _measured(entry) for entry in content["benchmarks"]}
        return Timed(found, _machine(content["machine_info"], content["benchmarks"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} cannot be read as a file of pytest-benchmark: {error!r}") from None


def _name(fullname: str) -> str:
    """Name without the folder and what every file and function begins with."""
    return fullname.rsplit("/", 1)[-1].split("::", 1)[-1].removeprefix("test_")


def _measured(entry: Mapping[str, Any]) -> Measured:
    extra = entry.get("extra_info", {})
    return Measured(float(entry["stats"]["median"]), extra.get("accuracy", {}), extra.get("status", ""))


def _machine(info: Mapping[str, Any], benchmarks: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    own = info.get("vibench", {})
    timers = sorted({entry["options"]["timer"] for entry in benchmarks if "options" in entry})
    machine = own.get("machine") or f"{info.get('cpu', {}).get('brand_raw', '')} {info.get('machine', '')}".strip()
    libraries = own.get("libraries") or f"python {info.get('python_version', '')}"
    return {"machine": machine, "libraries": libraries, "timer": ", ".join(timers), "code": own.get("code", "")}


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


def verdict(before: Measured, after: Measured, limit: float) -> str:
    """What got worse, "" if nothing did."""
    found = ["slower"] if after.seconds > limit * before.seconds else []
    found += ["less accurate"] if any(map(is_worse, figures(before, after))) else []
    found += [f"{before.status}, now {after.status or 'nothing'}"] if before.status == "ok" != after.status else []
    return ", ".join(found)


def table(before: Timed, after: Timed, limit: float) -> pd.DataFrame:
    """A row for every benchmark of both files; of its figures of accuracy, the one that got worse most."""
    rows = []
    for name, was in before.benchmarks.items():
        now = after.benchmarks.get(name)
        if now is not None:
            ratio = now.seconds / was.seconds if was.seconds > 0.0 else math.nan
            worst = next((f for f in figures(was, now) if is_worse(f)), (*figures(was, now), ("", None, None))[0])
            rows.append((name, 1e3 * was.seconds, 1e3 * now.seconds, ratio, *worst, verdict(was, now, limit)))
    columns = ["benchmark", "before [ms]", "after [ms]", "after / before", "accuracy", "before", "after", "worse"]
    return pd.DataFrame(rows, columns=columns)


def report(before: Timed, after: Timed, limit: float) -> tuple[str, int]:
    """All there is to be said, and how many benchmarks got worse."""
    compared = table(before, after, limit)
    worse = compared[compared["worse"] != ""]
    lines = [tables.to_markdown(compared)] if len(compared) else []
    for what, some, others in (("new", after, before), ("gone", before, after)):
        names = [name for name in some.benchmarks if name not in others.benchmarks]
        lines += [f"{what}: {', '.join(names)}"] if names else []
    for what, said in before.machine.items():
        if said != after.machine[what]:
            lines += [f"{what} before: {said}", f"{what} after:  {after.machine[what]}"]
    lines += [f"{name}: {why}" for name, why in zip(worse["benchmark"], worse["worse"], strict=True)]
    lines.append(f"{len(compared)} benchmarks in both files{_middle(compared)}; {len(worse)} worse (limit {limit:g})")
    return "\n".join(lines), len(worse)


def _middle(compared: pd.DataFrame) -> str:
    return f", median of the ratios {compared['after / before'].median():.3g}" if len(compared) else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, print; 1 if anything got worse."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--limit", type=float, default=LIMIT, help=f"largest ratio of medians, {LIMIT} by default")
    asked = parser.parse_args(arguments)
    if not asked.limit > 0.0:
        parser.error(f"the limit is {asked.limit:g}, expected a number above 0")
    try:
        before, after = read(asked.before), read(asked.after)
    except ValueError as error:
        print(f"compare.py: {error}", file=sys.stderr)
        return 2
    text, worse = report(before, after, asked.limit)
    print(text)
    return int(worse > 0)


if __name__ == "__main__":
    sys.exit(main())
