"""A run as one self-contained HTML page: who wins, findings, failures, tables and plots to work with."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vibench.errors import RequestError
from vibench.files import write_atomically
from vibench.qp.status import Status
from vibench.report import findings, plots
from vibench.report.figures import FigureTask, figures_of, processes, render
from vibench.report.figures.data import TABLES, Extent, ProblemTables, label_of, problem_tables, whole
from vibench.report.plots import image_of, script_safe, short
from vibench.results import formats, pictures, ranking, show
from vibench.results.break_even import MARGIN
from vibench.results.paired_timing import PairedTiming
from vibench.results.ranking import LARGEST_BAND, Criterion, Winner, leaderboard
from vibench.results.read import in_order, read_table
from vibench.results.schema import STORED, Column
from vibench.results.selection import short_keys
from vibench.results.sqlite import read_meta, study_of
from vibench.stability.infsup import VANISHES
from vibench.text import printable

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


RECORDED = [pair for table in (STORED["cells"], STORED["thresholds"], *STORED.values()) for pair in table.items()]
"""Columns of all tables, those of cells first."""


def grid_of_cells(cells: pd.DataFrame, caption: str) -> TableGrid:
    """The table of all cells, in the order of the rows."""
    names = [n for n in (*OF_CELLS, *MORE_OF_CELLS) if n in ("cell", *show.AXES) or cells[n].notna().any()]
    says_nothing = [name for name in names if STORED["cells"][name].heading and not formats.says_something(cells, name)]
    length = short_keys(cells["cell"])
    frame = formats.under_headings(cells.assign(cell=cells["cell"].str[:length]), names, STORED["cells"])
    hidden = [_heading(STORED["cells"], name) for name in (*says_nothing, *MORE_OF_CELLS) if name in names]
    axes = tuple(_heading(STORED["cells"], name) for name in (*show.AXES, "status"))
    disturbed, left_out = _disturbed(cells["cell"], cells), (*hidden, *_constant(frame))
    return TableGrid("summary", "All cells", caption, frame, axes, left_out, disturbed)


def grid_of_thresholds(name: str, title: str, caption: str, rows: pd.DataFrame, cells: pd.DataFrame) -> TableGrid:
    """A table of break-even points; a row is disturbed if one of its cells is."""
    ordered = in_order(rows)
    frame = formats.break_even_table(rows)
    first = _heading(STORED["thresholds"], "primal_b")
    frame = frame[[first, *frame.columns.drop(first)]]
    results = {_heading(STORED["thresholds"], name) for name in ("benefit_threshold", "threshold_high")}
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


def _numbers_in_text(values: pd.Series) -> bool:
    """Whether a column of texts has numbers alone: tolerances are texts since a dimension may take their place."""
    if not len(values) or not all(isinstance(value, str) for value in values):
        return False
    return bool(pd.to_numeric(values.drop_duplicates(), errors="coerce").notna().all()) and values.name != "cell"


ERRORS = (
    "Errors are relative; they are means over the ok queries whose high-fidelity solution is not zero. Where a run has "
    "others, columns u = 0 and λ = 0 have their number and their largest error over the largest training norm. Means "
    "over other queries are not comparable: findings and figures take those over queries that all solved."
)

READ = tuple(dict.fromkeys((*TABLES, *findings.READ)))
"""Tables from which findings, tables and figures are all made: they are read once."""

FOLDED = 300
"""Findings that can be unfolded; thousands of a large study would be read by nobody."""

IDENTITY = [
    "problem",
    "formulation",
    "dual",
    "primal",
    "primal_tol",
    "solver",
    "accuracy",
    "assembly",
    "correction",
    "status",
]
"""Columns that cells and queries share in the tables of failures."""


def write(path: Path, target: Path, jobs: int = 1, *, figures: bool = True) -> Path:
    """Write the page of a results file as `target`; an interrupted call leaves no incomplete file under its name.

    As many processes as `jobs` draw its pictures, this one included; pictures of the figures take most of the time. The
    other processes import the main module: with more than one, a script that calls this has to guard what it does by
    ``if __name__ == "__main__"``.

    Raises a `RequestError` if `target` is the results file, or cannot be written.
    """
    if os.path.realpath(target) == os.path.realpath(path):  # of links in a circle, too
        raise RequestError(f"'{target}' is the results file itself; choose another file for the report")
    try:
        write_atomically(target, page(path, jobs, figures=figures).encode("utf-8"))
    except OSError as error:
        raise RequestError(f"'{target}' cannot be written: {error.strerror}") from None
    return target


def page(path: Path, jobs: int = 1, *, figures: bool = True) -> str:
    """The page of a results file, its pictures drawn by so many processes, or without pictures."""
    with processes(jobs if figures else 1) as pool:
        return _page(path, pool, figures=figures)


def _page(path: Path, pool: ProcessPoolExecutor | None, *, figures: bool) -> str:
    study, read = study_of(path, read_meta(path)), {name: read_table(path, name) for name in READ}
    cells, data_of = in_order(read["cells"]), dict(problem_tables(path, read))
    del read["histories"]  # of a large study millions of rows, which `data_of` has in order
    grids = list(_grids({**read, "cells": cells}))
    everything = list(findings.all_findings(read, data_of.items()))
    first, kept = findings.leading(everything), set(findings.leading(everything, findings.MOST + FOLDED))
    rest = [one for one in everything if one in kept and one not in first]
    key_length = short_keys(cells["cell"])
    rows = {str(cell): k for k, cell in enumerate(cells["cell"])}
    live = [plot for name, data in data_of.items() for plot in plots.plots(name, data, rows)]
    paired = PairedTiming(read["timings"].to_dict("records"))
    certified = ranking.certified_errors(read["queries"])
    first_plots = [p for name, data in data_of.items() for p in plots.overview(name, data, rows, paired, certified)]
    tasks = [task for name, data in data_of.items() for task in tasks_of(name, data)] if figures else []
    rendered = render(tasks, image_of, pool)
    images = [image for pages in rendered for image in pages]
    template = environment("templates", trim_blocks=True, lstrip_blocks=True).get_template("report.html.j2")
    return template.render(
        study=study.get("name", path.parent.name),
        facts=list(_facts(study, cells)),
        standings=leaderboard(cells, paired),
        criteria=Criterion,
        largest_band=LARGEST_BAND,
        way=way,
        vanishes=VANISHES,
        short=lambda cell: str(cell)[:key_length],
        findings=first,
        findings_left_out=len(everything) - len(first) - len(rest),
        more_findings=[(subject, list(group)) for subject, group in groupby(rest, key=lambda one: one.subject)],
        cells=len(cells),
        failed=int((cells["status"] != Status.OK).sum()),
        missing=[f"no picture of {one.key[0]}: {one.reason}" for one in pictures.read(path) if one.reason],
        grids=grids,
        drawn=figures,
        images=images,
        cut=any(image.cut for image in images) or any(len(data.duals) > MOST_DUALS for data in data_of.values()),
        plots={plot.name: plot for plot in live},
        overviews=first_plots,
        plots_alone=[plot for plot in live if plot.name not in {image.name for image in images}],
        table_data=Markup(to_json(grids)),
        plot_data=Markup(script_safe({plot.name: plot.data for plot in (*first_plots, *live)})),
        library=Markup(plots.library()) if live or first_plots else "",
        style=Markup(_asset("report.css")),
        script=Markup(_asset("report.js")),
    )


def environment(folder: str, **options: Any) -> Environment:
    """The templates of a folder, in which a text from others is printable and no markup."""
    return Environment(
        loader=PackageLoader("vibench.report", folder),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_printable,
        **options,
    )


def _asset(name: str) -> str:
    return (files("vibench.report") / "templates" / name).read_text(encoding="utf-8").strip()


def _printable(value: Any) -> Any:
    """A text that a template shows; what it has rendered itself stays as it is."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


MOST_DUALS = 1
"""Dual strategies of a problem that have pictures of their own: those of the leaderboard first, then the others."""


def tasks_of(name: str, data: ProblemTables) -> Iterator[FigureTask]:
    """The figures of a problem of which the page has pictures: of long ones the beginning."""
    winners = (winner for one in leaderboard(data.cells) for band in one.bands for winner in band.winners)
    ranked = dict.fromkeys([*filter(None, (str(winner.cell["dual"]) for winner in winners)), *data.duals])
    return figures_of(name, replace(data, extent=Extent.BEGINNING), list(ranked)[:MOST_DUALS])


def way(winner: Winner) -> str:
    """The model of a cell that wins: its enrichment, cone, dimensions and, where that has a part in it, solver."""
    cell = winner.cell
    if not cell["cell"]:
        return "the high-fidelity model"
    size = f"N = {whole(cell['N'])}, R = {whole(cell['R'])}"
    solver = "" if winner.criterion is Criterion.OFFLINE else f"; {cell['solver']}"  # no solver has a part in it
    return f"{label_of(cell)}; {cell['dual']}, {size}{solver}"


def _facts(study: dict[str, Any], cells: pd.DataFrame) -> Iterator[tuple[str, str]]:
    yield "study", ", ".join(f"{key} {value}" for key, value in study.items())
    for axis in ("problem", "formulation", "dual", "primal", "solver", "accuracy", "assembly", "correction"):
        yield axis, ", ".join(str(name) for name in cells[axis].unique())
    yield "cells", f"{len(cells)}, {int(cells['queries'].fillna(0).sum())} queries"
    yield "machine", "; ".join(str(name) for name in cells["machine"].unique())
    versions = {name: text for row in cells["versions"].dropna().unique() for name, text in json.loads(row).items()}
    yield "versions", ", ".join(f"{name} {text}" for name, text in versions.items())
    disturbed, timed = int((cells["disturbed"] == 1).sum()), int(cells["disturbed"].notna().sum())
    seconds = "CPU seconds of one process; the offline time of a cell includes every stage it depends on"
    yield "seconds", f"{seconds}; {disturbed} of {timed} timed cells were timed on a disturbed machine"


def _grids(read: Mapping[str, pd.DataFrame]) -> Iterator[TableGrid]:
    """The tables of the page, those of failures first; a table without rows is none."""
    cells, thresholds = read["cells"], read["thresholds"]
    keys = short_keys(cells["cell"])
    failed = cells[cells["status"] != Status.OK][["cell", *IDENTITY, "queries_ok", "queries", "reason"]]
    queries = read["queries"]
    failed_queries = queries[queries["status"] != Status.OK][["cell", "query", *IDENTITY, "reason"]]
    grids = [
        grid_of("failed", "Cells that are not ok", "", failed, IDENTITY, keys),
        grid_of("failed-queries", "Queries that are not ok", "", failed_queries, IDENTITY, keys),
        grid_of_cells(cells, ERRORS),
    ]
    model = thresholds["cell_a"].isna()
    formulations = formats.between_formulations(thresholds)
    caption = (
        "When b is cheaper than a, offline and online together, by the number of queries, with its 95 % interval; "
        f"as fast where the seconds of queries differ by less than a factor of {MARGIN:g}; undecided where the rounds "
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
    axes = ["problem", "dual", "primal", "primal_tol", "accuracy", "assembly", "solver_a", "solver_b"]
    grids.append(grid_of("disagreements", "Agreement of the solvers", caption, disagreements, axes, keys))
    return (grid for grid in grids if len(grid.frame))
