"""Text from others, made harmless: control characters and markup of plugins and files have no effect where shown."""

from __future__ import annotations

import json
import os
import re
import unicodedata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

# Longest message or status, in characters.
LONGEST = 2000


def parsed_json(text: str | bytes) -> Any:
    """The value of an untrusted JSON text; raises a `ValueError` if it is no JSON, or nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def json_object(text: object) -> dict[str, Any] | None:
    """The object of an untrusted JSON text; `None` where it is not the text of an object."""
    try:
        value = parsed_json(text) if isinstance(text, str) else None
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def printable(text: str) -> str:
    r"""A text with JSON escapes, such as ``\u001b``, ``\n``, ``\ud800``, in place of unprintable characters."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else json.dumps(c)[1:-1] for c in text)


def printable_lines(text: str) -> str:
    """A text of several lines, each of them `printable`."""
    return "\n".join(map(printable, text.split("\n")))


def unbroken(text: str) -> str:
    """A `printable` text with blanks in place of line breaks and tabs."""
    return printable(" ".join(text.split()))


def brief(text: str, longest: int = LONGEST) -> str:
    """A `printable` text of at most `longest` characters; one that was cut ends with its former length."""
    return _cut(printable(text[:longest]), len(text), longest)


def shown(value: object) -> str:
    """A value in a line of bounded length, whatever its own representation does."""
    try:
        return f"the class {value.__qualname__}" if isinstance(value, type) else brief(repr(value), 80)
    except Exception:  # noqa: BLE001  `__repr__` of a stranger may raise anything
        return f"{'an' if (name := type(value).__name__)[0] in 'aeiouAEIO' else 'a'} {name}"


def one_line(text: str) -> str:
    """An `unbroken` text of at most `LONGEST` characters, cut as a `brief` one."""
    return _cut(unbroken(text[:LONGEST]), len(text), LONGEST)


def above(value: float, limit: float) -> str:
    """A number above a limit with enough digits to distinguish them, such as "3.1e-07 above 1e-07"."""
    digits = next((n for n in range(1, 16) if float(f"{value:.{n}e}") > limit), 16)
    return f"{value:.{digits}e} above {limit:g}"


def _cut(shown: str, length: int, longest: int) -> str:
    """Cut the printable form of a text whose `length` is noted; it was made of its `longest` first characters only."""
    if max(length, len(shown)) <= longest:
        return shown
    # The note must fit in, so that a text that was cut is not cut again.
    note = f"… ({length} characters)"
    return shown[: longest - len(note)] + note


def normal_name(name: str) -> str:
    """A name in the Unicode form NFKC, in which Python compares names: the micro sign µ is the letter μ."""
    return unicodedata.normalize("NFKC", name)


def new_console() -> Console:
    """A console for the standard output that interprets no markup; a positive integer in `COLUMNS` sets its width."""
    from rich.console import Console  # noqa: PLC0415  most commands and the library print without it

    # Rich would take 0 for a width, and fail on some other texts.
    columns = os.environ.get("COLUMNS", "")
    prescribed = re.fullmatch("0*[1-9][0-9]{0,5}", columns) is not None
    environment = {name: value for name, value in os.environ.items() if prescribed or name != "COLUMNS"}
    console = Console(highlight=False, markup=False, emoji=False, _environ=environment)
    if not console.is_terminal and not prescribed:
        console.width = 10_000  # files and pipes have no width at which lines would be broken
    return console


def print_line(console: Console, line: str) -> None:
    """Print a line that may hold text from others; the terminal wraps it."""
    from rich.text import Text  # noqa: PLC0415  as above

    console.print(Text(printable(line)), soft_wrap=True)
