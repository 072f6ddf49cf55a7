"""Files of benchmarks as tables, and two of them side by side: what is slower beyond its spread, and less accurate."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

from vibench.benchmarks.files import AXES, Measured, Timed

LIMIT = 1.25
"""Ratio of medians above which something is slower."""

SHORTEST = 10e-6
"""Seconds by which a median may grow whatever the ratio is: clocks and caches do not resolve less."""

FACTOR, NEGLIGIBLE = 10.0, 1e-9
"""A figure of accuracy is worse if it is more than this many times what it was; below this size none is."""

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
    changes = ["slower"] if is_slower(before, after, limit) else []
    changes += ["faster"] if not changes and is_slower(after, before, limit) else []
    changes += ["less accurate"] if any(map(is_worse, figures(before, after))) else []
    changes += [f"{before.status}, now {after.status or 'nothing'}"] if before.status == "ok" != after.status else []
    return ", ".join(changes)


def table_of(timed: Timed, earlier: Timed | None = None, limit: float = LIMIT) -> pd.DataFrame:
    """A row for every benchmark; with an earlier file, for every one of both, and what changed.

    A row has what is timed, with what, its seconds with their quartiles, and what it reached; a row of two files has
    both medians, and of the figures of accuracy the one that got worse most.
    """
    if earlier is None:
        return pd.DataFrame([_row(name, one) for name, one in timed.benchmarks.items()])
    both = (name for name in earlier.benchmarks if name in timed.benchmarks)
    return pd.DataFrame([_change(name, earlier.benchmarks[name], timed.benchmarks[name], limit) for name in both])


def _row(name: str, one: Measured) -> dict[str, Any]:
    return {
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


def _change(name: str, was: Measured, now: Measured, limit: float) -> dict[str, Any]:
    changed = figures(was, now)
    figure, before, after = next(filter(is_worse, changed), (*changed, ("", None, None))[0])
    return {
        "benchmark": name,
        "group": was.group,
        **{axis: was.axes.get(axis, "") for axis in AXES},
        "before_s": was.seconds,
        "after_s": now.seconds,
        "ratio": now.seconds / was.seconds if was.seconds > 0.0 else math.nan,
        "apart": "yes" if now.low > was.high or was.low > now.high else "no",
        "figure": figure,
        "before": before,
        "after": after,
        "verdict": verdict(was, now, limit),
    }


def remarks(before: Timed, after: Timed, limit: float) -> list[str]:
    """What is new or gone, machines and libraries that differ, and how many benchmarks got worse."""
    lines = []
    for what, some, others in (("new", after, before), ("gone", before, after)):
        names = [name for name in some.benchmarks if name not in others.benchmarks]
        lines += [f"{what}: {', '.join(names)}"] if names else []
    for what, said in before.machine.items():
        if said != after.machine.get(what, ""):
            lines += [f"{what} before: {said}", f"{what} after:  {after.machine.get(what, '')}"]
    frame = table_of(after, before, limit)
    ratios = frame["ratio"].dropna() if len(frame) else frame
    middle = f", median of the ratios {ratios.median():.3g}" if len(ratios) else ""
    return [*lines, f"{len(frame)} benchmarks in both files{middle}; {regressions(frame)} worse (limit {limit:g})"]


def regressions(frame: pd.DataFrame) -> int:
    """How many benchmarks of a table of two files got worse in any way."""
    return sum(row["verdict"] not in ("", "faster") for row in frame.to_dict("records"))
