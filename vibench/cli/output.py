"""What commands print: text from others in it is data."""

from __future__ import annotations

import typer

from vibench.text import printable


def echo(*lines: str) -> None:
    """Print lines; what is not printable in them, such as an escape sequence or a line break, is shown as an escape."""
    typer.echo("\n".join(map(printable, lines)))
