"""Tables and lines on a terminal, or as plain text elsewhere."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from vibench.results import tables
from vibench.text import printable, printable_lines

WIDTH = 10_000
"""Columns where the output is no terminal and `COLUMNS` is not set: whoever reads it can scroll."""

SHORT = 24
"""A text of more characters may be wrapped, between words if it can."""

LONG = 60
"""Characters of a line of a long text, where there is room."""


def new_console() -> Console:
    """A console for the standard output, which takes no text for markup."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal and not os.environ.get("COLUMNS"):
        console.width = WIDTH
    return console


def print_line(console: Console, line: str) -> None:
    """Print a line that may hold text from others; the terminal wraps it."""
    console.print(Text(printable(line)), soft_wrap=True)


def print_frame(frame: pd.DataFrame, title: str, priority: Sequence[str] = (), *, every: bool = False) -> None:
    """Print a table that fits the width; nothing is cut, and no number is wrapped.

    Columns with the same value in every row go into the title, and empty ones are left out. Where there is not room for
    all others, those of the smallest priority are left out, and a line below names them.

    Parameters
    ----------
    frame
        The table.
    title
        Its title.
    priority
        Columns, those that matter most first; the order of the table by default.
    every
        Print columns with the same value in every row, too, as columns.
    """
    console = new_console()
    shared = [name for name in frame.columns if not every and len(frame) > 1 and _same(frame[name])]
    values = [(name, tables.cell_text(frame[name].iloc[0])) for name in shared]
    title = ", ".join([title, *(f"{name} {value}" for name, value in values if value)])
    console.print(shown(title if len(frame) else f"{title}: no rows"), overflow="fold")
    if frame.empty:
        return
    columns = [_Column.of(frame[name]) for name in frame.columns if name not in shared]
    rank = {name: k for k, name in enumerate(priority)}
    kept = _fitting(sorted(columns, key=lambda column: rank.get(column.heading, len(rank))), console.width)
    drawn = [column for column in columns if column in kept]
    whole = sum(max(column.width, cell_len(column.heading)) + 2 for column in drawn) <= console.width
    # the box has a blank between columns; there is another where there is room
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, int(whole), 0, 0))
    for column in drawn:
        width = max(column.width, cell_len(column.heading)) if whole else column.width
        limits = {"min_width": width, "max_width": LONG} if column.long else {"width": width}
        justify = "right" if column.numeric else "left"
        table.add_column(shown(column.heading), justify=justify, overflow="fold", **limits)  # type: ignore[arg-type]
    for row in zip(*(column.cells for column in drawn), strict=True):
        table.add_row(*map(shown, row))
    console.print(table)
    if left_out := [column.heading for column in columns if column not in kept]:
        text = f"not shown at {console.width} columns: {', '.join(left_out)} (`vibench show --columns`)"
        console.print(shown(text), overflow="fold")


@dataclass(frozen=True, eq=False)
class _Column:
    """A column of a printed table: its texts, and the characters it needs; a long text may have lines of its own."""

    heading: str
    cells: tuple[str, ...]
    numeric: bool

    @classmethod
    def of(cls, column: pd.Series) -> _Column:
        cells = tuple(printable_lines(tables.cell_text(value)) for value in column)
        return cls(str(column.name), cells, pd.api.types.is_numeric_dtype(column))

    @property
    def long(self) -> bool:
        return self._longest > SHORT

    @property
    def width(self) -> int:
        """Characters that it needs at least: whole texts where they are short, of long ones whole words."""
        words = [*self.heading.split(), *(word for cell in self.cells for word in cell.split() if self.long)]
        return max([min(cell_len(word), SHORT) for word in words] + [1 if self.long else self._longest])

    @property
    def _longest(self) -> int:
        return max((cell_len(line) for cell in self.cells for line in cell.split("\n")), default=1)


def _fitting(columns: Sequence[_Column], width: int) -> list[_Column]:
    """Those columns, the first at least, that find room one after the other."""
    kept: list[_Column] = []
    left = width
    for column in columns:
        if not kept or column.width + 1 <= left:
            kept.append(column)
            left -= column.width + 1
    return kept


def shown(text: str) -> Text:
    """A text of some lines in a table, without markup and without what is not printable."""
    return Text(printable_lines(text))


def _same(column: pd.Series) -> bool:
    return bool(column.nunique(dropna=False) == 1)
