"""What `vibench diff` and `vibench compare` print on a terminal."""

from __future__ import annotations

import pandas as pd

from vibench.cli.console import echo, print_frame
from vibench.report.comparison.compare import Comparison
from vibench.report.comparison.differences import MOVED, ChangeKind
from vibench.results.formats import cell_text

MOST = 40
"""Changes that are printed; the other formats have all."""

REST = "--format csv"
"""Option that prints the columns for which a terminal is too narrow."""

PRIORITY = (
    "run", "what", "verdict", "before", "after", "ratio", "cells", "equal", "worse", "better", "changed", "problem",
    "formulation", "dual", "primal", "solver", "asked", "interval", "within accuracy", "within limit", "undecided",
    "farthest ratio", "against", "accuracy", "assembly", "correction", "cell", "study", "ok", "only here", "same code",
    "in all runs", "machine", "seed", "validation",
)  # fmt: skip
"""Columns of the tables, those that matter most first."""


def print_changes(compared: Comparison, limit: float) -> None:
    """Print what changed between runs, the worst first, and how many changes there are."""
    changes = readable(_by_weight(compared.changes))
    if len(changes):
        names = [run.name for run in compared.runs]
        title = " → ".join(names) if len(names) == 2 else f"changes from {names[0]}"
        print_frame(changes.head(MOST).drop(columns=_pair_columns(compared)), title, PRIORITY, rest=REST)
    if len(changes) > MOST:
        echo(f"{len(changes) - MOST} more changes: `{REST}` lists all of them")
    echo(*compared.notes, f"{len(changes)} changes beyond a factor of {limit:g}, {compared.regressions} for the worse")


def print_comparison(compared: Comparison, limit: float) -> None:
    """Print the runs, what moved by column, and the changes."""
    print_frame(compared.by_run, "runs", PRIORITY, every=True, rest=REST)
    echo("")
    names = [run.name for run in compared.runs]
    title = f"{names[1]} against {names[0]}" if len(names) == 2 else f"against {names[0]}"
    columns = readable(_with_counts(compared.by_column))
    print_frame(columns.drop(columns=_pair_columns(compared)), f"cells by column, {title}", PRIORITY, rest=REST)
    echo("")
    print_changes(compared, limit)


def print_table(compared: Comparison, frame: pd.DataFrame, title: str) -> None:
    """Print one table of a comparison; what it says of each run, in a column of its own, matters most."""
    print_frame(frame, title, [*(run.name for run in compared.runs), *PRIORITY], rest=REST)


def readable(frame: pd.DataFrame) -> pd.DataFrame:
    """A table with the two ends of an interval in one column, and without underscores in its headings."""
    ends = zip(frame["ratio_low"], frame["ratio_high"], strict=True)
    texts = ["" if pd.isna(low) else f"{cell_text(low)}–{cell_text(high)}" for low, high in ends]
    shown = frame.drop(columns=["ratio_low", "ratio_high"])
    shown.insert(shown.columns.get_loc("ratio") + 1, "interval", texts)
    return shown.rename(columns={"farthest_ratio": "farthest ratio"})


def _pair_columns(compared: Comparison) -> list[str]:
    """Columns that name the runs of a pair, where there is one pair, which the title names."""
    return ["run", "against"] if len(compared.runs) == 2 else []


def _with_counts(by_column: pd.DataFrame) -> pd.DataFrame:
    """A table without the columns of verdicts that no cell has."""
    return by_column.drop(columns=[verdict.value for verdict in ChangeKind if not by_column[verdict.value].any()])


def _by_weight(changes: pd.DataFrame) -> pd.DataFrame:
    """The worst changes first: by verdict, then by how far the ratio is from 1."""
    order = changes["verdict"].map([verdict.value for verdict in MOVED].index)
    far = changes["ratio"].map(_distance)
    weighed = changes.assign(order=order, far=-far).sort_values(["order", "far"], kind="stable")
    return weighed.drop(columns=["order", "far"])


def _distance(ratio: float) -> float:
    """How many times one of two numbers is the other, whichever is larger."""
    return max(ratio, 1.0 / ratio) if ratio > 0.0 else 1.0
