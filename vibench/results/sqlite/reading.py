"""Reading a results file, which others may have written: nothing in it is taken on trust."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from vibench.errors import RequestError
from vibench.qp.status import Status
from vibench.results.columns import VERSION
from vibench.results.sqlite.digests import DigestError, Digests
from vibench.results.sqlite.files import DAMAGE, code_of, connected_read_only
from vibench.text import one_line, parsed_json, printable

FILE = "results.sqlite"


class DamagedError(RequestError):
    """A results file that cannot be read: cut off, overwritten, or from a disk that failed."""


def read_text(stored: bytes) -> str:
    """A text of a results file, which others may have written: printable, whatever its bytes are."""
    return printable(stored.decode("utf-8", errors="replace"))


REMEMBERED = 1 << 16
"""Texts that a connection remembers."""


def text_reader() -> Callable[[bytes], str]:
    """`read_text` for one connection: a text that most rows of a table have is read, and kept in memory, once."""
    return lru_cache(maxsize=REMEMBERED)(read_text)


@contextlib.contextmanager
def open_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    """Context with a connection that cannot write to the results file, and runs no code that its schema names.

    What it reads is `printable`.
    """
    with connected_read_only(path) as connection:
        connection.execute("PRAGMA trusted_schema=OFF")
        connection.text_factory = text_reader()
        yield connection


def read_meta(path: Path) -> dict[str, str]:
    """The meta table of a results file; empty if the file has no tables.

    Raises
    ------
    DamagedError
        If the file cannot be read.
    RequestError
        If it is a database, but no results file.
    """
    try:
        with open_read_only(path) as db:
            kinds = {kind for (kind,) in db.execute("SELECT type FROM sqlite_master")}
            if strange := kinds - {"table", "index"}:
                raise RequestError(f"'{path}' is not a results file of vibench: it has a {min(strange)}")
            damage = "; ".join(line for (line,) in db.execute("PRAGMA quick_check(1)") if line != "ok")
            if damage:
                raise DamagedError(f"'{path}' is damaged: {' '.join(damage.split())}")
            found = dict(db.execute("SELECT key, value FROM meta")) if kinds else {}
            if found.get("schema") == str(VERSION):  # other versions are refused, or have no digests
                Digests(db).verified("meta")
            return found
    except DigestError as error:
        raise DamagedError(f"'{path}' is damaged: {error}") from None
    except sqlite3.Error as error:
        sort = DamagedError if code_of(error) in DAMAGE else RequestError
        raise sort(f"'{path}' is not a results file of vibench: {error}") from None


STATUSES = tuple(status.value for status in Status)


def read_rows(path: Path, table: str, cell: str = "") -> tuple[list[str], list[tuple[Any, ...]]]:
    """Columns and rows of a table of a results file, or those of one cell, in the order in which they were written.

    Raises
    ------
    RequestError
        If they are damaged, or have a status that does not exist.
    """
    try:
        with open_read_only(path) as db, db:
            db.execute("BEGIN")  # a run that writes in between changes neither rows nor digests
            names, rows = Digests(db).verified(table, cell)
    except DigestError as error:
        what = "run its study again, which computes damaged cells anew"
        raise RequestError(f"'{path}' is damaged: {error}; {what}") from None
    except (sqlite3.Error, OverflowError, MemoryError) as error:
        raise RequestError(f"'{path}' cannot be read: {one_line(str(error))}") from None
    if "status" in names:
        strange = {row[names.index("status")] for row in rows}.difference(STATUSES)
        if strange:
            known = f"expected one of {', '.join(STATUSES)}"
            raise RequestError(f"'{path}' has the status {str(min(strange, key=str))[:60]!a} in '{table}', {known}")
    return names, rows


def study_of(path: Path, meta: Mapping[str, str]) -> dict[str, Any]:
    """The settings of the study that a results file belongs to, from its meta table.

    Raises
    ------
    RequestError
        If the meta table does not hold them.
    """
    try:
        found = parsed_json(meta.get("study", ""))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise RequestError(f"'{path}' does not say which study it belongs to; use --out")
    return found
