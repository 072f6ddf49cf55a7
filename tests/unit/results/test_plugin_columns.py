"""Columns of plugins: computed when a table is read, refused or reported in a line, and never the end of a table."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from running import Main, Register, refused
from sample_run import write_sample_run
from samples import cell_row, query_rows

import vibench
from vibench import DerivedColumn, FigurePlugin, RunTables
from vibench.report import figures, html
from vibench.report.comparison.compare import compare
from vibench.report.page.grids import grid_of_cells
from vibench.results.database import ResultsDatabase
from vibench.results.plugin_columns import extended_tables
from vibench.results.ranking import fastest
from vibench.results.read import extended, read_table
from vibench.results.sqlite import FILE

GROUP, HERE = "vibench.figures", __name__


class Savings(FigurePlugin):
    """What a query saves."""

    def columns(self) -> Sequence[DerivedColumn]:
        def slowest(found: RunTables) -> pd.Series:
            return found.cells["cell"].map(found.queries.groupby("cell")["total_s"].max())

        def size(found: RunTables) -> list[str]:
            cells = found.cells
            cells["N"] = 0  # a copy: what is recorded stays
            return ["small" if row.R < 5 else "large" for row in found.cells.itertuples()]

        return (
            DerivedColumn(
                "speedup", "Seconds of a high-fidelity solution over those of a query.",
                lambda found: found.cells["hf_s"] / found.cells["online_s"], heading="speed-up", better="larger",
            ),
            DerivedColumn("slowest_s", "Slowest query.", slowest, unit="s"),
            DerivedColumn("unknowns", "Unknowns.", lambda of: of.cells["N"] + of.cells["R"], kind=int, unit=""),
            DerivedColumn("size", "Whether R is small.", size, kind=str, unit=""),
            DerivedColumn("odd", "Whether its number is odd.", lambda found: found.queries["query"] % 2,
                          table="queries", kind=int, unit=""),
        )  # fmt: skip


class One(FigurePlugin):
    """One column, which is what a test makes it."""

    made: Any = None

    def columns(self) -> Any:
        return type(self).made()


class Rival(FigurePlugin):
    """Has the name of a column of the other."""

    def columns(self) -> Sequence[DerivedColumn]:
        return (DerivedColumn("Speedup", "Mine.", lambda found: [0.0] * len(found.cells)),)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Results of three cells in the order b, c, a, with two queries each."""
    database = ResultsDatabase(tmp_path / "run", {"name": "sample", "seed": 1, "validation": 2})
    for k, cell in enumerate("bca"):
        row = cell_row(cell, problem=cell, N=k, R=2 + 2 * k, hf_s=6.0, online_s=float(k + 1), machine="m", disturbed=0)
        database.write_cell(row, query_rows(cell, total_s=0.1 * k))
    database.close()
    return tmp_path / "run" / FILE


def column(**given: Any) -> Sequence[DerivedColumn]:
    return (DerivedColumn(**({"name": "mine", "meaning": "Mine."} | given)),)


def test_columns_are_derived_from_all_tables_in_the_order_of_the_rows(register: Register, path: Path) -> None:
    register((GROUP, "savings", f"{HERE}:Savings"))
    found = extended(path, "cells")
    assert found.faults == ()
    assert list(found.columns) == ["speedup", "slowest_s", "unknowns", "size"]
    assert list(found.frame["cell"]) == ["b", "c", "a"]
    np.testing.assert_allclose(found.frame["speedup"], [6.0, 3.0, 2.0])
    np.testing.assert_allclose(found.frame["slowest_s"], [0.0, 0.1, 0.2])
    assert list(found.frame["unknowns"]) == [2, 5, 8]
    assert list(found.frame["size"]) == ["small", "small", "large"]
    assert list(extended(path, "queries").frame["odd"]) == [0, 1] * 3
    assert list(found.frame["N"]) == [0, 1, 2]


def test_tables_are_read_and_plugins_created_once_for_all_tables(
    register: Register, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register((GROUP, "savings", f"{HERE}:Savings"))
    created: list[Savings] = []
    read: list[str] = []
    names = ["queries", "cells", "disagreements"]

    def create(self: Savings) -> None:
        created.append(self)

    def recorded(name: str) -> pd.DataFrame:
        read.append(name)
        return read_table(path, name)

    monkeypatch.setattr(Savings, "__init__", create)
    found = extended_tables(names, recorded)
    assert (read, len(created), list(found)) == (names, 1, names)
    assert list(found["cells"].columns) == ["speedup", "slowest_s", "unknowns", "size"]
    assert list(found["queries"].columns) == ["odd"]
    assert not found["disagreements"].columns


def test_the_library_and_the_exports_have_them(register: Register, path: Path) -> None:
    register((GROUP, "savings", f"{HERE}:Savings"))
    run = vibench.open_run(path)
    assert list(run.cells["cell"]) == ["a", "b", "c"]
    np.testing.assert_allclose(run.cells["speedup"], [2.0, 6.0, 3.0])
    assert list(run.summary.columns)[-1] == "speed-up"
    assert list(run.queries["odd"]) == list(run.queries["query"])
    files = {file.name: file for file in run.write_tables()}
    written = pd.read_csv(files["cells.csv"])
    assert list(written["unknowns"]) == [8, 2, 5]
    assert "speed-up" in files["summary.md"].read_text(encoding="utf-8")


def test_the_command_shows_selects_and_sorts_by_them(register: Register, path: Path, main: Main) -> None:
    register((GROUP, "savings", f"{HERE}:Savings"))
    run = str(path.parent)
    asked = ("--columns", "cell,speed-up,size", "--where", "speedup >= 3 and size = 'small'", "--sort", "speedup")
    code, out, err = main("show", run, *asked, "--format", "csv")
    assert (code, err) == (0, "")
    assert out.splitlines() == ["cell,speedup,size", "c,3.0,small", "b,6.0,small"]
    code, out, _ = main("show", run, "--format", "markdown")
    assert "speed-up" in out
    assert "slowest_s" not in out  # it has no heading
    _, out, _ = main("show", run, "--table", "cells", "--format", "json")
    assert [row["slowest_s"] for row in json.loads(out)] == [0.2, 0.0, 0.1]
    refused(main("show", run, "--where", "speedups > 1"), "no column of cells is called 'speedups'", "'speedup'")
    for forbidden in ("speedup > (SELECT 1)", "max(speedup) > 1", "speedup > 1; DROP TABLE cells"):
        refused(main("show", run, "--where", forbidden), "--where")


def test_the_list_names_them(register: Register, main: Main) -> None:
    register((GROUP, "savings", f"{HERE}:Savings"))
    code, out, _ = main("list", "figures")
    assert code == 0
    assert "column speedup of cells [1]: " in out
    assert "column odd of queries: Whether its number is odd." in out


def test_a_report_offers_them(register: Register, path: Path) -> None:
    register((GROUP, "savings", f"{HERE}:Savings"))
    grid = grid_of_cells(extended(path, "cells"), "")
    assert {"speed-up", "slowest_s", "unknowns", "size"} <= set(grid.frame.columns)
    assert "slowest_s" in grid.hidden
    assert "speed-up" not in grid.hidden


MINE = "column 'mine' of figure plugin 'one' "


@pytest.mark.parametrize(
    ("made", "line"),
    [
        (lambda: column(values=lambda found: [1.0, 2.0]), MINE + "has 2 values for the 3 rows of 'cells'"),
        (lambda: column(values=lambda found: 1 / 0),
         MINE + "cannot be computed: ZeroDivisionError: division by zero"),
        (lambda: column(values=lambda found: found.cells["no"]), MINE + "cannot be computed: KeyError: 'no'"),
        (lambda: column(values=lambda found: "abc"), MINE + "is a str, expected a value for each row"),
        (lambda: column(values=lambda found: found.cells.sort_values("cell")["N"]),
         MINE + "is a Series with another index than the table 'cells' has"),
        (lambda: column(values=lambda found: ["a", "b", "c"]),
         MINE + "has 'a' in row 0: a value of the type str is no REAL"),
        (lambda: column(values=lambda found: [1, 2.5, 3], kind=int),
         MINE + "has 2.5 in row 1: a value of the type float is no INTEGER"),
        (lambda: column(values=lambda found: [1.0, True, 0.0]),
         MINE + "has the value True in row 1, expected float"),
        (lambda: column(values=lambda found: [1.0, 2.0, 3.0], kind=str),
         MINE + "has 1.0 in row 0: a value of the type float is no TEXT"),
        (lambda: column(values=len, name="n"),
         "column 'n' of figure plugin 'one' has the name of a column of vibench, and needs another"),
        (lambda: column(values=len, name="mu_2"),
         "column 'mu_2' of figure plugin 'one' has the name of a column of vibench, and needs another"),
        (lambda: column(values=len, heading="error u"),
         MINE + "has the heading 'error u' of a column of vibench, and needs another"),
        (lambda: column(values=lambda found: [0.0] * 3) * 2,
         MINE + "has the name of a column of figure plugin 'one', and needs another"),
        (lambda: column(values=len, name="a b"),
         "figure plugin 'one' has no columns: ValueError: the column 'a b' has a name that is not made of letters, "
         "digits and underscores, a letter first"),
        (lambda: column(values=len, table="solutions"),
         "figure plugin 'one' has no columns: ValueError: the column 'mine' is for the table 'solutions', expected one "
         "of cells, queries, histories, timings, thresholds, outputs"),
        (lambda: column(values=len, kind=bool),
         "figure plugin 'one' has no columns: ValueError: the column 'mine' has the kind <class 'bool'>, expected "
         "float, int or str"),
        (lambda: [1], "figure plugin 'one' declares a int, expected a vibench.DerivedColumn"),
        (lambda: None, "figure plugin 'one' has no columns: TypeError: 'NoneType' object is not iterable"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_a_line_and_costs_no_other_column(
    made: Any, line: str, register: Register, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(One, "made", staticmethod(made))
    register((GROUP, "one", f"{HERE}:One"), (GROUP, "savings", f"{HERE}:Savings"))
    found = extended(path, "cells")
    assert found.faults == (line,)
    assert {"speedup", "slowest_s", "unknowns", "size"} <= set(found.columns)
    with pytest.warns(UserWarning, match="figure plugin 'one'"):
        assert len(vibench.open_run(path).cells) == 3


def test_a_name_that_two_plugins_have_is_the_column_of_the_first(register: Register, path: Path) -> None:
    register((GROUP, "a-savings", f"{HERE}:Savings"), (GROUP, "rival", f"{HERE}:Rival"))
    found = extended(path, "cells")
    assert found.faults == (
        "column 'Speedup' of figure plugin 'rival' has the name of a column of figure plugin 'a-savings', and needs "
        "another",
    )
    np.testing.assert_allclose(found.frame["speedup"], [6.0, 3.0, 2.0])


def test_a_column_that_failed_is_refused_with_its_reason_and_the_table_is_shown(
    register: Register, path: Path, main: Main, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(One, "made", staticmethod(lambda: column(values=lambda found: 1 / 0)))
    register((GROUP, "one", f"{HERE}:One"))
    reason = "column 'mine' of figure plugin 'one' cannot be computed: ZeroDivisionError: division by zero"
    code, out, err = main("show", str(path.parent), "--columns", "cell", "--format", "csv")
    assert (code, out, err) == (0, "cell\na\nb\nc\n", f"vibench: {reason}\n")
    refused(main("show", str(path.parent), "--columns", "cell,mine"), reason)


class Two(FigurePlugin):
    """Columns of two tables, of which neither can be computed."""

    def columns(self) -> Sequence[DerivedColumn]:
        return (
            DerivedColumn("mine", "Mine.", lambda found: 1 / 0),
            DerivedColumn("later", "Mine.", lambda found: 1 / 0, table="histories"),
        )


TWO = [
    "column 'mine' of figure plugin 'two' cannot be computed: ZeroDivisionError: division by zero",
    "column 'later' of figure plugin 'two' cannot be computed: ZeroDivisionError: division by zero",
]


def test_figures_say_once_which_columns_their_data_do_not_have(
    register: Register, main: Main, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "OF_PROBLEM", {"errors": figures.OF_PROBLEM["errors"]})
    monkeypatch.setattr(figures, "OF_DUAL", {})
    register((GROUP, "two", f"{HERE}:Two"))
    path = write_sample_run(tmp_path / "run")
    lines: list[str] = []
    drawn = figures.draw_all(path, tmp_path / "figures", ("svg",), note=lines.append)
    assert drawn
    assert lines == TWO
    code, out, _ = main("figures", str(path.parent), "--out", str(tmp_path / "drawn"), "--format", "svg", "--jobs", "1")
    assert code == 0
    assert [line for line in out.splitlines() if line.startswith("column")] == TWO
    with pytest.warns(UserWarning, match="'two'") as caught:
        vibench.open_run(path).figure("errors", problem="plate")
    assert [str(one.message) for one in caught] == TWO
    assert {one.filename for one in caught} == {__file__}


def test_a_report_and_a_site_say_once_which_columns_they_do_not_have(
    register: Register, main: Main, tmp_path: Path
) -> None:
    register((GROUP, "two", f"{HERE}:Two"))
    path = write_sample_run(tmp_path / "run")
    text = html.page(path, figures=False)
    assert [text.count(line.replace("'", "&#39;")) for line in TWO] == [1, 1]
    code, _, err = main("publish", "--yes", str(path.parent), str(tmp_path / "site"), "--no-figures")
    assert (code, err) == (0, f"vibench: {TWO[0]}\n")  # no table of histories is published


@pytest.mark.parametrize(
    ("kind", "values", "dtype"),
    [
        (float, [1.0, None, np.nan], "float64"),
        (int, [1, None, pd.NA], "Int64"),
        (int, [np.int64(1), np.float64(2.0), 3], "int64"),
        (str, ["a", None, pd.NA], "object"),
    ],
)
def test_missing_values_stay_missing(
    kind: type, values: list[Any], dtype: str, register: Register, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(One, "made", staticmethod(lambda: column(values=lambda found: values, kind=kind)))
    register((GROUP, "one", f"{HERE}:One"))
    found = extended(path, "cells")
    assert found.faults == ()
    assert str(found.frame["mine"].dtype) == dtype
    assert list(found.frame["mine"].isna()) == [pd.isna(value) for value in values]


def test_runs_are_compared_by_them_in_the_direction_that_is_better(
    register: Register, path: Path, tmp_path: Path
) -> None:
    register((GROUP, "savings", f"{HERE}:Savings"))
    database = ResultsDatabase(tmp_path / "later", {"name": "sample", "seed": 1, "validation": 2})
    for k, (cell, machine) in enumerate([("b", "m"), ("c", "m"), ("a", "other")]):
        seconds = (2.0, 1.0, 30.0)[k]
        row = cell_row(cell, problem=cell, N=k, R=2 + 2 * k, hf_s=6.0, online_s=seconds, machine=machine, disturbed=0)
        database.write_cell(row, query_rows(cell, total_s=0.1 * k))
    database.close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = compare([path, tmp_path / "later" / FILE], 1.25)
    verdicts = {d.cell["cell"]: d.verdict.value for p in found.pairs for d in p.differences if d.what == "speedup"}
    assert verdicts == {"b": "worse", "c": "better", "a": "undecided"}
    assert list(found.values("unknowns").iloc[:, -1]) == [8, 2, 5]


def test_a_column_that_fails_for_one_of_two_runs_is_no_difference(
    register: Register, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    later = ResultsDatabase(tmp_path / "later", {"name": "sample", "seed": 1, "validation": 2})
    for cell in "bca":
        later.write_cell(cell_row(cell, problem=cell, machine="m", disturbed=0), query_rows(cell))
    later.close()
    counts = [iter([1.0]) for _ in range(3)]
    given = staticmethod(lambda: column(values=lambda found: list(map(next, counts)), better="smaller"))
    monkeypatch.setattr(One, "made", given)
    register((GROUP, "one", f"{HERE}:One"))
    found = compare([path, tmp_path / "later" / FILE], 1.25)
    assert [d for p in found.pairs for d in p.differences if d.what == "mine"] == []
    assert found.notes[-1] == "column 'mine' of figure plugin 'one' has 0 values for the 3 rows of 'cells'"


def test_a_column_may_be_called_error(
    register: Register, path: Path, main: Main, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which is no column of vibench: the table of the best cells keeps it, by problem."""
    given = staticmethod(lambda: column(name="error", kind=int, unit="", values=lambda found: [3, 4, 5]))
    monkeypatch.setattr(One, "made", given)
    register((GROUP, "one", f"{HERE}:One"))
    found = extended(path, "cells").frame.assign(
        error_u_mean=1e-3,
        error_lambda_mean=[1e-3, 2e-3, 0.01],
        beta_span_min=0.5,
        solver_share_mean=0.0,
        assembly_share_mean=0.0,
    )
    assert list(fastest(found)["error"]) == [5, 3, 4]
    assert main("show", str(path), "--table", "best")[0] == 0
