"""The errors vibench raises on purpose; the command line turns them into one line and an exit code."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from vibench.text import one_line


class VibenchError(Exception):
    """Base of every error vibench raises on purpose; its message is one line."""


class RequestError(VibenchError):
    """What the user asked for is wrong: a study file, a name, an option or an output folder (exit code 2)."""


class StorageError(VibenchError):
    """A result that could not be written: no space left, no permission, a device that failed."""


class ExecutorError(VibenchError):
    """Whoever was to run stages is gone: a cluster that was shut down, a network that broke."""


class NumericalError(VibenchError):
    """A computation cannot go on: a matrix that is not SPD, values that are not finite, no convergence."""


class UnsupportedError(VibenchError):
    """What was asked for does not exist for this problem or model; its cells are unavailable."""


def in_a_line(error: BaseException) -> str:
    """The sort of an exception and its message, in one line of bounded length."""
    return one_line(f"{type(error).__name__}: {_text_of(error)}")


def message_of(error: BaseException) -> str:
    """The message of an exception, in one line of bounded length."""
    return one_line(_text_of(error))


def _text_of(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:  # noqa: BLE001  `__str__` of a plugin's exception may raise anything
        return "its message cannot be read"


MANY = 30
"""Names up to which an error lists all that are known."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> RequestError:
    """Build the error for a name nobody registered, with the nearest known one suggested."""
    choices = sorted(known)
    near = difflib.get_close_matches(name, choices, n=5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    if len(choices) > MANY:
        listed = f"{len(choices)} are known{', such as ' * bool(near[1:])}{', '.join(near[1:])}"
    else:
        listed = f"known: {', '.join(choices) or 'none'}"
    return RequestError(f"no {kind} is called '{name}'{hint} ({listed})")
