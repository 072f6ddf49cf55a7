"""The tables that `vibench show` prints: where their rows come from, and which columns matter most."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import pandas as pd

from vibench.errors import RequestError, unknown_name
from vibench.files import write_atomically
from vibench.results import formats, ranking, selection
from vibench.results.formats import cell_text, csv_lines, summary, to_markdown
from vibench.results.paired_timing import PairedTiming
from vibench.results.read import cells_with_errors, checked, in_order, read_table, terms_in_order, whole_numbers
from vibench.results.schema import STORED, TABLES, Column
from vibench.results.sqlite import parameters_of, read_parts
from vibench.text import json_object

# Columns that distinguish rows; where all rows have one value, it stands in the title and takes no room.
AXES = (
    "problem", "training", "formulation", "dual", "primal", "primal_tol", "solver", "pod_tol", "dual_tol", "accuracy",
    "assembly", "bounds", "correction",
)  # fmt: skip


@dataclass(frozen=True)
class View:
    """A table for reading, made of the table `source` of the results file."""

    source: str
    columns: tuple[str, ...]  # those that matter most first: on a narrow terminal the last ones are left out
    headings: Mapping[str, Column] | None = None  # columns with headings of their own; `None` where these are the names
    rows: Callable[[pd.DataFrame], pd.DataFrame] = in_order  # its rows, in their order, from those of the source
    empty: str = ""  # reason why it may have no rows where the source has some


def _views() -> dict[str, View]:
    of_cells = (
        *AXES, "cell", "error_lambda_mean", "online_s", "error_u_mean", "offline_s", "beta_cone_lower_min",
        "queries_ok", "N", "R", "status", "beta_span_min", "enrichment",
    )  # fmt: skip
    of_break_even = (
        "problem", "formulation_b", "dual", "primal_b", "primal_tol_b", "primal_a", "benefit_threshold", "gain",
        "threshold_high", "online_b_s", "formulation_a", "solver", "assembly_b", "bounds_b", "assembly_a", "bounds_a",
        "correction", "rounds_missing", "pod_tol", "dual_tol", "accuracy", "online_a_s", "offline_b_s", "offline_a_s",
    )  # fmt: skip
    of_queries = (
        *AXES, "cell", "query", "status", "error_u", "error_lambda", "total_s", "mu_1", "mu_2", "mu_3",
        "beta_cone_lower", "beta_span", "primal_residual", "dual_residual", "gap", "iterations", "reason",
    )  # fmt: skip
    of_outputs = (
        *AXES, "output", "unit", "error_mean", "error_max", "error_scaled_mean", "scale", "queries_ok", "queries_zero",
        "cell",
    )  # fmt: skip
    of_calibrations = (
        "problem", "formulation", "noise", "asked", "wrong", "questions", "calibration_s", "hf_chain_s", "claim",
        "decisions", "pod_tol", "dual_tol", "dual", "primal", "primal_tol", "cell", "steps", "audits", "reason",
    )  # fmt: skip
    compared = ("difference_max", "flagged", "queries", "allowed_worst", "query_flagged")
    of_timings = (*AXES, "cell", "round", "total_s", "assemble_s", "solve_s", "queries", "slowdown")
    cells, thresholds = STORED["cells"], STORED["thresholds"]
    of_best = ("problem", "error_below", *of_cells[:14], "ties", *of_cells[14:])
    return {
        "summary": View("cells", (*of_cells, *(n for n in cells if cells[n].heading)), cells),
        "best": View("cells", of_best, ranking.fastest_columns(), ranking.fastest, ranking.no_best_cell()),
        "benefits": View("thresholds", (*of_break_even, *(n for n in thresholds if thresholds[n].heading)), thresholds),
        "cells": View("cells", (*of_cells, "reason")),
        "queries": View("queries", of_queries),
        "histories": View("histories", ("stage", "quantity", "step", "value", *AXES)),
        "timings": View("timings", of_timings),
        "thresholds": View("thresholds", of_break_even),
        "outputs": View("outputs", of_outputs),
        "calibrations": View("calibrations", of_calibrations),
        "disagreements": View("disagreements", ("solver_a", "solver_b", *AXES, *compared)),
    }


# Tables that `vibench show` prints, by name: three for reading, and those of the results file.
VIEWS: Mapping[str, View] = _views()


@dataclass(frozen=True)
class Table:
    """Selected rows and columns of a table."""

    rows: pd.DataFrame  # with the columns of the results file
    columns: tuple[str, ...]  # to be shown
    view: View  # of the whole table
    chosen: bool  # whether the user chose the columns
    key_length: int  # number of characters that distinguish the keys of the cells of the run
    # Options that distinguish plugins of one name, by the column of the name and the name.
    varying: Mapping[tuple[str, str], tuple[str, ...]]
    parameters: Mapping[str, str] = field(default_factory=dict)  # names of parameters by their columns, mu_1, mu_2, …

    @property
    def exact(self) -> pd.DataFrame:
        """Every recorded value under the name of its column, for programs."""
        if not self.view.headings and not self.chosen:
            return whole_numbers(self.rows)
        # Columns that a table for reading shows in the place of another one.
        together = {} if self.chosen else {
            "pod_tol": ("pod_size",), "dual_tol": ("dual_size",), "queries_ok": ("queries",),
            "benefit_threshold": ("meaning",), "threshold_high": ("threshold_low",), "total_high_s": ("total_low_s",),
            "gain": ("gain_low", "gain_high"),
        }  # fmt: skip
        return whole_numbers(self.rows[[part for name in self._placed for part in (name, *together.get(name, ()))]])

    @property
    def readable(self) -> pd.DataFrame:
        """Values for people, under headings: with shortened keys of cells, and options beside names of plugins."""
        told = {axis for axis, _ in self.varying}
        names = [n for n in self._placed if self.chosen or n in told or formats.says_something(self.rows, n)]
        rows = self.rows.assign(cell=self.rows["cell"].str[: self.key_length]) if "cell" in self.rows else self.rows
        for axis in told:
            pairs = zip(rows[axis], rows[f"{axis}_options"], strict=True)
            texts = []
            for name, text in pairs:
                # An option at its default is not recorded.
                given, keys = _options(text), self.varying.get((axis, name), ())
                texts.append(" ".join([name, *(f"{key} {given[key]}" for key in keys if key in given)]))
            rows = rows.assign(**{axis: texts})
        frame = formats.under_headings(rows, names, self.view.headings or {})
        # An empty place would not say whether the seconds are small, or were lost.
        seconds = [name for name in frame if name.endswith(("[s]", "[ms]")) and frame[name].isna().any()]
        frame = frame.assign(**{name: frame[name].astype(object).fillna("not timed") for name in seconds})
        return frame.rename(columns=dict(self.parameters))

    @property
    def described(self) -> tuple[pd.DataFrame, list[str]]:
        """The columns of the first row with their values, units and meanings, and the names of those that are empty."""
        row, columns = self.rows.iloc[0], {**STORED[self.view.source], **(self.view.headings or {})}
        described = {name: columns[name] for name in row.index if name in columns}
        texts = {name: cell_text(row[name]) for name in described}
        filled = [(name, text, described[name].unit, described[name].meaning) for name, text in texts.items() if text]
        frame = pd.DataFrame(filled, columns=["column", "value", "unit", "meaning"])
        return frame, [name for name, text in texts.items() if not text]

    @property
    def _placed(self) -> list[str]:
        headings = self.view.headings
        if self.chosen:
            return list(self.columns)
        order = list(headings or self.rows.columns)
        return sorted(self.columns, key=lambda n: (headings[n].place or 0 if headings else 0, order.index(n)))

    @property
    def priority(self) -> list[str]:
        """Headings, those that matter most first."""
        return [self._heading(name) for name in self.columns]

    @property
    def axes(self) -> set[str]:
        """Headings of the columns that distinguish rows."""
        return {self._heading(name) for name in (*AXES, "primal_tol_b")}

    def _heading(self, name: str) -> str:
        column = (self.view.headings or {}).get(name)
        return column.heading or name if column is not None else self.parameters.get(name, name)


def look_up(
    path: Path, name: str, *, cell: str = "", columns: Sequence[str] = (), where: str = "", sort: Sequence[str] = (),
    limit: int | None = None, error: str = "", largest: float | None = None, queries: float | None = None,
) -> Table:  # fmt: skip
    """A table of a results file: the rows that satisfy a condition, sorted, the first `limit` of them.

    With an error measure (`ranking`) models are compared by it: `best` has its bands, tables of break-even have the
    errors of both models, of which neither is above `largest`. With a number of `queries`, `best` has the model that is
    the cheapest for so many, at every error or within `largest`. Rows belong to `cell`, the beginning of a key.

    Raises a `RequestError` if there is no such table, cell, column, measure or condition, or the table depends on none.
    """
    if name not in VIEWS:
        raise unknown_name("table", name, VIEWS)
    needed = _cells_needed(path, VIEWS[name], cell, where, sort, limit) if not error and largest is None else ()
    view, frame = _measured(path, name, error, largest, needed, queries)
    everything = read_table(path, "cells") if needed else frame
    keys = everything.get("cell", [])
    if where:
        added = {name: ranking.error_columns()[name] for name in ranking.error_columns() if name in frame}
        made = set(view.headings or {}) - set(frame.columns)
        frame = frame[selection.matching(path, view.source, where, frame, added, made, needed)]
        # The condition, not the reason of the view, is why there are no rows.
        if frame.empty:
            view = replace(view, empty="")
    if cell:
        if "cell" not in frame:
            of_cells = [name for name, each in VIEWS.items() if "cell" in STORED[each.source]]
            raise RequestError(f"the table {name} has no rows of one cell; expected {', '.join(of_cells)}")
        frame = frame[frame["cell"] == _key_of(path, cell)]
    rows = view.rows(frame if largest is None or name == "best" else ranking.within(frame, largest))
    named = _parameters(path, rows)
    by_heading = {column.heading: key for key, column in (view.headings or {}).items() if column.heading}
    # Parameters also by their headings and names, where no column is called so.
    texts = [(text, key) for key, heading in named.items() for text in (heading, heading.partition(" [")[0])]
    by_heading |= {text: key for text, key in texts if text not in rows}
    if sort:
        resolved = [f"{'-' * key.startswith('-')}{by_heading.get(k, k)}" for key in sort for k in [key.lstrip("-")]]
        rows = selection.sorted_by(rows, resolved, name)
    asked = [by_heading.get(column, column) for column in columns]
    if asked == ["all"]:
        asked = list(rows.columns)
    for column in asked:
        if column not in rows:
            raise unknown_name(f"column of {name}", column, [*rows, *by_heading])
    default = [column for column in dict.fromkeys(view.columns) if column in rows]
    shown = rows.head(limit) if limit else rows
    listed, length = tuple(dict.fromkeys(asked or default)), selection.short_keys(keys)
    return Table(shown, listed, view, bool(asked), length, _varying_options(everything), named)


def _parameters(path: Path, rows: pd.DataFrame) -> dict[str, str]:
    """Headings, "radius [m]", of the columns mu_1, mu_2, … of rows; those of several problems side by side."""
    columns = [name for name in rows.columns if re.fullmatch("mu_[1-9][0-9]*", name)]
    if not columns:
        return {}
    of, headings = parameters_of(path), dict[str, list[str]]()
    for problem in rows["problem"].unique():
        for k, (name, unit) in enumerate(of.get(problem, ()), 1):
            headings.setdefault(f"mu_{k}", []).append(f"{name} [{unit}]" if unit != "1" else name)
    joined = {name: " / ".join(dict.fromkeys(headings[name])) for name in columns if name in headings}
    taken = [*rows.columns, *joined.values()]
    return {name: heading for name, heading in joined.items() if taken.count(heading) == 1}


def _cells_needed(path: Path, view: View, cell: str, where: str, sort: Sequence[str], limit: int | None) -> list[str]:
    """Cells of all rows of a large table that are asked for, where they are few; none where all rows are read."""
    named = [key.removeprefix("-") for key in sort]
    # These have many rows of each cell, and their cells are distinguished by columns of the table of cells.
    if view.source not in ("queries", "timings", "outputs"):
        return []
    if cell:
        return [_key_of(path, cell)]
    if not limit or not set(STORED[view.source]).issuperset(named):  # a parameter, or no column at all
        return []
    falls = ("DESC" if key.startswith("-") else "ASC" for key in sort)
    first = [f'"{name}" IS NULL, "{name}" {way}' for name, way in zip(named, falls, strict=True)]
    order = [*first, *terms_in_order(STORED[view.source])]
    cells = selection.cells_of_first(path, view.source, where, order, limit)
    # Reading rows by their cells pays only for few of them.
    return cells if len(cells) <= 100 else []


def _key_of(path: Path, cell: str) -> str:
    return selection.key_of(cell, map(str, read_table(path, "cells")["cell"]), str(path.parent))


def _varying_options(frame: pd.DataFrame) -> dict[tuple[str, str], tuple[str, ...]]:
    """Options that differ between plugins of one name, by the column of the name and the name."""
    varying = {}
    for axis in ("problem", "training", "dual", "primal"):
        if f"{axis}_options" not in frame:
            continue
        for name, texts in frame.groupby(axis)[f"{axis}_options"]:
            given = [_options(text) for text in texts.unique()]
            keys = dict.fromkeys(key for options in given for key in options)
            differing = tuple(key for key in keys if len({options.get(key) for options in given}) > 1)
            if differing:
                varying[axis, str(name)] = differing
    return varying


def _options(text: str | None) -> dict[str, str]:
    """Recorded options with their values as texts; a text that is no JSON object is one option."""
    if not isinstance(text, str):
        return {}
    options = json_object(text)
    if options is None:
        return {"options": text}
    return {key: one if isinstance(one, str) else json.dumps(one, ensure_ascii=False) for key, one in options.items()}


def _measured(
    path: Path, name: str, error: str, largest: float | None, cells: Sequence[str], queries: float | None
) -> tuple[View, pd.DataFrame]:
    """A table for reading and its rows, or those of some cells, with errors by the measure that is asked for."""
    view, frame = VIEWS[name], read_table(path, VIEWS[name].source, cells)
    if queries is not None and name != "best":
        raise RequestError(f"--queries is for the table best, not for {name}")
    if name == "best":
        return _best(path, view, error, largest, queries), frame
    if not error and largest is None:
        return view, frame
    if view.source != "thresholds":
        comparing = ["best", *(other for other, each in VIEWS.items() if each.source == "thresholds")]
        raise RequestError(f"the table {name} compares no models by an error; expected {', '.join(comparing)}")
    recorded, errors = cells_with_errors(path, error or "solution")
    first = ("problem", "dual", "primal_a", "primal_b", "benefit_threshold", "error_b", "error_a")
    columns = tuple(dict.fromkeys((*first, *view.columns, *ranking.error_columns())))
    headings = None if view.headings is None else {**view.headings, **ranking.error_columns()}
    return replace(view, columns=columns, headings=headings), ranking.with_errors(frame, recorded, errors)


def _best(path: Path, view: View, error: str, largest: float | None, queries: float | None) -> View:
    if queries is None and largest is not None:
        raise RequestError("--within is for tables of break-even points, and for the table best with --queries")
    errors = cells_with_errors(path, error)[1] if error else None
    paired = PairedTiming(read_table(path, "timings").to_dict("records"))
    if queries is None:
        return replace(view, rows=partial(ranking.fastest, errors=errors, paired=paired))
    certified = ranking.certified_errors(read_table(path, "queries"))
    asked = {"queries": queries, "errors": errors, "within": largest, "certified": certified}
    rows = partial(ranking.cheapest, paired=paired, **asked)
    columns = (
        "problem", "error_below", "formulation", "primal", "primal_tol", "dual", "total_s", "probability",
        "cheapest_from", "ties", "cell", "error_lambda_mean", "certified_error", "error_u_mean", "assembly", "bounds",
        "total_high_s", "cheapest_until", "solver", "N", "R", "correction", "offline_s", "online_s", "training",
        "accuracy",
    )  # fmt: skip
    return replace(view, rows=rows, columns=columns, headings=ranking.cheapest_columns())


def exported_files() -> list[str]:
    return [*(f"{table}.csv" for table in TABLES), "summary.md"]


def export(path: Path, folder: Path) -> list[Path]:
    """Write every table as CSV and the summary as Markdown into a folder; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    # Tables are written as they are read: queries may be more than memory holds.
    texts: dict[str, Iterable[str]] = {f"{name}.csv": _csv_parts(path, name) for name in TABLES}
    texts["summary.md"] = [to_markdown(summary(read_table(path, "cells")))]
    for name, parts in texts.items():
        write_atomically(folder / name, (part.encode("utf-8") for part in parts))
    return [folder / name for name in texts]


def _csv_parts(path: Path, table: str) -> Iterator[str]:
    header = True
    for part in read_parts(path, table, order=terms_in_order(STORED[table])):
        names, rows = checked(path, table, part)
        yield csv_lines([names, *rows] if header else rows)
        header = False
