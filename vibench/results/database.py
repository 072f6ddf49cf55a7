"""The results file: one SQLite database per run folder, one transaction per cell."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from vibench.errors import RequestError, StorageError
from vibench.locking import locked
from vibench.results.columns import HISTORY_KEYS, STORED, VERSION

FILE = "results.sqlite"

NAMED = ("stage", "quantity", *HISTORY_KEYS)
"""Columns that say whose a history is, and of what."""

LOCK = ".lock"
"""File in a run folder that the run holds."""


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Have a run folder for oneself; it is made if it does not exist.

    Raises
    ------
    RequestError
        If the folder is a file, holds something that is not a results file, or is used by another run.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise RequestError(f"output folder '{folder}' is a file")
        if folder.is_dir() and not (folder / FILE).exists() and any(path.name != LOCK for path in folder.iterdir()):
            raise RequestError(f"output folder '{folder}' is not empty and holds no {FILE}; choose another with --out")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(f"output folder '{folder}' cannot be written: {error.strerror}") from None
    with locked(folder / LOCK, busy=f"another run writes into '{folder}'"):
        yield


UNWRITABLE = {
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_CORRUPT,
}
"""What SQLite says where the disk is full, gone, or not ours, or another program holds or broke the file."""


class ResultsDatabase:
    """The results of one study in one folder.

    Parameters
    ----------
    folder
        The run folder; made if it does not exist.
    study
        What the numbers of the study depend on: results of another study are refused.
    anew
        Drop whatever is there, in the transaction that makes the tables.

    Raises
    ------
    RequestError
        If the folder holds something that is not a results file of this study and schema.
    """

    def __init__(self, folder: Path, study: Mapping[str, Any], *, anew: bool = False) -> None:
        path = folder / FILE
        try:
            if not anew:
                _refuse_other(path, study)
            folder.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path)
            self._db.execute("PRAGMA journal_mode=WAL")
            with self._db:
                self._db.execute("BEGIN IMMEDIATE")
                if anew:
                    self._drop()
                self._create(study)
            self._db.execute("PRAGMA foreign_keys=ON")
        except (OSError, sqlite3.Error) as error:
            raise RequestError(f"output folder '{folder}' cannot be written: {error}") from None

    def _drop(self) -> None:
        names = self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")
        for (name,) in names.fetchall():
            self._db.execute(f'DROP TABLE "{name}"')

    def _create(self, study: Mapping[str, Any]) -> None:
        self._db.execute("CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT)")
        for table, columns in STORED.items():
            declared = ", ".join(f'"{name}" {column.kind}' for name, column in columns.items())
            self._db.execute(f"CREATE TABLE IF NOT EXISTS {table} ({declared})")
        for table in ("queries", "solutions"):
            self._db.execute(f"CREATE INDEX IF NOT EXISTS {table}_of_cell ON {table}(cell)")
        self._db.execute(f"CREATE INDEX IF NOT EXISTS histories_named ON histories({', '.join(NAMED)})")
        entries = {"schema": str(VERSION), "study": json.dumps(study, sort_keys=True)}
        self._db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", entries.items())

    def close(self) -> None:
        """Close the file; what was written stays, in the one file."""
        with contextlib.suppress(sqlite3.OperationalError, sqlite3.ProgrammingError):  # being read, or closed before
            self._db.execute("PRAGMA journal_mode=DELETE")
        self._db.close()

    def finished(self) -> dict[str, tuple[str, str]]:
        """Cells that have a row: key → (status, code)."""
        return {key: (status, code) for key, status, code in self._db.execute("SELECT cell, status, code FROM cells")}

    def write_cell(
        self, cell: Mapping[str, Any], queries: Sequence[Mapping[str, Any]], solutions: Sequence[Mapping[str, Any]] = ()
    ) -> None:
        """Write a cell, its queries and solutions in one transaction, in place of earlier rows of the same cell."""
        with self._writing():
            self._add_columns(queries)
            self._db.execute("DELETE FROM cells WHERE cell = ?", (cell["cell"],))
            self._insert("cells", [cell])
            self._insert("queries", queries)
            self._insert("solutions", solutions)

    def write_histories(self, histories: Sequence[Sequence[Mapping[str, Any]]], *, partial: bool = False) -> None:
        """Write histories, each given as its rows, in place of earlier ones of the same name, whatever code made those.

        `partial` says that others hold further steps of the same histories, which are kept.
        """
        same = " AND ".join(f'"{name}" IS ?' for name in NAMED)
        with self._writing():
            for rows in filter(None, histories):
                steps = [row["step"] for row in rows]
                within = f" AND step BETWEEN {min(steps)} AND {max(steps)}" if partial else ""
                name = tuple(_plain(rows[0].get(column)) for column in NAMED)
                self._db.execute(f"DELETE FROM histories WHERE {same}{within}", name)
                self._insert("histories", rows)

    def replace_named(self, table: str, keys: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
        """Write rows of a table in place of all that have the same values in some columns."""
        same = " AND ".join(f'"{name}" IS ?' for name in keys)
        with self._writing():
            self._db.execute(f"DELETE FROM {table} WHERE {same}", tuple(keys.values()))
            self._insert(table, rows)

    def replace(self, table: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Replace the whole of a table that follows from the others."""
        with self._writing():
            self._db.execute(f"DELETE FROM {table}")
            self._insert(table, rows)

    def rows(self, table: str) -> list[dict[str, Any]]:
        """All rows of a table."""
        cursor = self._db.execute(f"SELECT * FROM {table}")
        names = [column[0] for column in cursor.description]
        return [dict(zip(names, row, strict=True)) for row in cursor]

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """One transaction; what cannot be written leaves what was there before."""
        try:
            with self._db:
                yield
        except sqlite3.DatabaseError as error:
            if getattr(error, "sqlite_errorcode", 0) & 0xFF not in UNWRITABLE:
                raise
            raise StorageError(f"results cannot be written: {error}") from None

    def _insert(self, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
        for row in rows:
            names = ", ".join(f'"{name}"' for name in row)
            marks = ", ".join("?" for _ in row)
            self._db.execute(
                f"INSERT INTO {table} ({names}) VALUES ({marks})", tuple(_plain(value) for value in row.values())
            )

    def _add_columns(self, queries: Sequence[Mapping[str, Any]]) -> None:
        """Make room for as many parameters mu_1, mu_2, … as the rows have."""
        known = {row[1] for row in self._db.execute("PRAGMA table_info(queries)")}
        for name in dict.fromkeys(name for row in queries for name in row):
            if name not in known and name.startswith("mu_"):
                self._db.execute(f'ALTER TABLE queries ADD COLUMN "{name}" REAL')


def _plain(value: Any) -> Any:
    """A value SQLite stores as what it is: NumPy scalars would end as bytes."""
    return value.item() if isinstance(value, np.generic) else value


def _refuse_other(path: Path, study: Mapping[str, Any]) -> None:
    if not path.exists():
        return
    found = read_meta(path)
    if not found:  # made by a run that was killed before it could write anything
        return
    if found.get("schema") != str(VERSION):
        raise RequestError(f"'{path}' has schema {found.get('schema')}, this vibench writes {VERSION}; use --out")
    there = study_of(path, found)
    if there != json.loads(json.dumps(study)):
        what = ", ".join(
            f"{key} {there.get(key)!r} instead of {study[key]!r}" for key in study if there.get(key) != study[key]
        )
        raise RequestError(f"'{path.parent}' holds results of another study ({what}); use another --out, or --fresh")


def read_meta(path: Path) -> dict[str, str]:
    """The meta table of a results file, empty where the file is.

    Raises
    ------
    RequestError
        If the file is something else.
    """
    db = sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)
    try:
        tables = [name for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return dict(db.execute("SELECT key, value FROM meta")) if tables else {}
    except sqlite3.Error as error:
        raise RequestError(f"'{path}' is not a results file of vibench: {error}") from None
    finally:
        db.close()


def study_of(path: Path, meta: Mapping[str, str]) -> dict[str, Any]:
    """The identity of the study a results file belongs to."""
    try:
        found = json.loads(meta.get("study", ""))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise RequestError(f"'{path}' does not say which study it belongs to; use --out")
    return found
