"""Comparison of two runs: changes of dimensions, constants, errors, times and break-even, and regressions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import pandas as pd

from vibench.qp.status import Status
from vibench.results import tables
from vibench.results.break_even import BreakEven, Meaning
from vibench.results.columns import THRESHOLDS
from vibench.stability.infsup import VANISHES

ERROR_FLOOR = 1e-10
"""Errors below this are round-off, and their ratio is meaningless."""

CONSTANTS = ("beta_span_min", "beta_cone_lower_min")
ERRORS = {
    **{f"error_{name}_{how}": (f"error_{name}", how) for name in ("u", "lambda") for how in ("mean", "max")},
    "violation_max": ("violation", "max"),
}
"""Columns of a cell that are means or maxima over its ok queries: of which column, and which of the two."""

ZERO_ERRORS = ("error_u_zero_max", "error_lambda_zero_max")

NUMBERS = ("benefit_threshold", "threshold_low", "threshold_high")

COLUMNS = [
    "problem", "dual", "primal", "asked", "solver", "accuracy", "assembly", "what", "before", "after", "ratio",
    "verdict",
]  # fmt: skip


class Verdict(StrEnum):
    """Whether a change is for the worse."""

    WORSE = "worse"
    BETTER = "better"
    CHANGED = "changed"


Change = tuple[pd.Series, str, Any, Any, Verdict | None]
"""Cell, column, values before and after, and the verdict; `None` without a change beyond the limit."""


@dataclass(frozen=True)
class Comparison:
    """The changes between two runs, one per row, and remarks on the extent of the comparison."""

    changes: pd.DataFrame
    notes: tuple[str, ...]

    @property
    def regressions(self) -> int:
        """Number of changes for the worse."""
        return int((self.changes["verdict"] == Verdict.WORSE).sum())


def compare(a: Path, b: Path, limit: float) -> Comparison:
    """Compare two results files cell by cell; cells of the same definition are the same cell.

    Changes for the worse are: a missing cell, fewer ok queries, a more severe status, an error, a time or a dimension
    that grew by more than the factor `limit`, a constant that shrank by more than this factor, and a break-even that
    moved by more than this factor because the reduced model itself became slower. Times are compared only where both
    were measured on the same machine.

    Parameters
    ----------
    a, b
        Results files, before and after.
    limit
        Factor, at least 1, within which a number may change.
    """
    one, two = (tables.in_order(tables.read(path, "cells")).set_index("cell", drop=False) for path in (a, b))
    shared = [key for key in one.index if key in two.index]
    moved = _on_common_queries(one, two, *(_ok_queries(path) for path in (a, b)))
    changes: list[Change] = [
        *((one.loc[key], "cell", "present", "gone", Verdict.WORSE) for key in one.index if key not in two.index),
        *((two.loc[key], "cell", "", "new", Verdict.CHANGED) for key in two.index if key not in one.index),
        *(change for key in shared for change in _cell(one.loc[key], two.loc[key], limit)),
    ]
    notes = [f"{len(shared)} cells are in both runs"]
    notes += [f"errors of {moved} of them are compared on the queries that are ok in both"] if moved else []
    if all(one.loc[key, "machine"] == two.loc[key, "machine"] for key in shared):
        changes += _thresholds(tables.read(a, "thresholds"), tables.read(b, "thresholds"), limit)
    else:
        notes.append("times and break-even of different machines are not compared")
    rows = [_row(cell, what, old, new, verdict) for cell, what, old, new, verdict in changes if verdict is not None]
    return Comparison(pd.DataFrame(rows, columns=COLUMNS), tuple(notes))


def _ok_queries(path: Path) -> pd.DataFrame:
    queries = tables.read(path, "queries")
    return queries[queries["status"] == Status.OK].set_index(["cell", "query"])


def _on_common_queries(one: pd.DataFrame, two: pd.DataFrame, ok_one: pd.DataFrame, ok_two: pd.DataFrame) -> int:
    """Put means and maxima over the queries that are ok in both runs into cells where those differ; their number."""
    different = set(ok_one.index.symmetric_difference(ok_two.index).get_level_values("cell"))
    keys = [key for key in one.index if key in two.index and key in different]
    for cells, ok in ((one, ok_one), (two, ok_two)):
        common = ok[ok.index.isin(ok_one.index.intersection(ok_two.index))].groupby("cell")
        for column, (name, how) in ERRORS.items():
            cells.loc[keys, column] = common[name].agg(how).reindex(keys)
    return len(keys)


def _cell(one: pd.Series, two: pd.Series, limit: float) -> Iterator[Change]:
    before, after = one["queries_ok"], two["queries_ok"]
    yield one, "queries ok", before, after, _verdict(before, after, 1.0, more_is_better=True)
    before, after = Status(one["status"]), Status(two["status"])
    yield one, "status", before, after, _verdict(before.severity, after.severity, 1.0)
    for name in ("N", "R", "rank", "enrichment"):
        before, after = one[name], two[name]
        moved = Verdict.CHANGED if before != after and pd.notna(before) else None
        yield one, name, before, after, _verdict(before, after, limit) or moved
    times = ("offline_s", "online_s") if one["machine"] == two["machine"] else ()
    errors = (*ERRORS, *ZERO_ERRORS)
    for names, floor, more in ((CONSTANTS, VANISHES, True), (errors, ERROR_FLOOR, False), (times, 0.0, False)):
        for name in names:
            # Missing values stay NaN: `max` returns its first argument unless the second is larger.
            verdict = _verdict(max(one[name], floor), max(two[name], floor), limit, more_is_better=more)
            yield one, name, one[name], two[name], verdict


def _thresholds(one: pd.DataFrame, two: pd.DataFrame, limit: float) -> Iterator[Change]:
    keys = [name for name in THRESHOLDS if not name.endswith(("_s", *NUMBERS, "meaning"))]
    for _, row in one.merge(two, on=keys, suffixes=("_one", "_two")).iterrows():
        before, after = (_break_even(row, k) for k in ("one", "two"))
        if before.overlaps(after):
            continue
        verdict: Verdict | None = Verdict.CHANGED
        if before.meaning == after.meaning:
            verdict = _verdict(before.number, after.number, limit, more_is_better=before.meaning == Meaning.UNTIL)
        own = [_verdict(row[f"{phase}_b_s_one"], row[f"{phase}_b_s_two"], limit) for phase in ("offline", "online")]
        if Verdict.WORSE not in own and verdict is Verdict.WORSE:  # because the model it is compared with became faster
            verdict = Verdict.CHANGED
        elif Verdict.WORSE in own and verdict is Verdict.CHANGED and after.meaning == Meaning.NEVER:
            verdict = Verdict.WORSE
        cell = row.rename({f"{name}_b": name for name in ("primal", "assembly", "primal_tol")})
        yield cell, f"break-even against {row['primal_a']}", str(before), str(after), verdict


def _break_even(row: pd.Series, run: str) -> BreakEven:
    number, low, high = (None if pd.isna(n := row[f"{name}_{run}"]) else float(n) for name in NUMBERS)
    return BreakEven(number, Meaning(row[f"meaning_{run}"]), low, high)


def _verdict(before: Any, after: Any, limit: float, *, more_is_better: bool = False) -> Verdict | None:
    """Verdict on a number that should be small, or large; a value that is gone is worse."""
    if pd.isna(before) or pd.isna(after):
        return None if pd.isna(before) and pd.isna(after) else Verdict.WORSE if pd.isna(after) else Verdict.CHANGED
    small, large = (before, after) if not more_is_better else (after, before)
    if large > limit * small:
        return Verdict.WORSE
    return Verdict.BETTER if small > limit * large else None


def _row(cell: pd.Series, what: str, before: Any, after: Any, verdict: Verdict) -> dict[str, Any]:
    tolerance = "" if pd.isna(cell["primal_tol"]) else f", δ {cell['primal_tol']:g}"
    ratio = float("nan")
    if not isinstance(before, str) and not isinstance(after, str) and pd.notna(before) and pd.notna(after) and before:
        ratio = float(after) / float(before)
    names = {name: cell[name] for name in ("problem", "dual", "primal", "solver", "accuracy", "assembly")}
    asked = f"{tables.asked(cell, 'pod')}, {tables.asked(cell, 'dual')}{tolerance}"
    shown = {"before": tables.cell_text(before), "after": tables.cell_text(after)}
    return names | shown | {"asked": asked, "what": what, "ratio": ratio, "verdict": verdict.value}
