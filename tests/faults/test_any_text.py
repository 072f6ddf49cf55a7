"""Any text and any count go from a solver through the results file to every output, and act in none of them."""

import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any
from unittest import mock
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numerics import exact
from outputs import clean, elements
from samples import cell_row, filled, query_rows

from vibench import QPSolution, VariationalInequality
from vibench.cli.console import print_frame
from vibench.plugins import registry
from vibench.report import html
from vibench.report.figures import convergence, problem_tables
from vibench.report.figures.style import styled, write_figure
from vibench.results import formats
from vibench.results.database import ResultsDatabase
from vibench.results.read import in_order, read_table
from vibench.results.schema import STORED, TABLES
from vibench.results.sqlite import FILE
from vibench.stages.query import ProgramQuery, run_query

LABEL = "=1+1 [/b] [red] $x^{ $ `a` | <img src=x onerror=alert(1)> </script> \x1b[31m\n@ [x](javascript:y)"
ODD = f"{LABEL} \ud800"

ANYTHING = st.text(st.characters(), max_size=50) | st.sampled_from([LABEL, ODD, "$$", "_", "[/b]", "=1", "|", "\\", ""])
"""All of Unicode, lone surrogates included."""

COUNTS = st.integers() | st.floats() | st.none() | st.text() | st.booleans()


def sample(table: str, **columns: Any) -> dict[str, Any]:
    row = filled(table)
    return row | {name: value for name, value in columns.items() if name in row}


def answered(text: str, count: Any) -> dict[str, Any]:
    """The row of a query whose solver is right, and says this of itself."""

    def solver(program: VariationalInequality, accuracy: float) -> QPSolution:
        return QPSolution(*exact(program), text, count)

    with mock.patch.object(registry, "qp_solver", lambda name: {name: solver}):
        row, _ = run_query(ProgramQuery(PROGRAM, None, "odd", 1e-7), 60.0, contextlib.nullcontext)
    assert row["status"] == "ok", row["reason"]
    return row


PROGRAM = VariationalInequality(np.eye(1), np.ones(1), np.eye(1), np.full(1, 0.5))


def recorded(folder: Path, text: str, count: Any) -> Path:
    """A results file in which a text stands wherever one of others may."""
    names = dict.fromkeys(("problem", "dual", "primal", "solver", "solver_a", "solver_b", "primal_a", "primal_b"), text)
    options = {f"{axis}_options": json.dumps({"of": text}) for axis in ("problem", "dual", "primal")}
    said = names | options | {"fallbacks": text, "quantity": text, "versions": json.dumps({"numpy": text})}
    said |= {"stage": "cone", "meaning": "never", "assembly": "full", "definition": json.dumps(names)}
    said |= {"solver_share_mean": 0.01, "assembly_share_mean": 0.01}
    of_cells, of_queries = ({k: v for k, v in said.items() if k in STORED[table]} for table in ("cells", "queries"))
    with contextlib.closing(ResultsDatabase(folder, {"name": text, "seed": 1, "validation": 2})) as database:
        database.write_cell(cell_row(**of_cells), query_rows(**of_queries | answered(text, count)))
        lost = {"status": "error", "reason": text}
        database.write_cell(cell_row("c2", **of_cells | lost), query_rows("c2", **of_queries | lost))
        database.write_histories([[sample("histories", **said)]])
        for table in ("thresholds", "disagreements"):
            database.replace(table, [sample(table, **said)])
        database.replace("pictures", [sample("pictures", **said) | {"reason": text} | {"data": None}])
    return folder / FILE


def outputs(path: Path) -> list[str]:
    read = {table: in_order(read_table(path, table)) for table in TABLES}
    found = [formats.to_text(frame, form) for frame in read.values() for form in ("markdown", "csv", "latex", "json")]
    summary = formats.summary(read["cells"])
    with contextlib.redirect_stdout(io.StringIO()) as out:
        print_frame(summary, "summary")
        print_frame(read["disagreements"], "disagreements")
    return [*found, formats.to_markdown(summary), out.getvalue()]


def page(path: Path) -> str:
    return html.page(path, figures=False)


def drawn(path: Path) -> str:
    stream = io.BytesIO()
    (data,) = [data for _, data in problem_tables(path)]
    with styled():
        figure = convergence(data)
    with styled():
        write_figure(figure, stream, "svg")
    return stream.getvalue().decode("utf-8")


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    return elements(page(recorded(tmp_path_factory.mktemp("plain"), "plain", 3)))


# The first example is the simplest one, without a text.
@pytest.mark.long
@settings(max_examples=2)
@given(text=ANYTHING, count=COUNTS)
@example(text=ODD, count=2**80)
@example(text=LABEL, count=float("nan"))
@example(text="$x^{ $", count=-(2**63) - 1)
def test_any_text_and_any_count_go_through(own: set[str], text: str, count: Any) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = recorded(Path(folder), text, count)
        assert [row["status"] for row in read_table(path, "cells").to_dict("records")] == ["ok", "error"]
        iterations = read_table(path, "queries")["iterations"].iloc[0]
        assert iterations == count if isinstance(count, int) and 0 <= count < 2**63 else pd.isna(iterations)
        report, picture = page(path), drawn(path)
        assert [found for found in [*outputs(path), report, picture] if not clean(found)] == []
        assert elements(report) <= own | {"td.class"}
        ElementTree.fromstring(picture)
