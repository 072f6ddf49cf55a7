import contextlib
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console
from running import Main, refused, succeeded

from vibench.cli.console import echo, new_console, print_frame
from vibench.results import formats, show
from vibench.results.read import read_table, results_file
from vibench.results.schema import STORED
from vibench.text import print_line


def printed(frame: pd.DataFrame, width: int, priority: Sequence[str] = (), **more: Any) -> list[str]:
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as out:
        patch.setenv("COLUMNS", str(width))
        print_frame(frame, "table", priority, **more)
    return out.getvalue().splitlines()


@pytest.mark.parametrize("table", show.VIEWS)
def test_every_table_of_a_run_fits(table: str, main: Main, quick_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every printed word with a digit in it is a whole word of the table: none is cut, and none is wrapped."""
    found = show.look_up(results_file(str(quick_run)), table, limit=60)
    frame = found.readable
    texts = [*map(str, frame.columns), *(formats.cell_text(value) for name in frame for value in frame[name])]
    whole = {word for text in texts for word in text.split()}
    whole |= {f"{axis}={formats.cell_text(value)}" for axis in found.axes & set(frame) for value in frame[axis]}
    whole |= {part for word in whole for part in word.split(",")}
    for width in (80, 120, 200):
        monkeypatch.setenv("COLUMNS", str(width))
        out = succeeded(main("show", str(quick_run), "--table", table, "--limit", "60"))
        assert out.startswith(f"{quick_run.name}: {table}")
        assert max(map(cell_len, out.splitlines())) <= width
        assert "…" not in out
        shown = out.split("\n", 1)[1].split("not shown")[0].replace(",", " ")
        words = {word for word in shown.split() if re.search(r"\d", word)}
        assert words - whole - {str(width)} == set()
        assert len(words) > 3 or table == "calibrations"  # which no task of `quick` makes


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


def test_rows_share_the_room_and_titles_have_what_they_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rich takes room from columns that need it, and cuts what is beyond the width."""
    frame = pd.DataFrame({name: [1.23456, 2.34567] for name in ("alpha", "bravo", "charlie")})
    lines = printed(frame.assign(bravo=[1, 2], charlie=[3, 4]), 13, ["charlie", "alpha", "bravo"])
    assert lines[1].split() == ["alpha", "charlie"]
    short = frame[["alpha", "bravo"]].set_axis(["a", "b"], axis=1)  # which two columns of four characters fill
    assert [printed(short, width)[1].split() for width in (8, 9)] == [["a"], ["a", "b"]]
    assert "bravo" in " ".join(lines[5:])
    words = " ".join(["alpha", "bravo", "charlie"] * 9)
    frame = pd.DataFrame({"name": ["a" * 33, "b"], "value": [words, "2"], "unit": ["1", "s"]})
    frame["meaning"] = [words, f"{words} delta"]
    lines = printed(frame, 80)
    assert max(map(cell_len, lines)) <= 80
    assert sum(line.count("charlie") for line in lines) == 27
    frame = pd.DataFrame({"solver": ["piqp", "piqp"], "N": [8, 8], "k": [1, 2], "none": [None, None]})
    assert printed(frame, 80)[:2] == ["table, solver piqp", "N  k"]
    assert printed(frame, 80, axes=["N"])[0] == "table, solver piqp, N 8"
    assert printed(frame, 80, every=True)[1].split() == ["solver", "N", "k", "none"]
    assert printed(pd.DataFrame({"a": []}), 80) == ["table: no rows"]
    frame = pd.DataFrame({"cell": ["be21"], "solver": ["piqp"], "δ": [None], "N": [8], "ok": ["4/4"]})
    title, headings, _, row = printed(frame, 80, axes=["solver", "δ"])
    assert (title, headings.split(), row.split()) == ("table, solver piqp", ["cell", "N", "ok"], ["be21", "8", "4/4"])
    title, headings, *_ = printed(frame.drop(columns="δ"), 80)
    assert (title, headings.split()) == ("table", ["cell", "solver", "N", "ok"])
    for columns in ("0", "-5", "none", "", "²", "9" * 5000):
        monkeypatch.setenv("COLUMNS", columns)
        assert new_console().width == 10_000


ALIKE = pd.DataFrame({
    "cell": ["102e", "58e3", "0905"], "problem": ["obstacle with a name", "obstacle with a name", "hertz"],
    "primal": ["online-supremizers", "online-supremizers", "decorrelated"], "δ": [0.5, 0.5, None],
    "assembly": ["certified", "certified", "reduced"], "correction": ["none", "feasible", "none"],
    "error": [0.00123, 0.00456, 0.5], "online [ms]": [1.25, 1.75, 12.5], "N": [10, 10, 29],
})  # fmt: skip
AXES = ["problem", "primal", "δ", "assembly", "correction"]


@pytest.mark.parametrize("width", [56, 66, 80])
def test_what_tells_rows_apart_is_not_left_out_nor_what_the_table_is_about(width: int) -> None:
    """At 80 columns two rows that differ in their corrections alone looked alike, and had no errors."""
    lines = printed(ALIKE, width, [*AXES, "cell", "error", "online [ms]", "N"], axes=AXES)
    assert max(map(cell_len, lines)) <= width
    text = " ".join(lines)
    assert all(name in text for name in ("cell", "error", "online", "102e", "0.00456", "12.5", "feasible", "certified"))
    assert text.count("δ=0.5") == 2
    assert not any(axis in text.split("not shown")[-1] for axis in ("problem", "primal", "correction"))
    headings = printed(ALIKE, 120, [*AXES, "cell", "error"], axes=AXES)[1].split()
    assert headings == ["cell", *AXES, "error", "online", "[ms]", "N"]  # one column for every axis where there is room


def test_columns_and_rows_are_those_asked_for(main: Main, quick_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, cells = str(quick_run), read_table(results_file(str(quick_run)), "cells")
    _, out, _ = main("show", run, "--columns", "solver,online [ms],online_s", "--format", "csv")
    assert out.splitlines()[0] == "solver,online_s"  # by name or heading
    _, out, _ = main("show", run, "--table", "cells", "--columns", "solver,online_s", "--limit", "3")
    assert out.splitlines()[1].split() == ["solver", "online_s"]
    assert len(out.splitlines()) == 1 + 1 + 1 + 3
    asked = ("--where", "solver = 'piqp' and N > 0", "--sort", "-error_u_mean", "--limit", "5")
    _, out, _ = main("show", run, "--table", "cells", *asked, "--format", "csv")
    best = cells[cells["solver"] == "piqp"].nlargest(5, "error_u_mean")
    assert list(pd.read_csv(io.StringIO(out))["cell"]) == list(best["cell"])
    _, out, _ = main("show", run, "--columns", "cell,solver", "--limit", "3")
    for line in out.splitlines()[3:]:  # keys that replay takes
        assert cells["cell"].str.startswith(line.split()[0]).sum() == 1
    for table in show.VIEWS:
        _, out, _ = main("show", str(quick_run), "--table", table, "--format", "json", "--limit", "20")
        found = pd.read_json(io.StringIO(out))
        source = read_table(results_file(str(quick_run)), show.VIEWS[table].source)
        for name in found.columns.intersection(source.columns):
            if source[name].dtype.kind in "if" and found[name].notna().any():
                assert found[name].dtype.kind in "if", (table, name)
    monkeypatch.setenv("COLUMNS", "80")
    for asked in (("--limit", "1"), ("--table", "best", "--where", "problem = 'obstacle'")):
        table = main("show", str(quick_run), *asked)[1].split("not shown")[0]
        assert table.count("error") >= 2
        assert all(f"[{unit}]" in table for unit in ("s", "ms"))


def test_a_cell_has_all_columns_or_is_refused(main: Main, quick_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    row = read_table(results_file(str(quick_run)), "cells").iloc[3]
    out = succeeded(main("show", str(quick_run), row["cell"][:6]))
    body, empty = out.split("\nempty: ")
    assert out.splitlines()[0] == f"cell {row['cell']} of {quick_run.name}"
    (line,) = (line for line in body.splitlines() if line.startswith("online_s "))
    assert line.split(None, 3)[1:3] == [f"{row['online_s']:.3g}", "s"]
    assert line.split(None, 3)[3].startswith("One query with assembly")
    named = {line.split()[0] for line in body.splitlines()[3:] if not line.startswith(" ")}
    assert named | {name.strip() for name in empty.split(",")} == set(STORED["cells"])
    _, out, _ = main("show", str(quick_run), row["cell"], "--table", "queries", "--format", "csv")
    assert set(pd.read_csv(io.StringIO(out))["cell"]) == {row["cell"]}
    # a cell is not ignored where a condition has none of its rows
    no_rows = f"{quick_run.name}: summary: no rows\n"
    assert main("show", str(quick_run), row["cell"], "--where", "N > 1000")[:2] == (0, no_rows)
    cell = read_table(results_file(str(quick_run)), "cells")["cell"][0]
    of_rows = "--where selects rows of cells, of which the table is made; 'error_below' is a column of the table alone"
    without = "the table benefits has no rows of one cell; expected summary, best, cells, queries"
    for asked, *words in (
        (["x"], "0 cells of ", "begin with 'x', expected one"),
        (["--table", "best", "--where", "error_below < 0.1"], f"{of_rows}, for --columns and --sort"),
        ([cell, "--table", "benefits"], without),
        (["--columns", "solvr"], "did you mean 'solver'"),
        (["--sort", "solvr"], "did you mean 'solver'"),
    ):
        refused(main("show", str(quick_run), *asked), *words)


def lines_of(action: Callable[[], object]) -> list[str]:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        action()
    return out.getvalue().split("\n")


@given(*[st.text(st.characters())] * 3)
def test_every_line_and_every_table_is_printable(one: str, other: str, text: str) -> None:
    for lines, count in (
        (lines_of(lambda: echo(one, other)), 3),
        (lines_of(lambda: print_line(new_console(), one)), 2),
    ):
        assert len(lines) == count
        assert all(line.isprintable() for line in lines)
    frame = pd.DataFrame({"name": [text, "b"], "same": text, text: [1.0, None]})
    assert all(line.isprintable() for line in lines_of(lambda: print_frame(frame, text)))


def test_markup_is_text_and_lines_of_cells_stay_apart() -> None:
    markup = ("[/b]", "[red]membrane[/red]", ":warning:", "[link=file:///]a[/link]", "[bold", r"\[x]", "`a` *b* <c>")
    for text in markup:
        assert lines_of(lambda: echo(text)) == [text, ""]  # noqa: B023
        assert lines_of(lambda: print_line(new_console(), text)) == [text, ""]  # noqa: B023
        assert lines_of(lambda: new_console().print(text)) == [text, ""]  # noqa: B023
        frame = pd.DataFrame({"name": [text, "b"], text: ["x", "y"]})
        assert "\n".join(lines_of(lambda: print_frame(frame, text))).count(text) == 3  # noqa: B023
        out = io.StringIO()  # a terminal of any kind
        print_line(Console(file=out, force_terminal=True, width=20), text)
        assert out.getvalue() == f"{text}\n"
    lines = lines_of(lambda: print_frame(pd.DataFrame({"options": ["one: int\ntwo: \x1b[2J", "b"]}), "plugins"))
    assert [line.strip() for line in lines if ":" in line] == ["one: int", r"two: \u001b[2J"]
