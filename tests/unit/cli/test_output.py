"""What is printed: text from others acts neither on the terminal nor on the tables, and lines stay lines."""

import contextlib
import io
from collections.abc import Callable

import pandas as pd
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from vibench.cli.console import echo, print_frame
from vibench.text import new_console, print_line

ANYTHING = st.text(st.characters())


def printed(action: Callable[[], object]) -> list[str]:
    """The lines that an action prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        action()
    return out.getvalue().split("\n")


@given(ANYTHING, ANYTHING, ANYTHING)
def test_every_line_and_every_table_is_printable(one: str, other: str, text: str) -> None:
    for lines, count in ((printed(lambda: echo(one, other)), 3), (printed(lambda: print_line(new_console(), one)), 2)):
        assert len(lines) == count
        assert all(line.isprintable() for line in lines)
    frame = pd.DataFrame({"name": [text, "b"], "same": text, text: [1.0, None]})
    assert all(line.isprintable() for line in printed(lambda: print_frame(frame, text)))


def test_markup_is_text_and_lines_of_cells_stay_apart() -> None:
    markup = ("[/b]", "[red]membrane[/red]", ":warning:", "[link=file:///]a[/link]", "[bold", r"\[x]", "`a` *b* <c>")
    for text in markup:
        assert printed(lambda: echo(text)) == [text, ""]  # noqa: B023
        assert printed(lambda: print_line(new_console(), text)) == [text, ""]  # noqa: B023
        assert printed(lambda: new_console().print(text)) == [text, ""]  # noqa: B023
        frame = pd.DataFrame({"name": [text, "b"], text: ["x", "y"]})
        assert "\n".join(printed(lambda: print_frame(frame, text))).count(text) == 3  # noqa: B023
        out = io.StringIO()  # a terminal of any kind
        print_line(Console(file=out, force_terminal=True, width=20), text)
        assert out.getvalue() == f"{text}\n"
    lines = printed(lambda: print_frame(pd.DataFrame({"options": ["one: int\ntwo: \x1b[2J", "b"]}), "plugins"))
    assert [line.strip() for line in lines if ":" in line] == ["one: int", r"two: \u001b[2J"]
