"""Text from others as data: nothing that a plugin, a solver, a study or a results file says acts where it is shown."""

from __future__ import annotations

import json
import unicodedata
from typing import Any

LONGEST = 2000
"""Characters that are kept of a message or a status."""


def parsed_json(text: str | bytes) -> Any:
    """The value of a JSON text that others wrote.

    Raises a `ValueError` if it is no JSON, or nested too deeply to be read.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def json_object(text: object) -> dict[str, Any] | None:
    """The object of a JSON text that others wrote; `None` where it is no such text."""
    try:
        value = parsed_json(text) if isinstance(text, str) else None
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def printable(text: str) -> str:
    r"""A text with its characters that are not printable as JSON escapes: ``\u001b``, ``\n``, ``\ud800``.

    These are control and format characters, lone surrogates and all white space but the blank. JSON keeps its content.
    """
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
    """A text as `printable` shows it, of at most `longest` characters; what is cut says how long it was."""
    return _cut(printable(text[:longest]), len(text), longest)


def one_line(text: str) -> str:
    """An `unbroken` text of at most `LONGEST` characters, cut as a `brief` one."""
    return _cut(unbroken(text[:LONGEST]), len(text), LONGEST)


def above(value: float, limit: float) -> str:
    """A number above a limit with the digits that tell it from the limit, such as "3.1e-07 above 1e-07"."""
    digits = next((n for n in range(1, 16) if float(f"{value:.{n}e}") > limit), 16)
    return f"{value:.{digits}e} above {limit:g}"


def _cut(shown: str, length: int, longest: int) -> str:
    """What is shown of a text of that length, of which no more than the `longest` first characters were looked at."""
    if max(length, len(shown)) <= longest:
        return shown
    note = f"… ({length} characters)"
    return shown[: longest - len(note)] + note


def normal_name(name: str) -> str:
    """A name in the Unicode form NFKC, in which Python compares names: the micro sign µ is the letter μ."""
    return unicodedata.normalize("NFKC", name)
