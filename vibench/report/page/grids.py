"""Tables as compact JSON, column by column: the script of the report shows, filters and sorts them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from vibench.results import formats, show
from vibench.results.read import in_order
from vibench.results.schema import BREAK_EVEN, CELLS, STORED, Column
from vibench.results.selection import short_keys
from vibench.text import printable

DIGITS = 6
"""Significant digits of embedded numbers; the results file has all of them."""

FIRST = 50
"""Rows of a table that a page has without its script."""

FEW = 60
"""Texts of a column up to which it can be filtered by a list of them."""

OF_CELLS = (
    "cell", *show.AXES, "status", "queries_ok", "error_lambda_mean", "error_u_mean", "online_s", "offline_s",
    "beta_span_min", "beta_cone_lower_min", "N", "R", "enrichment", "queries_zero_u", "error_u_zero_max",
    "queries_zero_lambda", "error_lambda_zero_max",
)  # fmt: skip
"""Columns of the table of cells, those that matter most first."""

MORE_OF_CELLS = (
    "hf_s", "online_q1_s", "online_q3_s", "share_validation", "violation_max", "solver_share_mean", "residual_max",
    "peak_memory_mib", "slowdown", "reason", "fallbacks", "machine",
)  # fmt: skip
"""Columns that are offered besides, and not shown at first."""


@dataclass(frozen=True)
class TableGrid:
    """A table of the report."""

    name: str
    """Its identifier in the page."""
    title: str
    caption: str
    """What stands below the heading."""
    frame: pd.DataFrame
    """Its rows as they are shown, under their headings; the first column names a row."""
    axes: tuple[str, ...] = ()
    """Headings that rows can be filtered by."""
    hidden: tuple[str, ...] = ()
    """Headings that are not shown at first."""
    disturbed: tuple[int, ...] = ()
    """Numbers of the rows whose seconds were measured on a disturbed machine."""

    def meaning(self, heading: str) -> str:
        """What stands under a heading, and its unit; "" where nobody says."""
        for name, column in RECORDED:
            if heading in (name, column.heading):
                return printable(f"{column.meaning} [{column.unit}]" if column.unit else column.meaning)
        return ""

    @property
    def first(self) -> tuple[list[str], list[list[str]]]:
        """The headings that are shown at first, and the texts of the first rows under them."""
        shown = [str(name) for name in self.frame.columns if name not in self.hidden]
        rows = self.frame[shown].head(FIRST).itertuples(index=False)
        return shown, [[formats.cell_text(value) for value in row] for row in rows]


RECORDED = [pair for table in (CELLS, BREAK_EVEN, *STORED.values()) for pair in table.items()]
"""Columns of all tables, those of cells first."""


def grid_of_cells(cells: pd.DataFrame, caption: str) -> TableGrid:
    """The table of all cells, in the order of the rows."""
    names = [n for n in (*OF_CELLS, *MORE_OF_CELLS) if n in ("cell", *show.AXES) or cells[n].notna().any()]
    says_nothing = [name for name in names if CELLS[name].heading and not formats.says_something(cells, name)]
    length = short_keys(cells["cell"])
    frame = formats.under_headings(cells.assign(cell=cells["cell"].str[:length]), names, CELLS)
    hidden = [_heading(CELLS, name) for name in (*says_nothing, *MORE_OF_CELLS) if name in names]
    axes = tuple(_heading(CELLS, name) for name in (*show.AXES, "status"))
    disturbed, left_out = _disturbed(cells["cell"], cells), (*hidden, *_constant(frame))
    return TableGrid("summary", "All cells", caption, frame, axes, left_out, disturbed)


def grid_of_thresholds(name: str, title: str, caption: str, rows: pd.DataFrame, cells: pd.DataFrame) -> TableGrid:
    """A table of break-even points; a row is disturbed if one of its cells is."""
    ordered = in_order(rows)
    frame = formats.break_even_table(rows)
    first = _heading(BREAK_EVEN, "primal_b")
    frame = frame[[first, *frame.columns.drop(first)]]
    results = {_heading(BREAK_EVEN, name) for name in ("benefit_threshold", "threshold_high")}
    texts = [heading for heading in frame.columns if not pd.api.types.is_numeric_dtype(frame[heading])]
    axes = tuple(heading for heading in texts if heading not in results)
    disturbed = {*_disturbed(ordered["cell_a"], cells), *_disturbed(ordered["cell_b"], cells)}
    # Where all answers are undecided that is said: an interval alone would read like a result.
    hidden = tuple(heading for heading in _constant(frame) if heading not in results)
    return TableGrid(name, title, caption, frame, axes, hidden, tuple(sorted(disturbed)))


def grid_of(name: str, title: str, caption: str, frame: pd.DataFrame, axes: Sequence[str], keys: int) -> TableGrid:
    """Any other table, without columns that are empty, and with so many characters of the keys of cells."""
    shown = frame.dropna(axis=1, how="all")
    shown = shown.assign(cell=shown["cell"].str[:keys]) if "cell" in shown else shown
    return TableGrid(name, title, caption, shown, tuple(one for one in axes if one in shown), tuple(_constant(shown)))


def _heading(table: dict[str, Column] | Any, name: str) -> str:
    return table[name].heading or name


def _constant(frame: pd.DataFrame) -> list[str]:
    """Columns with one value in all rows, but for the first one."""
    return [str(name) for name in frame.columns[1:] if len(frame) > 1 and frame[name].nunique(dropna=False) == 1]


def _disturbed(keys: pd.Series, cells: pd.DataFrame) -> tuple[int, ...]:
    disturbed = set(cells["cell"][cells["disturbed"] == 1])
    return tuple(k for k, key in enumerate(keys) if key in disturbed)


def to_json(grids: Sequence[TableGrid]) -> str:
    """The tables as JSON that may stand in a script element: nothing in it ends the element."""
    return script_safe({grid.name: _columnar(grid) for grid in grids})


def script_safe(value: Any) -> str:
    """JSON without a "<"."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _columnar(grid: TableGrid) -> dict[str, Any]:
    return {
        "rows": len(grid.frame),
        "columns": [
            {"meaning": grid.meaning(str(name))} | _column(str(name), grid.frame[name]) for name in grid.frame.columns
        ],
        "axes": [name for name in grid.axes if 1 < grid.frame[name].nunique() <= FEW],
        "hidden": sorted(set(grid.hidden)),
        "disturbed": list(grid.disturbed),
    }


def _column(name: str, values: pd.Series) -> dict[str, Any]:
    """A column of numbers, of texts, or of numbers of texts where most of them occur often.

    A value that all rows have stands there once.
    """
    heading = printable(name)
    if pd.api.types.is_numeric_dtype(values) or _numbers_in_text(values):
        numbers = [short(value) for value in values]
        return {"name": heading, "numbers": numbers if len(set(numbers)) > 1 else numbers[:1]}
    texts = [printable(formats.cell_text(value)) for value in values]
    levels = list(dict.fromkeys(texts))
    if 2 * len(levels) > len(texts):
        return {"name": heading, "texts": texts}
    if len(levels) == 1:
        return {"name": heading, "levels": levels}
    number = {text: k for k, text in enumerate(levels)}
    return {"name": heading, "levels": levels, "codes": [number[text] for text in texts]}


def _numbers_in_text(values: pd.Series) -> bool:
    """Whether a column of texts has numbers alone: tolerances are texts since a dimension may take their place."""
    if not len(values) or not all(isinstance(value, str) for value in values):
        return False
    return bool(pd.to_numeric(values.drop_duplicates(), errors="coerce").notna().all()) and values.name != "cell"


def short(value: Any, digits: int = DIGITS) -> float | int | str | None:
    """A number with few digits; an infinite one is a text, since JSON has none."""
    if pd.isna(value):
        return None
    number = float(value)
    if math.isinf(number):
        return str(number)
    rounded = float(f"{number:.{digits}g}")
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e15 else rounded
