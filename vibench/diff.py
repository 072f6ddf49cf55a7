"""Two runs side by side: what changed in dimensions, constants, errors, times and thresholds, and what got worse."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import pandas as pd

from vibench import tables
from vibench.schema import KEYS, THRESHOLDS
from vibench.thresholds import Meaning

ERROR_FLOOR = 1e-10
"""Errors below this are round-off: their ratio says nothing."""

DIMENSIONS = ("N", "R", "rank", "enrichment")
CONSTANTS = ("beta_span_min", "beta_cone_lower_min")
ERRORS = ("error_u_mean", "error_u_max", "error_lambda_mean", "error_lambda_max", "violation_max")
TIMES = ("offline_s", "online_s")

COLUMNS = ["problem", "dual", "primal", "asked", "solver", "assembly", "what", "before", "after", "ratio", "verdict"]


class Verdict(StrEnum):
    """What a change means."""

    WORSE = "worse"
    BETTER = "better"
    CHANGED = "changed"


@dataclass(frozen=True)
class Comparison:
    """The changes between two runs, one row each, and what could not be compared."""

    changes: pd.DataFrame
    notes: tuple[str, ...]

    @property
    def regressions(self) -> int:
        """How many changes are for the worse."""
        return int((self.changes["verdict"] == Verdict.WORSE).sum())


def compare(a: Path, b: Path, limit: float) -> Comparison:
    """Compare two results files cell by cell; cells of the same definition are the same cell.

    Worse is: a cell that is gone, fewer queries ok, an error, a time or a threshold larger than `limit` times what it
    was, a constant smaller by that factor, more vectors by that factor. Times count only where both were measured on
    the same machine.

    Parameters
    ----------
    a, b
        Results files, before and after.
    limit
        Factor above 1 that a number may change by.
    """
    one, two = (tables.in_order(tables.read(path, "cells")).set_index("cell", drop=False) for path in (a, b))
    shared = [key for key in one.index if key in two.index]
    rows = [_row(one.loc[key], "cell", "there", "gone", Verdict.WORSE) for key in one.index if key not in two.index]
    rows += [_row(two.loc[key], "cell", "", "new", Verdict.CHANGED) for key in two.index if key not in one.index]
    for key in shared:
        rows += list(_cell(one.loc[key], two.loc[key], limit))
    same_machine = all(one.loc[key, "machine"] == two.loc[key, "machine"] for key in shared)
    notes = [f"{len(shared)} cells are in both runs"]
    if not same_machine:
        notes.append("times and thresholds of different machines are not compared")
    else:
        rows += list(_thresholds(tables.read(a, "thresholds"), tables.read(b, "thresholds"), limit))
    return Comparison(pd.DataFrame(rows, columns=COLUMNS), tuple(notes))


def _cell(one: pd.Series, two: pd.Series, limit: float) -> Iterator[dict[str, Any]]:
    if one["queries_ok"] != two["queries_ok"]:
        verdict = Verdict.WORSE if two["queries_ok"] < one["queries_ok"] else Verdict.BETTER
        yield _row(one, "queries ok", one["queries_ok"], two["queries_ok"], verdict)
    if one["status"] != two["status"]:
        yield _row(one, "status", one["status"], two["status"], Verdict.CHANGED)
    for name in DIMENSIONS:
        if not _equal(one[name], two[name]):
            yield _row(one, name, one[name], two[name], _judged(one[name], two[name], limit) or Verdict.CHANGED)
    for name in CONSTANTS:
        yield from _changed(one, name, one[name], two[name], _judged(two[name], one[name], limit))
    for name in ERRORS:
        before, after = (max(value, ERROR_FLOOR) if pd.notna(value) else value for value in (one[name], two[name]))
        yield from _changed(one, name, one[name], two[name], _judged(before, after, limit))
    if one["machine"] == two["machine"]:
        for name in TIMES:
            yield from _changed(one, name, one[name], two[name], _judged(one[name], two[name], limit))


def _thresholds(one: pd.DataFrame, two: pd.DataFrame, limit: float) -> Iterator[dict[str, Any]]:
    keys = [name for name in THRESHOLDS if name in KEYS or name.rstrip("ab").endswith(("primal_", "tol_", "assembly_"))]
    merged = one.merge(two, on=keys, suffixes=("_one", "_two"))
    for _, row in merged.iterrows():
        what = f"pays against {row['primal_a']}"
        named = row.rename({"primal_b": "primal", "assembly_b": "assembly", "primal_tol_b": "primal_tol"})
        before, after = (_said(row[f"meaning_{k}"], row[f"benefit_threshold_{k}"]) for k in ("one", "two"))
        if row["meaning_one"] != row["meaning_two"]:
            worse = row["meaning_two"] == Meaning.NEVER or row["meaning_one"] == Meaning.AT_ONCE
            yield _row(named, what, before, after, Verdict.WORSE if worse else Verdict.CHANGED)
        elif row["meaning_one"] == Meaning.FROM:
            verdict = _judged(row["benefit_threshold_one"], row["benefit_threshold_two"], limit)
            if verdict:
                yield _row(named, what, before, after, verdict)


def _said(meaning: str, number: float) -> str:
    return meaning if pd.isna(number) else f"{meaning} {number:.0f}"


def _judged(before: Any, after: Any, limit: float) -> Verdict | None:
    """What becomes of a number of which less is better; `None` within the limit."""
    if pd.isna(before) or pd.isna(after):
        return None if pd.isna(before) and pd.isna(after) else Verdict.WORSE if pd.isna(after) else Verdict.CHANGED
    if after > limit * before:
        return Verdict.WORSE
    return Verdict.BETTER if before > limit * after else None


def _changed(cell: pd.Series, what: str, before: Any, after: Any, verdict: Verdict | None) -> Iterator[dict[str, Any]]:
    if verdict is not None:
        yield _row(cell, what, before, after, verdict)


def _equal(one: Any, two: Any) -> bool:
    return bool(pd.isna(one) and pd.isna(two)) or one == two


def _row(cell: pd.Series, what: str, before: Any, after: Any, verdict: Verdict) -> dict[str, Any]:
    sizes = [tables.asked(cell, axis) for axis in ("pod", "dual")]
    tolerance = "" if pd.isna(cell["primal_tol"]) else f", δ {cell['primal_tol']:g}"
    ratio = float("nan")
    if not isinstance(before, str) and not isinstance(after, str) and pd.notna(before) and pd.notna(after) and before:
        ratio = float(after) / float(before)
    names = {name: cell[name] for name in ("problem", "dual", "primal", "solver", "assembly")}
    changed = {"asked": ", ".join(sizes) + tolerance, "what": what, "ratio": ratio, "verdict": verdict.value}
    return names | changed | {"before": tables.cell_text(before), "after": tables.cell_text(after)}
