"""What `vibench bench` prints on a terminal."""

from __future__ import annotations

import pandas as pd

from vibench.benchmarks import comparison
from vibench.benchmarks.comparison import AXES, Timed
from vibench.results.tables import cell_text
from vibench.terminal.console import print_frame
from vibench.terminal.output import echo

REST = "--format csv"
"""Option that prints the columns for which a terminal is too narrow."""

PRIORITY = (
    "verdict", "problem", "dual", "primal", "size", "solver", "accuracy", "median [ms]", "before [ms]", "after [ms]",
    "ratio", "quartiles [ms]", "reached", "status", "rounds", "apart",
)  # fmt: skip
"""Columns, those that matter most first."""


def print_benchmarks(found: Timed, earlier: Timed | None, limit: float, failed: int = 0) -> None:
    """Print a table for everything that was timed, beside an earlier file if there is one, and how many failed."""
    frame = comparison.table(found) if earlier is None else comparison.compared(earlier, found, limit)
    if len(frame):
        for group, rows in frame.groupby("group", sort=False):
            shown = _measured(rows) if earlier is None else _compared(rows)
            named = [axis for axis in AXES if (rows[axis] != "").any()]
            print_frame(pd.concat([rows[named], shown], axis=1), str(group), PRIORITY, rest=REST)
            echo("")
    if earlier is None:
        counts = f"{len(frame)} benchmarks" + (f", {failed} failed" if failed else "")
        echo(f"{counts}; times are CPU times of a call on one thread")
    else:
        echo(*comparison.remarks(earlier, found, limit))


def _measured(rows: pd.DataFrame) -> pd.DataFrame:
    quartiles = zip(1e3 * rows["q1_s"], 1e3 * rows["q3_s"], strict=True)
    reached = [name for name in rows.columns if name.startswith("reached_")]
    return pd.DataFrame(
        {
            "median [ms]": 1e3 * rows["median_s"],
            "quartiles [ms]": [f"{cell_text(low)}–{cell_text(high)}" for low, high in quartiles],
            "rounds": rows["rounds"],
            "reached": [_largest(row) for row in rows[reached].to_dict("records")],
            "status": rows["status"],
        },
        index=rows.index,
    )


def _largest(reached: dict[str, float | None]) -> str:
    """The largest figure of accuracy of a benchmark; those of its table are of the same kind."""
    known = {name.removeprefix("reached_"): value for name, value in reached.items() if pd.notna(value)}
    name = max(known, key=lambda name: known[name] or 0.0, default="")
    return f"{name} {cell_text(known[name])}" if name else ""


def _compared(rows: pd.DataFrame) -> pd.DataFrame:
    changes = rows[["figure", "before", "after"]].itertuples(index=False, name=None)
    return pd.DataFrame(
        {
            "before [ms]": 1e3 * rows["before_s"],
            "after [ms]": 1e3 * rows["after_s"],
            "ratio": rows["ratio"],
            "apart": rows["apart"],
            "reached": [f"{name} {cell_text(was)} → {cell_text(now)}" if name else "" for name, was, now in changes],
            "verdict": rows["verdict"],
        },
        index=rows.index,
    )
