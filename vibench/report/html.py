"""A run as one self-contained HTML page: who wins, findings, failures, tables and plots to work with."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vibench.errors import RequestError
from vibench.files import write_atomically, writing
from vibench.qp.status import Status
from vibench.report import findings, plots
from vibench.report.differences import ComparedRun
from vibench.report.figures import drawings, render
from vibench.report.figures.data import label, problem_tables
from vibench.report.figures.data import way as way_of_queries
from vibench.report.plots import image_of, script_safe, short
from vibench.results import formats, pictures, ranking, show
from vibench.results.paired_timing import PairedTiming
from vibench.results.ranking import LARGEST_BAND, Criterion, Winner, leaderboard
from vibench.results.read import in_order, read_table
from vibench.results.schema import STORED, TABLES
from vibench.results.selection import short_keys
from vibench.results.verdict import verdicts
from vibench.stability.infsup import VANISHES
from vibench.study.cells import NO_SUCH_AXIS
from vibench.text import printable


@dataclass(frozen=True)
class TableGrid:
    """A table of the report."""

    name: str  # identifier in the page
    title: str
    caption: str
    frame: pd.DataFrame  # rows as they are shown, under their headings; the first column names a row
    axes: tuple[str, ...]  # headings that rows can be filtered by
    hidden: tuple[str, ...]  # headings that are not shown at first
    disturbed: tuple[int, ...] = ()  # rows whose seconds were measured on a disturbed machine

    def meaning(self, heading: str) -> str:
        """Meaning and unit of the column with a heading; "" if it is no recorded one."""
        for table in (STORED["cells"], STORED["thresholds"], *STORED.values()):
            for name, column in table.items():
                if heading in (name, column.heading):
                    return printable(f"{column.meaning} [{column.unit}]" if column.unit else column.meaning)
        return ""

    @property
    def first(self) -> tuple[list[str], list[list[str]]]:
        """The headings that are shown at first, and the texts of the first rows under them."""
        shown = [str(name) for name in self.frame.columns if name not in self.hidden]
        # Without its script a page has 50 rows of a table.
        rows = self.frame[shown].head(50).itertuples(index=False)
        return shown, [[formats.cell_text(value) for value in row] for row in rows]


def grid_of_cells(cells: pd.DataFrame, caption: str) -> TableGrid:
    """The table of all cells, in the order of the rows."""
    columns = STORED["cells"]
    headings = {name: column.heading or name for name, column in columns.items()}
    # Columns that matter most come first; those of `offered` are not shown at first.
    first = (
        "cell", *show.AXES, "status", "queries_ok", "error_lambda_mean", "error_u_mean", "online_s", "offline_s",
        "beta_span_min", "beta_cone_lower_min", "N", "R", "enrichment", "queries_zero_u", "error_u_zero_max",
        "queries_zero_lambda", "error_lambda_zero_max",
    )  # fmt: skip
    offered = (
        "hf_s", "online_q1_s", "online_q3_s", "share_validation", "violation_max", "solver_share_mean", "residual_max",
        "peak_memory_mib", "slowdown", "reason", "fallbacks", "machine",
    )  # fmt: skip
    names = [n for n in (*first, *offered) if n in ("cell", *show.AXES) or cells[n].notna().any()]
    says_nothing = [name for name in names if columns[name].heading and not formats.says_something(cells, name)]
    length = short_keys(cells["cell"])
    frame = formats.under_headings(cells.assign(cell=cells["cell"].str[:length]), names, columns)
    hidden = [headings[name] for name in (*says_nothing, *offered) if name in names] + _constant(frame)
    axes, disturbed = tuple(headings[name] for name in (*show.AXES, "status")), _disturbed(cells["cell"], cells)
    return TableGrid("summary", "All cells", caption, frame, axes, tuple(hidden), disturbed)


def grid_of_thresholds(name: str, title: str, caption: str, rows: pd.DataFrame, cells: pd.DataFrame) -> TableGrid:
    """A table of break-even points; a row is disturbed if one of its cells is."""
    ordered, frame, names = in_order(rows), formats.break_even_table(rows), STORED["thresholds"]
    first, *results = (names[name].heading or name for name in ("primal_b", "benefit_threshold", "threshold_high"))
    frame = frame[[first, *frame.columns.drop(first)]]
    texts = [heading for heading in frame.columns if not pd.api.types.is_numeric_dtype(frame[heading])]
    axes = tuple(heading for heading in texts if heading not in results)
    disturbed = {*_disturbed(ordered["cell_a"], cells), *_disturbed(ordered["cell_b"], cells)}
    # Results stay even if all are undecided: an interval alone would read like a result.
    hidden = tuple(heading for heading in _constant(frame) if heading not in results)
    return TableGrid(name, title, caption, frame, axes, hidden, tuple(sorted(disturbed)))


def grid_of(name: str, title: str, caption: str, frame: pd.DataFrame, axes: Sequence[str], keys: int) -> TableGrid:
    """Any other table, without empty columns, and with `keys` characters of the keys of cells."""
    shown = frame.dropna(axis=1, how="all")
    shown = shown.assign(cell=shown["cell"].str[:keys]) if "cell" in shown else shown
    return TableGrid(name, title, caption, shown, tuple(one for one in axes if one in shown), tuple(_constant(shown)))


def _constant(frame: pd.DataFrame) -> list[str]:
    """Columns after the first one with the same value in all rows."""
    return [str(name) for name in frame.columns[1:] if len(frame) > 1 and frame[name].nunique(dropna=False) == 1]


def _disturbed(keys: pd.Series, cells: pd.DataFrame) -> tuple[int, ...]:
    disturbed = set(cells["cell"][cells["disturbed"] == 1])
    return tuple(k for k, key in enumerate(keys) if key in disturbed)


def _columnar(grid: TableGrid) -> dict[str, Any]:
    named = {str(name): grid.frame[name] for name in grid.frame.columns}
    return {
        "rows": len(grid.frame), "hidden": sorted(set(grid.hidden)), "disturbed": list(grid.disturbed),
        "columns": [{"meaning": grid.meaning(name)} | _column(name, values) for name, values in named.items()],
        # A list of more than 60 texts is no convenient filter.
        "axes": [name for name in grid.axes if 1 < grid.frame[name].nunique() <= 60],
    }  # fmt: skip


def _column(name: str, values: pd.Series) -> dict[str, Any]:
    """A column as numbers, as texts, or as codes of texts if most of them recur; a constant value is written once."""
    heading = printable(name)
    # Tolerances are texts, since a dimension may replace them.
    texts_only = name != "cell" and len(values) > 0 and all(isinstance(value, str) for value in values)
    if pd.api.types.is_numeric_dtype(values) or (
        texts_only and pd.to_numeric(values.drop_duplicates(), errors="coerce").notna().all()
    ):
        numbers = [short(value, 6) for value in values]
        return {"name": heading, "numbers": numbers if len(set(numbers)) > 1 else numbers[:1]}
    texts = [printable(formats.cell_text(value)) for value in values]
    levels = list(dict.fromkeys(texts))
    if 2 * len(levels) > len(texts):
        return {"name": heading, "texts": texts}
    if len(levels) == 1:
        return {"name": heading, "levels": levels}
    number = {text: k for k, text in enumerate(levels)}
    return {"name": heading, "levels": levels, "codes": [number[text] for text in texts]}


def write(path: Path, target: Path, *, figures: bool = True) -> Path:
    """Write the page of a results file as `target`; an interrupted call leaves no incomplete file under its name.

    Raises a `RequestError` if `target` is the results file, or cannot be written.
    """
    # `os.path`, since `Path.resolve` raises for links in a circle.
    if os.path.realpath(target) == os.path.realpath(path):
        raise RequestError(f"'{target}' is the results file itself; choose another file for the report")
    with writing(target):
        write_atomically(target, page(path, figures=figures).encode("utf-8"))
    return target


def page(path: Path, *, figures: bool = True) -> str:
    """The page of a results file."""
    run, read = ComparedRun(path, ""), {name: read_table(path, name) for name in TABLES}
    cells, data_of = in_order(read["cells"]), dict(problem_tables(path, read))
    # Histories may have millions of rows, and `data_of` has them.
    del read["histories"]
    grids = list(_grids({**read, "cells": cells}))
    key_length = short_keys(cells["cell"])
    rows = {str(cell): k for k, cell in enumerate(cells["cell"])}
    paired = PairedTiming(read["timings"].to_dict("records"))
    certified = ranking.certified_errors(read["queries"])
    overviews = (plots.overview(name, data, rows, paired, certified) for name, data in data_of.items())
    live = [plot for plot in overviews if plot is not None]
    images, failures = render(list(drawings(data_of.items(), ("answer",) if figures else ())), image_of)
    templates = files("vibench.report") / "templates"
    style, script = ((templates / f"report.{end}").read_text(encoding="utf-8").strip() for end in ("css", "js"))
    template = environment("templates", trim_blocks=True, lstrip_blocks=True).get_template("report.html.j2")
    return template.render(
        study=run.identity["study"] or path.parent.name, facts=list(run.facts),
        verdicts=list(verdicts(cells, read["thresholds"])), cells=len(cells),
        standings=leaderboard(cells, paired), criteria=Criterion, largest_band=LARGEST_BAND, way=way,
        vanishes=VANISHES, short=lambda cell: str(cell)[:key_length], findings=list(findings.all_findings(read)),
        failed=int((cells["status"] != Status.OK).sum()),
        missing=failures + [f"no picture of {one.key[0]}: {one.reason}" for one in pictures.read(path) if one.reason],
        grids=grids, drawn=figures, images=images, plots=live,
        table_data=Markup(script_safe({grid.name: _columnar(grid) for grid in grids})),
        plot_data=Markup(script_safe({plot.name: plot.data for plot in live})),
        library=Markup(plots.library()) if live else "", style=Markup(style), script=Markup(script),
    )  # fmt: skip


@cache
def environment(folder: str, **options: Any) -> Environment:
    """The templates of a folder, each compiled once, in which a text from others is printable and no markup."""

    def finalize(value: Any) -> Any:
        return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value

    loader = PackageLoader("vibench.report", folder)
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, finalize=finalize, **options)


def way(winner: Winner) -> str:
    """The model of a cell that wins: its enrichment, cone, dimensions and solver."""
    cell = winner.cell
    if not cell["cell"]:
        return "the high-fidelity model"
    size = ", ".join(f"{name} = {formats.cell_text(cell[name]) or NO_SUCH_AXIS}" for name in ("N", "R"))
    # The offline phase involves no QP solver.
    solver = "" if winner.criterion is Criterion.OFFLINE else f"; {cell['solver']}"
    how = way_of_queries(cell["assembly"], cell["bounds"], cell["correction"])
    return f"{label(cell['primal'], cell['primal_tol'], how)}; {cell['dual']}, {size}{solver}"


def _grids(read: Mapping[str, pd.DataFrame]) -> Iterator[TableGrid]:
    """The tables of the page, those of failures first; a table without rows is none."""
    cells, thresholds = read["cells"], read["thresholds"]
    keys = short_keys(cells["cell"])
    identity = ["problem", "formulation", "dual", "primal", "primal_tol", "solver", "accuracy", "assembly", "bounds"]
    identity += ["correction", "status"]
    failed = cells[cells["status"] != Status.OK][["cell", *identity, "queries_ok", "queries", "reason"]]
    queries = read["queries"]
    failed_queries = queries[queries["status"] != Status.OK][["cell", "query", *identity, "reason"]]
    grids = [
        grid_of("failed", "Cells that are not ok", "", failed, identity, keys),
        grid_of("failed-queries", "Queries that are not ok", "", failed_queries, identity, keys),
        grid_of_cells(
            cells,
            "Errors are relative; they are means over the ok queries whose high-fidelity solution is not zero. Where a "
            "run has others, columns u = 0 and λ = 0 have their number and their largest error over the largest "
            "training norm. Means over other queries are not comparable: figures take cells with every query ok.",
        ),
    ]
    model = thresholds["cell_a"].isna()
    formulations = formats.between_formulations(thresholds)
    caption = (
        "When b is cheaper than a, offline and online together, by the number of queries, with its 95 % interval; "
        "as fast where the seconds of queries differ by less than a factor of 1.25; undecided where the rounds "
        "do not tell."
    )
    for name, title, rows in (
        ("enrichments", "Break-even between enrichments", thresholds[~model & ~formulations]),
        ("formulations", "Break-even between formulations", thresholds[formulations]),
        ("model", "Break-even against the high-fidelity model", thresholds[model]),
    ):
        if len(rows):
            grids.append(grid_of_thresholds(name, title, caption, rows, cells))
    caption = "Any two solvers on one reduced model: relative differences of u in V, and the differences allowed."
    disagreements = in_order(read["disagreements"])
    disagreements = disagreements[["solver_a", *disagreements.columns.drop(["solver_a", "problem_options"])]]
    axes = ["problem", "dual", "primal", "primal_tol", "accuracy", "assembly", "bounds", "solver_a", "solver_b"]
    grids.append(grid_of("disagreements", "Agreement of the solvers", caption, disagreements, axes, keys))
    return (grid for grid in grids if len(grid.frame))
