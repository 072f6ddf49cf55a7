"""What a results file can hold: printable text of bounded length, numbers of 64 bits; any other value is named."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from vibench.errors import VibenchError
from vibench.qp.status import Status
from vibench.results.columns import BLOB, INTEGER, KEYS, PARAMETER, REAL, STORED, TEXT, Column
from vibench.text import LONGEST, brief, printable

LONGEST_TEXT = 2 * LONGEST
"""Characters of a text in a column: a reason quotes what a plugin said, and adds to it."""

REMEMBERED = 256
"""Texts whose stored form is remembered: what names a cell is in all of its rows."""

IDENTITY = (
    "cell",
    *KEYS,
    "queries",
    "seed",
    "validation",
    "validation_options",
    "study_hash",
    "code",
    "machine",
    "threads",
    "versions",
    "definition",
)
"""Columns of a cell that do not depend on what its stages compute."""


class UnstorableError(VibenchError):
    """A value that its column cannot hold; the message names the column and says why."""


def storable(table: str, row: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a table as the results file holds it.

    Raises an `UnstorableError` for the first value that it cannot hold.
    """
    columns = STORED[table]
    values: dict[str, Any] = {}
    for name, value in row.items():
        column, kind = columns.get(name, PARAMETER), type(value)
        if kind is float and column.kind == REAL and value == value:  # noqa: PLR0124  most values; NaN is no number
            values[name] = value
            continue
        try:
            short = kind is str and len(value) <= LONGEST
            values[name] = _stored_text(column, value) if short else stored(column, value)
        except (TypeError, OverflowError) as error:
            raise UnstorableError(f"column '{name}' of the table '{table}': {error}") from None
    return values


@lru_cache(maxsize=REMEMBERED)
def _stored_text(column: Column, value: str) -> Any:
    """The same of a short text."""
    return stored(column, value)


def error_row(cell: Mapping[str, Any], reason: str) -> dict[str, Any]:
    """The row of a cell whose own rows cannot be stored: what identifies it, and the reason."""
    kept = {name: cell[name] for name in IDENTITY if name in cell}
    reason = f"the results cannot be stored: {reason}"
    return kept | {"status": Status.ERROR.value, "reason": reason, "queries_ok": 0}


def stored(column: Column, value: Any) -> Any:
    """A value in the type of its column; a `TypeError` or an `OverflowError` where there is none."""
    kind = column.kind.split()[0]
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or (isinstance(value, float) and math.isnan(value)):
        if "NOT NULL" in column.kind:
            raise TypeError("a value is missing")
        return None
    if kind == TEXT and isinstance(value, str):
        return printable(value) if column.whole else brief(value, LONGEST_TEXT)
    if kind == BLOB and isinstance(value, bytes):
        return value
    if kind == REAL and isinstance(value, int | float):
        return float(value)
    if kind == INTEGER and isinstance(value, int | float) and value == int(value):
        if not -(2**63) <= value < 2**63:
            raise OverflowError(f"a number of {int(value).bit_length()} bits, of which 64 can be stored")
        return int(value)
    raise TypeError(f"a value of the type {type(value).__name__} is no {kind}")
