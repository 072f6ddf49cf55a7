"""Two runs side by side: what changed in dimensions, constants, errors, times and thresholds, and what got worse."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import pandas as pd

from vibench.qp.status import Status
from vibench.results import tables
from vibench.results.break_even import Meaning
from vibench.results.columns import KEYS, THRESHOLDS
from vibench.stability.infsup import VANISHES

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

    Worse is: a cell that is gone, fewer queries ok, a worse status, an error or a time larger than `limit` times what
    it was, a constant smaller by that factor, more vectors by that factor, a threshold later by that factor because
    the way it belongs to got slower. Times count only where both were measured on the same machine.

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
        fewer = two["queries_ok"] < one["queries_ok"]
        yield _row(one, "queries ok", one["queries_ok"], two["queries_ok"], Verdict.WORSE if fewer else Verdict.BETTER)
    if one["status"] != two["status"]:
        severities = Status(one["status"]).severity, Status(two["status"]).severity
        yield _row(one, "status", one["status"], two["status"], _judged(*severities, 1.0) or Verdict.CHANGED)
    for name in DIMENSIONS:
        if not _equal(one[name], two[name]):
            yield _row(one, name, one[name], two[name], _judged(one[name], two[name], limit) or Verdict.CHANGED)
    for names, floor, more in ((CONSTANTS, VANISHES, True), (ERRORS, ERROR_FLOOR, False)):
        for name in names:
            verdict = _judged(_floored(one[name], floor), _floored(two[name], floor), limit, more_is_better=more)
            yield from _changed(one, name, one[name], two[name], verdict)
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
        moved = Verdict.CHANGED if row["meaning_one"] != row["meaning_two"] else _judged(
            row["benefit_threshold_one"], row["benefit_threshold_two"], limit,
            more_is_better=row["meaning_one"] == Meaning.UNTIL,
        )  # fmt: skip
        own = [_judged(row[f"{phase}_b_s_one"], row[f"{phase}_b_s_two"], limit) for phase in ("offline", "online")]
        if moved and Verdict.WORSE not in own:  # what it is compared with became quicker, or nothing got worse
            moved = moved if moved is Verdict.BETTER else Verdict.CHANGED
        elif moved is Verdict.CHANGED and row["meaning_two"] == Meaning.NEVER:
            moved = Verdict.WORSE
        yield from _changed(named, what, before, after, moved)


def _said(meaning: str, number: float) -> str:
    return meaning if pd.isna(number) else f"{meaning} {number:.0f}"


def _floored(value: Any, floor: float) -> Any:
    return max(value, floor) if pd.notna(value) else value


def _judged(before: Any, after: Any, limit: float, *, more_is_better: bool = False) -> Verdict | None:
    """What becomes of a number of which less, or more, is better; `None` within the limit. To vanish is worse."""
    if pd.isna(before) or pd.isna(after):
        return None if pd.isna(before) and pd.isna(after) else Verdict.WORSE if pd.isna(after) else Verdict.CHANGED
    small, large = (before, after) if not more_is_better else (after, before)
    if large > limit * small:
        return Verdict.WORSE
    return Verdict.BETTER if small > limit * large else None


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
