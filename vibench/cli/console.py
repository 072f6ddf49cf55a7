"""Tables and lines on a terminal, or as plain text elsewhere."""

from __future__ import annotations

import shlex
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TextIO

import typer

from vibench.text import new_console, printable, printable_lines

# help texts are printed without these, and lists of plugins without pandas
if TYPE_CHECKING:
    import pandas as pd
    from rich.text import Text


def echo(*lines: str) -> None:
    """Print lines; what is not printable in them, such as an escape sequence or a line break, is shown as an escape."""
    if lines:
        typer.echo("\n".join(fitted(printable(line), sys.stdout) for line in lines))


def warn(*lines: str) -> None:
    """Print lines on standard error, each as those of errors begin: what is printed may go into a file."""
    for line in lines:
        sys.stderr.write(f"{fitted(f'vibench: {printable(line)}', sys.stderr)}\n")


def fitted(line: str, stream: TextIO) -> str:
    """A line, wrapped between words on a terminal."""
    # Elsewhere a program may read it, and an indented line holds a command that somebody may copy: both stay whole.
    width = shutil.get_terminal_size().columns
    if len(line) <= width or line.startswith(" ") or not stream.isatty():
        return line
    return textwrap.fill(line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def run_argument(folder: Path) -> str:
    """The name of a run folder on a command line."""
    return shlex.quote(folder.name if folder == Path("runs") / folder.name else str(folder))


def print_frame(
    table: pd.DataFrame | list[PrintedColumn],
    title: str,
    priority: Sequence[str] = (),
    *,
    axes: Collection[str] = (),
    every: bool = False,
    rest: str = "",
) -> None:
    """Print a table that fits the width; nothing is cut, and no number is wrapped.

    Text columns with the same value in every row go into the title, unless `every` column is printed. Where there is
    not room for all others, those that come last in `priority` are left out; a line below names them, and the command
    that prints the `rest`. The `axes`, which tell rows apart and come first in `priority`, are never left out: where
    they would take the room of the first three other columns, they become one column of several lines.
    """
    from rich import box
    from rich.table import Table

    # Rich is imported only where a table is printed: help and completion do without.
    if isinstance(table, list):
        columns = table
    else:
        from vibench.results.formats import cell_text

        texts = ((str(name), tuple(map(cell_text, table[name])), table[name].dtype) for name in table.columns)
        columns = [PrintedColumn(name, cells, dtype.kind in "iufb") for name, cells, dtype in texts]
    console = new_console()
    count = len(columns[0].cells) if columns else 0
    # A single row would have all of its columns in the title; there only the axes go into it.
    titled = [column for column in columns if not every and (count > 1 or column.heading in axes)]
    alike = [column for column in titled if len(set(column.cells)) == 1]
    shared = [column for column in alike if not column.numeric or column.heading in axes or not column.cells[0]]
    values = [f"{column.heading} {column.cells[0]}" for column in shared if column.cells[0]]
    title = ", ".join([title, *values])
    console.print(shown(title if count else f"{title}: no rows"), overflow="fold")
    if not count:
        return
    own, kept = _arranged([column for column in columns if column not in shared], priority, axes, console.width)
    drawn = [column for column in own if column in kept]
    # Headings are wrapped between words only if the table is too wide with whole ones.
    whole = sum(max(column.width, cell_len(column.heading)) + 2 for column in drawn) <= console.width + 2
    # The box has a blank between columns; where there is room, a second one makes the table easier to read.
    printed = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, int(whole), 0, 0))
    for column, width in zip(drawn, _widths(drawn, console.width, whole), strict=True):
        justify: Literal["left", "right"] = "right" if column.numeric else "left"
        printed.add_column(shown(column.heading), justify=justify, overflow="fold", width=width)
    for row in zip(*(column.cells for column in drawn), strict=True):
        printed.add_row(*map(shown, row))
    console.print(printed)
    if left_out := [column.heading for column in own if column not in kept]:
        text = f"not shown at {console.width} columns: {', '.join(left_out)}" + f" (`{rest}`)" * bool(rest)
        console.print(shown(text), overflow="fold")


def print_rows(rows: Iterable[Sequence[str]], headings: Sequence[str], title: str) -> None:
    """Print rows of texts as `print_frame` prints a table."""
    cells = list(zip(*rows, strict=True)) or [()] * len(headings)
    print_frame([PrintedColumn(heading, column) for heading, column in zip(headings, cells, strict=True)], title)


@dataclass(frozen=True)
class PrintedColumn:
    """A column of a printed table: its heading and texts; texts of more than 24 characters may be wrapped."""

    heading: str
    cells: tuple[str, ...]
    numeric: bool = False

    @cached_property
    def longest(self) -> int:
        """Characters of its longest line."""
        lines = (line for cell in map(printable_lines, self.cells) for line in cell.split("\n"))
        return max(map(cell_len, lines), default=1)

    @cached_property
    def width(self) -> int:
        """Fewest characters that it needs: whole texts where they are short, whole words of long ones."""
        long = self.longest > 24
        words = [word for cell in self.cells if long for word in printable_lines(cell).split()]
        # Words of more than 24 characters are folded, or one path would take the room of all other columns.
        widths = [min(cell_len(word), 24) for word in (*self.heading.split(), *words)]
        return max([*widths, 1 if long else self.longest])


def _arranged(
    own: list[PrintedColumn], priority: Sequence[str], axes: Collection[str], width: int
) -> tuple[list[PrintedColumn], list[PrintedColumn]]:
    """The columns in their order, those that tell rows apart as one where they need more room, and those that fit."""
    rank = {name: k for k, name in enumerate(priority)}
    ranked = sorted(own, key=lambda column: rank.get(column.heading, len(rank)))
    telling, others = ([c for c in ranked if (c.heading in axes) is told] for told in (True, False))
    kept = _fitting(ranked, width)
    if len(telling) < 2 or set(telling + others[:3]) <= set(kept):
        return own, kept
    # One column joins the axes of every row, and may be wrapped between two of them.
    in_order = [column for column in own if column in telling]
    named = [[f"{one.heading}={cell}" * bool(cell) if one.numeric else cell for cell in one.cells] for one in in_order]
    joined = tuple(" · ".join(text for text in row if text) for row in zip(*named, strict=True))
    together, first = PrintedColumn("row", joined), own.index(in_order[0])
    arranged = [*own[:first], together, *own[first:]]
    return [column for column in arranged if column not in telling], _fitting([together, *others], width)


def _fitting(columns: Sequence[PrintedColumn], width: int) -> list[PrintedColumn]:
    """The columns that fit a width one after the other, the first in any case."""
    kept: list[PrintedColumn] = []
    # No blank follows the last column.
    left = width + 1
    for column in columns:
        if not kept or column.width + 1 <= left:
            kept.append(column)
            left -= column.width + 1
    return kept


def _widths(columns: Sequence[PrintedColumn], width: int, whole: bool) -> list[int]:
    """Characters of every column: its need, and for long texts an equal part of the rest, up to lines of 60."""
    widths = [max(column.width, cell_len(column.heading)) if whole else column.width for column in columns]
    spare = width - sum(widths) - (1 + whole) * (len(widths) - 1)
    long = sorted((min(column.longest, 60) - widths[k], k) for k, column in enumerate(columns) if column.longest > 24)
    # The column with the smallest wish comes first, so that the others share what it leaves.
    for left, (wanted, k) in zip(range(len(long), 0, -1), long, strict=True):
        more = max(0, min(wanted, spare // left))
        widths[k], spare = widths[k] + more, spare - more
    return widths


def shown(text: str) -> Text:
    """A text of some lines in a table, without markup and without characters that are not printable."""
    from rich.text import Text

    return Text(printable_lines(text))


def cell_len(text: str) -> int:
    """Columns of a terminal that a text takes."""
    from rich import cells

    return cells.cell_len(text)
