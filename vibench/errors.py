"""The errors that vibench raises on purpose; the command line turns them into one line and an exit code."""

from __future__ import annotations

import difflib
import typing
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from vibench.text import brief, one_line
from vibench.text import shown as in_words

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError


class VibenchError(Exception):
    """Base of every error vibench raises on purpose; its message is one line."""


class RequestError(VibenchError):
    """A request of the user is invalid: a study file, a name, an option or an output folder (exit code 2)."""


class StorageError(VibenchError):
    """A result that could not be written: no space left, no permission, a device that failed."""


class ExecutorError(VibenchError):
    """The executor of a run was lost: a cluster that was shut down, a network that broke."""


class NumericalError(VibenchError):
    """A computation cannot continue: a matrix that is not SPD, values that are not finite, no convergence."""


class UnsupportedError(VibenchError):
    """The problem or model does not support what was requested; its cells are unavailable."""


def in_a_line(error: BaseException) -> str:
    """Type and message of an exception, in one line of bounded length."""
    return one_line(f"{type(error).__name__}: {_text_of(error)}")


def message_of(error: BaseException) -> str:
    """The message of an exception, in one line of bounded length."""
    return one_line(_text_of(error))


def _text_of(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:  # noqa: BLE001  `__str__` of a plugin's exception may raise anything
        return "its message cannot be read"


@contextmanager
def foreign(what: str, kind: type[VibenchError] = UnsupportedError) -> Iterator[None]:
    """Turn whatever the code of others raises in the block into an error of a kind that says `what` this is."""
    try:
        yield
    except (VibenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001  the code of others raises anything
        raise kind(f"{what}: {in_a_line(error)}") from None


@contextmanager
def placed(where: str, kind: type[VibenchError] = RequestError) -> Iterator[None]:
    """Turn an error of a kind in the block into a `RequestError` that names the place."""
    try:
        yield
    except kind as error:
        raise RequestError(f"{where}: {error}") from None


@contextmanager
def at_parameter(mu: Any) -> Iterator[None]:
    """Name mu (d,) in every error of the block; what a plugin raises becomes a `NumericalError`."""
    where = f"mu = {mu.tolist()}"
    try:
        yield
    except NumericalError as error:
        if where in str(error):
            raise
        raise NumericalError(f"at {where}: {error}") from error
    except (VibenchError, MemoryError):
        raise
    except Exception as error:
        raise NumericalError(f"at {where}: {in_a_line(error)}") from error


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> RequestError:
    """Error for a name that is not among the choices, which suggests the nearest of them."""
    choices = sorted(choices)
    near = difflib.get_close_matches(name, choices, n=5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    listed = f"known: {', '.join(choices) or 'none'}"
    # A longer list helps nobody.
    if len(choices) > 30:
        listed = f"{len(choices)} are known{', such as ' * bool(near[1:])}{', '.join(near[1:])}"
    return RequestError(f"no {kind} is called '{brief(name, 80)}'{hint} ({listed})")


def fault_line(fault: ValidationError, root: type[BaseModel], named: Collection[str] = ()) -> str:
    """The first error of pydantic in a line: the key in a user's file, what was expected and what was found.

    `root` is the model of the whole file, `named` are the keys where a name may replace a table.
    """
    error = fault.errors(include_url=False)[0]
    # The last part of an unexpected key's path is the key itself, whatever its first character.
    outer = error["loc"][:-1] if error["type"] == "extra_forbidden" else error["loc"]
    # Parts with brackets are validators and types of unions, no keys.
    where = [part for part in outer if isinstance(part, int) or not {*"<["} & {*part}]
    message = error["msg"].removeprefix("Value error, ")
    shown = f" (found {in_words(error['input'])})" if isinstance(error["input"], str | int | float) else ""
    match error["type"]:
        case "extra_forbidden":
            fields = _model_at(root, where).model_fields
            message, shown = str(unknown_name("key", "".join(str(error["loc"][-1]).split()), fields)), ""
        case "missing":
            message, shown = "required, but not given", ""
        case "list_type" if isinstance(error["input"], dict):
            message = f"expected a list of tables: write [[{where[-1]}]] in place of [{where[-1]}]"
        case "model_type":
            message = "expected a name, or a table with one" if where[0] in named else "expected a table"
    place = ".".join(map(str, where))
    return " ".join(f"{place + ': ' if place else ''}{message}{shown}".split())


def _model_at(root: type[BaseModel], place: list[str | int]) -> type[BaseModel]:
    model = root
    for key in place:
        if key in model.model_fields:
            parts: list[Any] = [model.model_fields[key].annotation]
            while parts:
                part = parts.pop()
                parts += typing.get_args(part)
                model = part if hasattr(part, "model_fields") else model
    return model
