"""Tables and lines on a terminal, or as plain text elsewhere."""

from __future__ import annotations

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vibench.results import tables
from vibench.text import printable, printable_lines

WIDTH = 180
"""Columns of a table where the output is no terminal."""


def new_console() -> Console:
    """A console for the standard output, which takes no text for markup."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = WIDTH
    return console


def print_line(console: Console, line: str) -> None:
    """Print a line that may hold text from others; the terminal wraps it."""
    console.print(Text(printable(line)), soft_wrap=True)


def print_frame(frame: pd.DataFrame, title: str) -> None:
    """Print a table without truncated cells; text columns with the same value in every row go into the title."""
    console = new_console()
    shared = [name for name in frame.columns if len(frame) > 1 and _same_text(frame[name])]
    title = ", ".join([title, *(f"{name} {tables.cell_text(frame[name].iloc[0])}" for name in shared)])
    table = Table(title=shown(title), title_justify="left", pad_edge=False, padding=(0, 1, 0, 0), box=box.SIMPLE_HEAD)
    kept = frame.drop(columns=shared)
    rows = [[shown(tables.cell_text(value)) for value in row] for row in kept.itertuples(index=False)]
    for k, name in enumerate(kept.columns):
        widest = max((len(word) for row in rows for word in row[k].plain.split()), default=1)
        numeric = pd.api.types.is_numeric_dtype(kept[name])
        table.add_column(shown(str(name)), justify="right" if numeric else "left", min_width=min(widest, 24))
    for row in rows:
        table.add_row(*row)
    # On a narrow terminal, lines wider than the window that wrap are better than cells cut off by rich.
    natural = console.measure(table, options=console.options.update(width=10 * WIDTH)).maximum
    console.width = max(console.width, min(natural, WIDTH))
    console.print(table)


def shown(text: str) -> Text:
    """A text of some lines in a table, without markup and without what is not printable."""
    return Text(printable_lines(text))


def _same_text(column: pd.Series) -> bool:
    return not pd.api.types.is_numeric_dtype(column) and column.nunique(dropna=False) == 1
