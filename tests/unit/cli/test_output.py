"""What is printed: text from others acts neither on the terminal nor on the tables, and lines stay lines."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from vibench.cli.console import echo, print_frame
from vibench.text import new_console, print_line

ANYTHING = st.text(st.characters())

MARKUP = ["[/b]", "[red]membrane[/red]", ":warning:", "[link=file:///]a[/link]", "[bold", r"\[x]", "`a` *b* <c>"]


def printed(action: Callable[[], object]) -> list[str]:
    """The lines that an action prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        action()
    return out.getvalue().split("\n")


@given(ANYTHING, ANYTHING)
def test_every_line_is_one_printable_line(one: str, other: str) -> None:
    lines = printed(lambda: echo(one, other))
    assert len(lines) == 3
    assert all(line.isprintable() for line in lines)


@given(ANYTHING)
def test_a_line_on_a_console_is_one_printable_line(text: str) -> None:
    lines = printed(lambda: print_line(new_console(), text))
    assert len(lines) == 2
    assert lines[0].isprintable()


@given(ANYTHING)
def test_a_table_is_printable(text: str) -> None:
    frame = pd.DataFrame({"name": [text, "b"], "same": text, text: [1.0, None]})
    assert all(line.isprintable() for line in printed(lambda: print_frame(frame, text)))


@pytest.mark.parametrize("text", MARKUP)
def test_markup_is_text(text: str) -> None:
    assert printed(lambda: echo(text)) == [text, ""]
    assert printed(lambda: print_line(new_console(), text)) == [text, ""]
    assert printed(lambda: new_console().print(text)) == [text, ""]
    whole = "\n".join(printed(lambda: print_frame(pd.DataFrame({"name": [text, "b"], text: ["x", "y"]}), text)))
    assert whole.count(text) == 3


@pytest.mark.parametrize("text", MARKUP)
def test_markup_is_text_on_a_terminal_of_any_kind(text: str) -> None:
    out = io.StringIO()
    print_line(Console(file=out, force_terminal=True, width=20), text)
    assert out.getvalue() == f"{text}\n"


def test_cells_of_several_lines_keep_them() -> None:
    lines = printed(lambda: print_frame(pd.DataFrame({"options": ["one: int\ntwo: \x1b[2J", "b"]}), "plugins"))
    assert [line.strip() for line in lines if ":" in line] == ["one: int", r"two: \u001b[2J"]
