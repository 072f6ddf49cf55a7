"""A run as one self-contained HTML page: setting, findings, failures, tables and figures."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from numbers import Real
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vibench.errors import RequestError
from vibench.files import write_atomically
from vibench.qp.status import Status
from vibench.report.figures import drawings
from vibench.report.figures.plugins import FigureError
from vibench.report.figures.style import caption_of, styled, write_figure
from vibench.report.findings import findings
from vibench.results import pictures, tables
from vibench.results.database import read_meta, study_of
from vibench.text import printable

ERRORS = (
    "Errors are relative; they are means over the ok queries whose high-fidelity solution is not zero. Where a run has "
    "others, columns u = 0 and λ = 0 have their number and their largest error over the largest training norm. Means "
    "over other queries are not comparable: findings and figures take those over queries that all solved."
)

IDENTITY = ["problem", "dual", "primal", "primal_tol", "solver", "accuracy", "assembly", "status"]
"""Columns that cells and queries share in the tables of failures."""


def write(path: Path, target: Path) -> Path:
    """Write the page of a results file as `target`; an interrupted call leaves no incomplete file under its name.

    Raises
    ------
    RequestError
        If `target` is the results file, or cannot be written.
    """
    if target.resolve() == path.resolve():
        raise RequestError(f"'{target}' is the results file itself; choose another file for the report")
    try:
        write_atomically(target, page(path).encode("utf-8"))
    except OSError as error:
        raise RequestError(f"'{target}' cannot be written: {error.strerror}") from None
    return target


def page(path: Path) -> str:
    """The page of a results file."""
    environment = Environment(
        loader=PackageLoader("vibench.report"), autoescape=True, undefined=StrictUndefined, finalize=_printable
    )
    template = environment.get_template("grid.html.j2")
    cells, queries = tables.read(path, "cells"), tables.read(path, "queries")
    study = study_of(path, read_meta(path))
    failures: list[str] = []
    drawn = list(_figures(path, failures))

    def grid(frame: pd.DataFrame) -> Markup:
        shown = frame.dropna(axis=1, how="all")
        rows = [map(_entry, row) for row in shown.itertuples(index=False)]
        return Markup(template.render(columns=shown.columns, rows=rows))

    return environment.get_template("report.html.j2").render(
        study=study.get("name", path.parent.name),
        facts=list(_facts(study, cells)),
        findings=findings(path),
        cells=len(cells),
        failed=cells[cells["status"] != Status.OK][["cell", *IDENTITY, "queries_ok", "queries", "reason"]],
        failed_queries=queries[queries["status"] != Status.OK][["cell", "query", *IDENTITY, "reason"]],
        missing=[
            *(f"no picture of {one.key[0]}: {one.reason}" for one in pictures.read(path) if one.reason),
            *dict.fromkeys(failures),
        ],
        tables=list(_tables(path, cells)),
        figures=drawn,
        grid=grid,
    )


def _printable(value: Any) -> Any:
    """A text that a template shows; what it has rendered itself stays as it is."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _facts(study: dict[str, Any], cells: pd.DataFrame) -> Iterator[tuple[str, str]]:
    yield "study", ", ".join(f"{key} {value}" for key, value in study.items())
    for axis in ("problem", "dual", "primal", "solver", "accuracy", "assembly"):
        yield axis, ", ".join(str(name) for name in cells[axis].unique())
    yield "cells", f"{len(cells)}, {int(cells['queries'].fillna(0).sum())} queries"
    yield "machine", "; ".join(str(name) for name in cells["machine"].unique())
    versions = {name: text for row in cells["versions"].dropna() for name, text in json.loads(row).items()}
    yield "versions", ", ".join(f"{name} {text}" for name, text in versions.items())
    yield "seconds", "CPU seconds of one process; the offline time of a cell includes every stage it depends on"


def _tables(path: Path, cells: pd.DataFrame) -> Iterator[tuple[str, str, str, pd.DataFrame]]:
    """Identifier, title, caption and rows."""
    yield "summary", "All cells", ERRORS, tables.summary(cells)
    thresholds = tables.read(path, "thresholds")
    model = thresholds["cell_a"].isna()
    caption = (
        "When b is cheaper than a, offline and online together, by the number of queries, with its 95 % interval; "
        "undecided where the measured rounds do not tell the sign of a difference."
    )
    for name, title, rows in (
        ("enrichments", "Break-even between enrichments", thresholds[~model]),
        ("model", "Break-even against the high-fidelity model", thresholds[model]),
    ):
        if len(rows):
            yield name, title, caption, tables.benefits(rows)
    disagreements = tables.in_order(tables.read(path, "disagreements")).drop(columns="problem_options")
    if len(disagreements):
        caption = "Any two solvers on one reduced model: relative differences of u in V, and the differences allowed."
        yield "disagreements", "Agreement of the solvers", caption, disagreements


def _entry(value: Any) -> tuple[str, str, str]:
    """A value as JavaScript sorts it, as it is printed, and its class; "long" text may be wrapped."""
    text = tables.cell_text(value)
    number = isinstance(value, Real) and not isinstance(value, bool)
    plain = "" if not text else repr(float(value)).replace("inf", "Infinity") if number else text
    return plain, text, "number" if number else "long" if len(text) > 48 else ""


def _figures(path: Path, failures: list[str]) -> Iterator[tuple[str, str, str]]:
    """Name, caption and data URI of every figure; a line is added to `failures` for each that cannot be drawn."""
    for name, draw, data in drawings(path):
        with styled():
            try:
                figure = draw(data)
            except FigureError as error:
                failures.append(str(error))
                continue
            if figure is None:
                continue
            stream = io.BytesIO()
            write_figure(figure, stream, "svg")
        source = "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
        yield name, caption_of(figure), source
