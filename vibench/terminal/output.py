"""What commands print: text from others in it is data."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import typer

from vibench.text import printable


def echo(*lines: str) -> None:
    """Print lines; what is not printable in them, such as an escape sequence or a line break, is shown as an escape."""
    if lines:
        typer.echo("\n".join(map(printable, lines)))


def warn(*lines: str) -> None:
    """Print lines on standard error, each as those of errors begin: what is printed may go into a file."""
    for line in lines:
        sys.stderr.write(f"vibench: {printable(line)}\n")


def run_argument(folder: Path) -> str:
    """How a command names a run folder."""
    return shlex.quote(folder.name if folder == Path("runs") / folder.name else str(folder))
