"""A run as one HTML file that needs nothing else: what was run, what was found, tables, figures, failures."""

from __future__ import annotations

import base64
import inspect
import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from vibench.qp.status import Status
from vibench.report.figures import drawings
from vibench.report.figures.style import WRITTEN, styled
from vibench.report.findings import Finding, findings
from vibench.results import pictures, tables
from vibench.results.break_even import HIGH_FIDELITY
from vibench.results.database import read_meta, study_of

LONG = 48
"""Characters beyond which a text may be wrapped."""

FAILED = [
    "cell",
    "problem",
    "dual",
    "primal",
    "primal_tol",
    "solver",
    "assembly",
    "status",
    "queries_ok",
    "queries",
    "reason",
]
"""Columns of the table of failures."""


FAILED_QUERY = ["cell", "query", "problem", "dual", "primal", "primal_tol", "solver", "assembly", "status", "reason"]
"""Columns of the table of single queries that failed."""


@dataclass(frozen=True)
class Entry:
    """A table's cell: as it is sorted, as it is printed, and its class."""

    value: str
    text: str
    kind: str


@dataclass(frozen=True)
class Grid:
    """A table of the report."""

    id: str
    title: str
    said: str
    columns: list[str]
    rows: list[list[Entry]]


@dataclass(frozen=True)
class Drawn:
    """A figure of the report: its source is a data URI."""

    name: str
    said: str
    source: str


def write(path: Path, target: Path) -> Path:
    """Write the report of a results file; it is whole or not there.

    Parameters
    ----------
    path
        Results file.
    target
        The HTML file.
    """
    part = target.with_name(target.name + ".part")
    part.write_text(html(path), encoding="utf-8")
    part.replace(target)
    return target


def html(path: Path) -> str:
    """The report of a results file."""
    environment = Environment(loader=PackageLoader("vibench.report"), autoescape=True, undefined=StrictUndefined)
    grid = environment.get_template("grid.html.j2")
    cells, queries, shown = tables.read(path, "cells"), tables.read(path, "queries"), list(_tables(path))
    return environment.get_template("report.html.j2").render(
        study=study_of(path, read_meta(path)).get("name", path.parent.name),
        sections=[("findings", "Findings"), ("failures", "What fell short")]
        + [(table.id, table.title) for table in shown]
        + [("figures", "Figures")],
        facts=list(_facts(path, cells)),
        findings=_by_heading(findings(path)),
        cells=len(cells),
        failures=_grid("failed", "", "", cells[cells["status"] != Status.OK][FAILED]),
        queries=_grid("queries", "", "", queries[queries["status"] != Status.OK][FAILED_QUERY]),
        missing=[f"no picture of {one.key[0]}: {one.reason}" for one in pictures.read(path) if one.reason],
        tables=shown,
        figures=list(_figures(path)),
        grid=lambda table: Markup(grid.render(table=table)),
    )


def _facts(path: Path, cells: pd.DataFrame) -> Iterator[tuple[str, str]]:
    study = study_of(path, read_meta(path))
    yield "study", ", ".join(f"{key} {value}" for key, value in study.items())
    for axis in ("problem", "dual", "primal", "solver", "assembly"):
        yield axis, ", ".join(str(name) for name in cells[axis].unique())
    yield "cells", f"{len(cells)}, {int(cells['queries'].fillna(0).sum())} queries"
    yield "machine", "; ".join(str(name) for name in cells["machine"].unique())
    versions = {name: text for row in cells["versions"].dropna() for name, text in json.loads(row).items()}
    yield "versions", ", ".join(f"{name} {text}" for name, text in versions.items())
    yield "seconds", "CPU seconds of one thread; offline times are sums of the stages a cell would have had to run"


def _by_heading(found: list[Finding]) -> list[tuple[str, list[str]]]:
    """Sentences under what they are about."""
    headings = dict.fromkeys(finding.about for finding in found)
    return [(about, [finding.text for finding in found if finding.about == about]) for about in headings]


def _tables(path: Path) -> Iterator[Grid]:
    said = "Errors are relative and means over the queries that are ok."
    yield _grid("summary", "All cells", said, tables.summary(tables.read(path, "cells")))
    thresholds = tables.read(path, "thresholds")
    model = thresholds["primal_a"] == HIGH_FIDELITY
    said = "From how many queries on b pays against a."
    for name, against, rows in (("enrichments", "between enrichments", ~model), ("model", "of reduced models", model)):
        if rows.any():
            yield _grid(name, f"Benefit thresholds {against}", said, tables.benefits(thresholds[rows]))
    disagreements = tables.in_order(tables.read(path, "disagreements"))
    if len(disagreements):
        said = "Every two solvers on one reduced model: relative differences of u in V, and what the accuracy allows."
        yield _grid("disagreements", "Agreement of the solvers", said, disagreements.drop(columns="problem_options"))


def _grid(name: str, title: str, said: str, frame: pd.DataFrame) -> Grid:
    shown = frame.dropna(axis=1, how="all")
    rows = [[_entry(value) for value in row] for row in shown.itertuples(index=False)]
    return Grid(name, title, said, [str(column) for column in shown.columns], rows)


def _entry(value: Any) -> Entry:
    text = tables.cell_text(value)
    number = isinstance(value, Real) and not isinstance(value, bool)
    plain = "" if not text else repr(float(value)).replace("inf", "Infinity") if number else text
    return Entry(plain, text, "number" if number else "long" if len(text) > LONG else "")


def _figures(path: Path) -> Iterator[Drawn]:
    for name, draw, data in drawings(path):
        with styled():
            figure = draw(data)
            if figure is None:
                continue
            stream = io.BytesIO()
            figure.savefig(stream, format="svg", **WRITTEN["svg"])
        source = "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
        yield Drawn(name, " ".join((inspect.getdoc(draw) or "").split()), source)
