"""Tables fit the terminal: nothing is cut, no number is wrapped, and what is left out is named."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from running import Main

from vibench.cli.completion import SHOWN
from vibench.cli.console import new_console, print_frame
from vibench.results import formats, show
from vibench.results.read import read_table, results_file
from vibench.results.schema import STORED

WIDTHS = (80, 120, 200)


def printed(frame: pd.DataFrame, width: int, priority: list[str] | None = None, axes: Sequence[str] = ()) -> list[str]:
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as out:
        patch.setenv("COLUMNS", str(width))
        print_frame(frame, "table", priority or [], axes=axes)
    return out.getvalue().splitlines()


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("table", SHOWN)
def test_every_table_of_a_run_fits(
    table: str, width: int, main: Main, quick_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every printed word with a digit in it is a whole word of the table: none is cut, and none is wrapped."""
    monkeypatch.setenv("COLUMNS", str(width))
    code, out, _ = main("show", str(quick_run), "--table", table, "--limit", "60")
    assert code == 0
    assert max(map(cell_len, out.splitlines())) <= width
    assert "…" not in out
    found = show.look_up(results_file(str(quick_run)), table, limit=60)
    frame = found.readable
    texts = [*map(str, frame.columns), *(formats.cell_text(value) for name in frame for value in frame[name])]
    whole = {word for text in texts for word in text.split()} | {f"{width}"}
    whole |= {f"{axis}={formats.cell_text(value)}" for axis in found.axes & set(frame) for value in frame[axis]}
    shown = out.split("\n", 1)[1].split("not shown")[0].replace(",", " ")
    words = {word for word in shown.split() if re.search(r"\d", word)}
    assert words - {word.strip(",") for word in whole} - {part for word in whole for part in word.split(",")} == set()
    assert len(words) > 3


numbers = st.floats(1e-12, 1e12, allow_nan=False)
frames = st.lists(st.tuples(numbers, numbers, numbers, st.sampled_from(["decorrelated", "offline-pga"])), min_size=2)


@given(frames, st.integers(24, 90))
def test_what_has_no_room_is_left_out_whole_and_named(rows: list[tuple[float, float, float, str]], width: int) -> None:
    frame = pd.DataFrame(rows, columns=["first", "second", "third", "way"]).assign(k=range(len(rows)))
    lines = printed(frame, width, ["k", "way"])
    assert max(map(cell_len, lines)) <= width
    whole = {formats.cell_text(value) for name in frame for value in frame[name]} | {str(width)}
    title_end = next(k for k, line in enumerate(lines) if set(line.strip()) == {"─"})
    body = [word for line in lines[title_end + 1 :] for word in line.split() if re.search(r"\d", word)]
    assert set(body) <= whole


def test_the_columns_that_matter_least_go_first() -> None:
    frame = pd.DataFrame({name: [1.23456, 2.34567] for name in ("alpha", "bravo", "charlie")})
    lines = printed(frame.assign(bravo=[1, 2], charlie=[3, 4]), 13, ["charlie", "alpha", "bravo"])
    assert lines[1].split() == ["alpha", "charlie"]
    assert "bravo" in " ".join(lines[5:])


ALIKE = pd.DataFrame(
    {
        "cell": ["102e", "58e3", "0905"],
        "problem": ["obstacle with a name", "obstacle with a name", "hertz"],
        "primal": ["online-supremizers", "online-supremizers", "decorrelated"],
        "δ": [0.5, 0.5, None],
        "assembly": ["certified", "certified", "reduced"],
        "correction": ["none", "feasible", "none"],
        "error": [0.00123, 0.00456, 0.5],
        "online [ms]": [1.25, 1.75, 12.5],
        "N": [10, 10, 29],
    }
)
AXES = ["problem", "primal", "δ", "assembly", "correction"]


@pytest.mark.parametrize("width", [56, 66, 80])
def test_what_tells_rows_apart_is_not_left_out_nor_what_the_table_is_about(width: int) -> None:
    """At 80 columns two rows that differ in their corrections alone looked alike, and had no errors."""
    lines = printed(ALIKE, width, [*AXES, "cell", "error", "online [ms]", "N"], AXES)
    assert max(map(cell_len, lines)) <= width
    text = " ".join(lines)
    assert all(name in text for name in ("cell", "error", "online", "102e", "0.00456", "12.5", "feasible", "certified"))
    assert text.count("δ=0.5") == 2
    assert not any(axis in text.split("not shown")[-1] for axis in ("problem", "primal", "correction"))


def test_there_is_one_column_for_every_axis_where_there_is_room() -> None:
    headings = printed(ALIKE, 120, [*AXES, "cell", "error"], AXES)[1].split()
    assert headings == ["cell", *AXES, "error", "online", "[ms]", "N"]


def test_long_texts_share_the_room_that_is_left_and_nothing_is_cut() -> None:
    """Rich takes room from columns that need it, and cuts what is beyond the width."""
    words = " ".join(["alpha", "bravo", "charlie"] * 9)
    frame = pd.DataFrame(
        {"name": ["a" * 33, "b"], "value": [words, "2"], "unit": ["1", "s"], "meaning": [words, f"{words} delta"]}
    )
    lines = printed(frame, 80)
    assert max(map(cell_len, lines)) <= 80
    assert sum(line.count("charlie") for line in lines) == 27


def test_values_that_all_rows_share_stand_in_the_title_unless_asked_for() -> None:
    frame = pd.DataFrame({"solver": ["piqp", "piqp"], "N": [8, 8], "k": [1, 2], "none": [None, None]})
    assert printed(frame, 80)[:2] == ["table, solver piqp", "N  k"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        print_frame(frame, "table", axes=["N"])
    assert out.getvalue().splitlines()[0] == "table, solver piqp, N 8"
    with contextlib.redirect_stdout(io.StringIO()) as out:
        print_frame(frame, "table", every=True)
    assert out.getvalue().splitlines()[1].split() == ["solver", "N", "k", "none"]


def test_the_axes_of_a_single_row_stand_in_the_title_and_its_other_values_do_not() -> None:
    frame = pd.DataFrame({"cell": ["be21"], "solver": ["piqp"], "δ": [None], "N": [8], "ok": ["4/4"]})
    with contextlib.redirect_stdout(io.StringIO()) as out:
        print_frame(frame, "table", axes=["solver", "δ"])
    title, headings, _, row = out.getvalue().splitlines()
    assert (title, headings.split(), row.split()) == ("table, solver piqp", ["cell", "N", "ok"], ["be21", "8", "4/4"])
    title, headings, *_ = printed(frame.drop(columns="δ"), 80)
    assert (title, headings.split()) == ("table", ["cell", "solver", "N", "ok"])


@pytest.mark.parametrize("asked", [("--limit", "1"), ("--table", "best", "--where", "problem = 'obstacle'")])
def test_a_single_row_has_its_errors_and_seconds(
    asked: tuple[str, ...], main: Main, quick_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _, out, _ = main("show", str(quick_run), *asked)
    table = out.split("not shown")[0]
    assert table.count("error") >= 2
    assert all(f"[{unit}]" in table for unit in ("s", "ms"))


@pytest.mark.parametrize("columns", ["0", "-5", "none", "", "²", "9" * 5000])
def test_a_width_that_is_none_is_no_width(columns: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    assert new_console().width == 10_000


def test_a_table_without_rows_says_so() -> None:
    assert printed(pd.DataFrame({"a": []}), 80) == ["table: no rows"]


class TestShow:
    """Rows and columns that are asked for."""

    def test_columns_are_those_asked_for_by_name_or_heading(self, main: Main, quick_run: Path) -> None:
        _, out, _ = main("show", str(quick_run), "--columns", "solver,online [ms],online_s", "--format", "csv")
        assert out.splitlines()[0] == "solver,online_s"
        _, out, _ = main("show", str(quick_run), "--table", "cells", "--columns", "solver,online_s", "--limit", "3")
        assert out.splitlines()[1].split() == ["solver", "online_s"]
        assert len(out.splitlines()) == 1 + 1 + 1 + 3

    def test_rows_are_selected_sorted_and_limited(self, main: Main, quick_run: Path) -> None:
        asked = ("--where", "solver = 'piqp' and N > 0", "--sort", "-error_u_mean", "--limit", "5")
        _, out, _ = main("show", str(quick_run), "--table", "cells", *asked, "--format", "csv")
        found = pd.read_csv(io.StringIO(out))
        cells = read_table(results_file(str(quick_run)), "cells")
        best = cells[cells["solver"] == "piqp"].nlargest(5, "error_u_mean")
        assert list(found["cell"]) == list(best["cell"])

    def test_keys_of_the_summary_are_those_that_replay_takes(self, main: Main, quick_run: Path) -> None:
        _, out, _ = main("show", str(quick_run), "--columns", "cell,solver", "--limit", "3")
        keys = read_table(results_file(str(quick_run)), "cells")["cell"]
        for line in out.splitlines()[3:]:
            assert keys.str.startswith(line.split()[0]).sum() == 1

    @pytest.mark.parametrize("table", SHOWN)
    def test_json_has_numbers_as_numbers(self, table: str, main: Main, quick_run: Path) -> None:
        _, out, _ = main("show", str(quick_run), "--table", table, "--format", "json", "--limit", "20")
        found = pd.read_json(io.StringIO(out))
        source = read_table(results_file(str(quick_run)), show.VIEWS[table].source)
        for name in found.columns.intersection(source.columns):
            if source[name].dtype.kind in "if" and found[name].notna().any():
                assert found[name].dtype.kind in "if", name

    def test_a_condition_on_what_is_made_of_the_rows_it_selects_is_refused(self, main: Main, quick_run: Path) -> None:
        code, out, err = main("show", str(quick_run), "--table", "best", "--where", "error_below < 0.1")
        assert (code, out) == (2, "")
        assert err == (
            "vibench: --where selects rows of cells, of which the table is made; "
            "'error_below' is a column of the table alone, for --columns and --sort\n"
        )

    def test_a_cell_has_all_of_its_columns_with_units_and_meanings(
        self, main: Main, quick_run: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("COLUMNS", "200")
        cells = read_table(results_file(str(quick_run)), "cells")
        row = cells.iloc[3]
        code, out, _ = main("show", str(quick_run), row["cell"][:6])
        body, empty = out.split("\nempty: ")
        assert code == 0
        assert out.splitlines()[0] == f"cell {row['cell']} of {quick_run.name}"
        (line,) = (line for line in body.splitlines() if line.startswith("online_s "))
        assert line.split(None, 3)[1:3] == [f"{row['online_s']:.3g}", "s"]
        assert line.split(None, 3)[3].startswith("One query with assembly")
        named = {line.split()[0] for line in body.splitlines()[3:] if not line.startswith(" ")}
        assert named | {name.strip() for name in empty.split(",")} == set(STORED["cells"])
        _, out, _ = main("show", str(quick_run), row["cell"], "--table", "queries", "--format", "csv")
        assert set(pd.read_csv(io.StringIO(out))["cell"]) == {row["cell"]}
        code, out, err = main("show", str(quick_run), "x")
        assert (code, out) == (2, "")
        assert err.startswith("vibench: 0 cells of ")
        assert "begin with 'x', expected one" in err

    def test_a_cell_is_not_ignored_where_a_table_or_a_condition_has_none_of_its_rows(
        self, main: Main, quick_run: Path
    ) -> None:
        cell = read_table(results_file(str(quick_run)), "cells")["cell"][0]
        assert main("show", str(quick_run), cell, "--where", "N > 1000")[:2] == (
            0,
            f"{quick_run.name}: summary: no rows\n",
        )
        code, out, err = main("show", str(quick_run), cell, "--table", "benefits")
        assert (code, out) == (2, "")
        assert "the table benefits has no rows of one cell; expected summary, best, cells, queries" in err

    def test_a_wrong_column_is_refused(self, main: Main, quick_run: Path) -> None:
        for option in ("--columns", "--sort"):
            code, out, err = main("show", str(quick_run), option, "solvr")
            assert (code, out) == (2, "")
            assert "did you mean 'solver'" in err
