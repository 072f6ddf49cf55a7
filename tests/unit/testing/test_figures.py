"""Figure plugins that are wrong, each in one way: the check made for it finds it, and no other does."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from matplotlib.figure import Figure
from running import Main, failures, refused

from vibench import DerivedColumn, FigurePlugin, ProblemTables, testing
from vibench.report.figures import OF_DUAL, OF_PROBLEM, drawings
from vibench.results.read import read_table
from vibench.results.schema import TABLES
from vibench.testing.samples.sample_run import write_sample_run

counter = itertools.count()


class Sizes(FigurePlugin):
    """A figure and a column; nothing is wrong with it."""

    def drawings(self, tables: ProblemTables) -> Mapping[str, Callable[[], Any]]:
        def sizes() -> Figure:
            """Sizes of the reduced spaces."""
            figure = Figure()
            figure.subplots().plot(tables.cells["N"], tables.cells["R"], "o")
            return figure

        return {"": sizes, "none": lambda: None}

    def columns(self) -> Sequence[DerivedColumn]:
        return (DerivedColumn("both", "N + R.", lambda found: found.cells["N"] + found.cells["R"]),)


class FewValues(Sizes):
    def columns(self) -> Sequence[DerivedColumn]:
        return (DerivedColumn("both", "N + R.", lambda found: found.cells["N"].dropna()),)


class NeedsRows(Sizes):
    def columns(self) -> Sequence[DerivedColumn]:
        return (DerivedColumn("best", "Ratio.", lambda found: [found.cells["N"].tolist()[0]] * len(found.cells)),)


class Taken(Sizes):
    def columns(self) -> Sequence[DerivedColumn]:
        return (DerivedColumn("n", "N.", lambda found: found.cells["N"]),)


class Counts(Sizes):
    def columns(self) -> Sequence[DerivedColumn]:
        return (DerivedColumn("call", "Calls.", lambda found: [next(counter)] * len(found.cells)),)


class Writes(Sizes):
    def drawings(self, tables: ProblemTables) -> Mapping[str, Callable[[], Any]]:
        def writes() -> None:
            tables.cells["N"] = 0.0

        return {"": writes}


class Fails(Sizes):
    def drawings(self, tables: ProblemTables) -> Mapping[str, Callable[[], Any]]:
        return {"ratio": lambda: 1 / 0}


class Lists(Sizes):
    def drawings(self, tables: ProblemTables) -> Any:
        return ["sizes"]


class Restless(Sizes):
    def drawings(self, tables: ProblemTables) -> Mapping[str, Callable[[], Any]]:
        return {f"figure {next(counter)}": lambda: None}


class Configured(Sizes):
    def __init__(self, colour: str) -> None:
        self.colour = colour


WRONG: Mapping[type[FigurePlugin], tuple[str, str]] = {
    FewValues: ("values", "column 'both' of figure plugin 'examined' has 11 values for the 12 rows of 'cells'"),
    NeedsRows: ("values", "column 'best' of figure plugin 'examined' cannot be computed: IndexError"),
    Taken: ("columns", "column 'n' of figure plugin 'examined' has the name of a column of vibench"),
    Counts: ("determinism", "a second call gives column 'call' other values: "),
    Writes: ("figures", "membrane: drawing changes tables.cells; work on a copy"),
    Fails: ("figures", "figure 'ratio' of figure plugin 'examined' cannot be drawn: ZeroDivisionError"),
    Lists: ("drawings", "figure plugin 'examined' returned list, expected functions by their names"),
    Restless: ("determinism", "membrane: another instance has the figures figure-"),
    Configured: ("construction", "TypeError: "),
}


@pytest.mark.parametrize("plugin", WRONG)
def test_a_fault_is_found_by_its_check_alone(plugin: type[FigurePlugin]) -> None:
    check, words = WRONG[plugin]
    found = failures(testing.examine_figure(plugin))
    assert list(found) == [check]
    assert words in found[check]


def test_what_is_right_passes_on_a_real_run_too(quick_run: Path) -> None:
    testing.check_figure(Sizes)
    found = testing.examine_figure(Sizes, quick_run)
    assert failures(found) == {}
    assert "obstacle: 2 figures" in found[1].message


COLUMNS = """
from vibench import DerivedColumn, FigurePlugin

class Both(FigurePlugin):
    '''N + R.'''
    def columns(self):
        return (DerivedColumn("both", "N + R.", lambda found: found.cells["N"] + found.cells["R"]),)
"""


def test_the_command_checks_on_a_run(main: Main, quick_run: Path) -> None:
    code, out, err = main("check", "figure:niakh-2022")
    assert (code, err) == (0, "")
    assert "warning  something to show: neither figures nor columns of the made-up run" in out
    refused(main("check", "figure:niakh-2022", "--run", "nowhere"), "no results in 'nowhere'")
    Path("lying_columns.py").write_text(COLUMNS)
    code, out, _ = main("check", "lying_columns:Both", "--run", str(quick_run))
    assert code == 0
    assert "passed   columns: both of cells" in out


def test_the_made_up_run_is_one_that_vibench_reads_and_draws(tmp_path: Path) -> None:
    path = write_sample_run(tmp_path / "run")
    assert {name for name in TABLES if read_table(path, name).empty} == {"disagreements"}
    cells = read_table(path, "cells")
    assert list(cells["status"]).count("crashed") == 1
    filled = cells[cells["status"] == "ok"].drop(columns=["pod_size", "dual_size", "primal_tol"])
    assert set(filled.columns[filled.isna().any()]) == {"bound_online_violations"}
    again = write_sample_run(tmp_path / "again")
    for name in TABLES:
        pd.testing.assert_frame_equal(read_table(path, name), read_table(again, name))
    figures = [(name, draw, figure) for name, draw, data in drawings(path) for figure in draw(data)]
    drawn = {draw for _, draw, _ in figures}
    missing = {kind for kind, draw in (OF_PROBLEM | OF_DUAL).items() if draw not in drawn}
    assert missing <= {"solutions", "diagnostics", "shares", "solvers", "precision", "break-even"}
    shown = [(name, axes) for name, _, figure in figures for axes in figure.axes if axes.axison]
    assert [name for name, axes in shown if not axes.has_data()] == []
