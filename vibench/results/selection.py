"""Rows and columns that a user asks for, by names and by an expression; nothing in it can write, or run anything."""

from __future__ import annotations

import contextlib
import re
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from vibench.arrays import Array
from vibench.errors import RequestError, unknown_name
from vibench.results.schema import STORED, Column, column_of
from vibench.results.sqlite import of_cells, open_read_only
from vibench.text import brief, printable


def matching(
    path: Path, table: str, expression: str, frame: pd.DataFrame,
    added: Mapping[str, Column] = MappingProxyType({}), made: Collection[str] = (), cells: Sequence[str] = (),
) -> Array:  # fmt: skip
    """Mask of the rows of a table that satisfy an expression of SQLite over its columns, in the order of the file.

    The expression may use columns, numbers, texts in single quotes and operators. It runs on a connection that cannot
    write, under an authoriser that refuses functions, subqueries and other tables.

    `frame` has the rows and the columns of the table, and those `added` to it: an expression that names one of these
    runs on a copy in memory. `made` are columns of what is made of the rows. With `cells`, only their rows are judged.

    Raises a `RequestError` if it is no such expression, or names a column that the table does not have.
    """
    query = f'SELECT ({expression}) IS TRUE FROM "{table}" NOT INDEXED WHERE {of_cells(cells)} ORDER BY rowid'
    named = any(re.search(rf"(?i)\b{name}\b", _text_free(expression)) for name in added)
    with _copied(table, frame, added) if named else open_read_only(path) as db:
        found = _answers(db, table, expression, (query, cells), frame.columns, made)
    return np.array([matches for (matches,) in found], dtype=bool)


def cells_of_first(path: Path, table: str, expression: str, order: Sequence[str], limit: int) -> list[str]:
    """Cells of the first `limit` rows that satisfy an expression, as in `matching`; without one, of all rows.

    `order` are terms of SQL. No other rows are kept in memory, and their digests are not compared.

    Raises a `RequestError` if it is no such expression, or names a column that the table does not have.
    """
    condition = f"({expression})" if expression else "TRUE"
    query = f'SELECT cell FROM "{table}" NOT INDEXED WHERE {condition} ORDER BY {", ".join(order)} LIMIT {limit}'
    with open_read_only(path) as db:
        found = _answers(db, table, expression or "TRUE", (query, ()), STORED[table], ())
    return list(dict.fromkeys(str(cell) for (cell,) in found))


def _answers(
    db: sqlite3.Connection, table: str, expression: str, query: tuple[str, Sequence[str]], columns: Iterable[str],
    made: Collection[str],
) -> list[tuple[Any, ...]]:  # fmt: skip
    """Rows of a query whose expression is checked first."""
    outside = _text_free(expression)
    if len(expression) > 1000:
        raise RequestError(f"--where has {len(expression)} characters, at most 1000 are read")
    if re.search(r'["`;\[\]\'?@$#:\0]|--|/\*', outside.replace("''", "")):
        raise _wrong(expression, "it may hold columns, numbers, operators and texts in single quotes")
    # An unmatched parenthesis would close the one around the expression.
    depths = [0, *accumulate((sign == "(") - (sign == ")") for sign in outside)]
    if min(depths) < 0 or depths[-1]:
        raise _wrong(expression, "its parentheses do not match")

    # An authoriser, since the expression may come from anybody: SQLite runs LIKE and GLOB as functions, and all others
    # are refused.
    def allowed(action: int, first: str | None, second: str | None, *_: str | None) -> int:
        fine = (
            (action == sqlite3.SQLITE_READ and first == table)
            or (action == sqlite3.SQLITE_FUNCTION and second in ("like", "glob"))
            or (action == sqlite3.SQLITE_SELECT and next(selects, None) is not None)
        )
        return sqlite3.SQLITE_OK if fine else sqlite3.SQLITE_DENY

    selects = iter(["the one around the expression"])
    db.setlimit(sqlite3.SQLITE_LIMIT_EXPR_DEPTH, 100)
    db.set_authorizer(allowed)
    try:
        return db.execute(*query).fetchall()
    except sqlite3.Error as error:
        unknown = re.fullmatch(r"no such column: (.+)", str(error))
        if unknown and unknown[1] in made:
            about = f"'{unknown[1]}' is a column of the table alone, for --columns and --sort"
            raise RequestError(f"--where selects rows of {table}, of which the table is made; {about}") from None
        if unknown:
            raise unknown_name(f"column of {table}", printable(unknown[1]), columns) from None
        refused = any(word in str(error) for word in ("prohibited", "authorized"))
        why = "functions, subqueries and other tables are refused" if refused else printable(str(error))
        raise _wrong(expression, why) from None


def _text_free(expression: str) -> str:
    return re.sub(r"'(?:[^']|'')*'", "''", expression)


@contextlib.contextmanager
def _copied(table: str, frame: pd.DataFrame, added: Mapping[str, Column]) -> Iterator[sqlite3.Connection]:
    """Context with a table in memory, which has the columns that are added to it."""
    columns = {**STORED[table], **added}
    kinds = ", ".join(f'"{name}" {(columns.get(name) or column_of(table, name)).kind}' for name in frame.columns)
    values = frame.astype(object).where(frame.notna(), None)
    with contextlib.closing(sqlite3.connect(":memory:")) as db:
        db.execute(f'CREATE TABLE "{table}" ({kinds})')
        marks = ", ".join("?" * len(frame.columns))
        db.executemany(f'INSERT INTO "{table}" VALUES ({marks})', values.itertuples(index=False, name=None))
        yield db


def _wrong(expression: str, why: str) -> RequestError:
    example = "solver = 'piqp' and beta_span_min < 1e-3"
    return RequestError(f'--where {printable(expression)!r} is no condition on a row: {why}, as in "{example}"')


def parts(text: str) -> list[str]:
    """The names in a list with commas."""
    return [name for part in text.split(",") if (name := part.strip())]


def sorted_by(frame: pd.DataFrame, keys: Sequence[str], what: str) -> pd.DataFrame:
    """Rows sorted by columns of the table `what`; a "-" before a name for the largest first; missing values last."""
    names = [key.removeprefix("-") for key in keys]
    for name in names:
        if name not in frame:
            raise unknown_name(f"column of {what}", name, frame.columns)
    rising = [not key.startswith("-") for key in keys]
    return frame.sort_values(names, ascending=rising, kind="stable", na_position="last", ignore_index=True)


def key_of(cell: str, keys: Iterable[str], run: str, command: str = "vibench show RUN --table cells") -> str:
    """The one key of a cell that begins with `cell`; a `RequestError` if there is none, or are several."""
    matching = [key for key in keys if key.startswith(cell)]
    if len(matching) != 1:
        said = f"{len(matching)} cells of '{run}' begin with '{brief(cell, 80)}', expected one"
        raise RequestError(f"{said}; `{command}` lists them")
    return matching[0]


def short_keys(keys: Iterable[str]) -> int:
    """Number of characters that distinguish the keys of cells, at least four."""
    different = set(keys)
    longest = max(map(len, different), default=4)
    enough = (n for n in range(4, longest) if len({key[:n] for key in different}) == len(different))
    return next(enough, longest)
