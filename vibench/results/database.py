"""The results file: one SQLite database per run folder, one transaction per cell.

It holds printable texts of bounded length and numbers of 64 bits; an error names any other value.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vibench.errors import RequestError, StorageError, VibenchError, message_of
from vibench.qp.status import Status
from vibench.results import sqlite
from vibench.results.schema import KEYS, STORED, VERSION, Column, Row, SqlType, column_of
from vibench.results.sqlite import FILE, DamagedResultsError, DigestError, Digests, damaged, read_meta, study_of
from vibench.text import LONGEST, brief, printable


class UnstorableError(VibenchError):
    """A value that its column cannot hold; the message names the column and says why."""


def storable(table: str, row: Row) -> dict[str, Any]:
    """The row of a table as the results file holds it; an `UnstorableError` for the first value that it cannot hold."""
    values: dict[str, Any] = {}
    for name, value in row.items():
        column, kind = column_of(table, name), type(value)
        if kind is float and column.kind == SqlType.REAL and value == value:  # noqa: PLR0124  most values; NaN is no number
            values[name] = value
            continue
        try:
            short = kind is str and len(value) <= LONGEST
            values[name] = _stored_text(column, value) if short else stored(column, value)
        except (TypeError, OverflowError) as error:
            raise UnstorableError(f"column '{name}' of the table '{table}': {error}") from None
    return values


# Cached: the texts that name a cell are in all of its rows.
@lru_cache(maxsize=256)
def _stored_text(column: Column, value: str) -> Any:
    return stored(column, value)


def stored(column: Column, value: Any) -> Any:
    """A value in the type of its column; a `TypeError` or an `OverflowError` where there is none."""
    kind = column.kind
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or (isinstance(value, float) and math.isnan(value)):
        if "NOT NULL" in column.constraint:
            raise TypeError("a value is missing")
        return None
    if kind == SqlType.TEXT and isinstance(value, str):
        # A reason quotes what a plugin said, and adds to it: twice the length of other texts.
        return printable(value) if column.is_json else brief(value, 2 * LONGEST)
    if kind == SqlType.BLOB and isinstance(value, bytes):
        return value
    if kind == SqlType.REAL and isinstance(value, int | float):
        return float(value)
    if kind == SqlType.INTEGER and isinstance(value, int | float) and value == int(value):
        if not -(2**63) <= value < 2**63:
            raise OverflowError(f"a number of {int(value).bit_length()} bits, of which 64 can be stored")
        return int(value)
    raise TypeError(f"a value of the type {type(value).__name__} is no {kind}")


def _history_axes() -> list[str]:
    return [name for name in STORED["histories"] if name not in ("artefact", "step", "value")]


class ResultsDatabase:
    """The results of one study in one folder.

    Settings that determine the numbers of the study are kept with them: results of another study are refused. `anew`
    drops all existing tables, in the transaction that creates the new ones. `damaged` are the cells whose rows were
    damaged and are removed: they have to be computed again.

    Raises a `RequestError` if the folder holds results of another study or schema, or damage that no cell explains, or
    cannot be written.
    """

    def __init__(self, folder: Path, study: Mapping[str, Any], *, anew: bool = False) -> None:
        path = folder / FILE
        try:
            if not anew:
                _refuse_other(path, study)
            folder.mkdir(parents=True, exist_ok=True)
            self._path = path.absolute()
            self._db = sqlite.connect(self._path, "rwc")
            self._db.text_factory = sqlite.text_reader()
            self._digests = Digests(self._db)
            with contextlib.ExitStack() as opened:
                opened.callback(self.close)
                self._db.execute("PRAGMA journal_mode=WAL")
                with self._db:
                    self._db.execute("BEGIN IMMEDIATE")
                    self._create(study, anew)
                    self.damaged = self._remove_damaged(path)
                self._db.execute("PRAGMA foreign_keys=ON")
                self._opened = self._path.stat()
                opened.pop_all()
        except DigestError as error:
            raise DamagedResultsError(f"'{path}' is damaged: {error}; use another --out, or --fresh") from None
        except (OSError, sqlite3.Error) as error:
            # SQLite does not say that it lacked a file descriptor.
            few = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
            hint = f"; this process may open only {few} files (`ulimit -n`)" * (0 <= few < 64)
            raise RequestError(f"output folder '{folder}' cannot be written: {message_of(error)}{hint}") from None

    def _create(self, study: Mapping[str, Any], anew: bool) -> None:
        old = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
        for (name,) in self._db.execute(old).fetchall() if anew else ():
            self._db.execute(f'DROP TABLE "{name}"')
        self._db.execute("CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT)")
        for table, columns in STORED.items():
            declared = ", ".join(f'"{name}" {column.kind} {column.constraint}' for name, column in columns.items())
            self._db.execute(f"CREATE TABLE IF NOT EXISTS {table} ({declared})")
        for table in ("queries", "solutions", "timings", "outputs"):
            self._db.execute(f"CREATE INDEX IF NOT EXISTS {table}_of_cell ON {table}(cell)")
        self._db.execute(f"CREATE INDEX IF NOT EXISTS histories_named ON histories({', '.join(_history_axes())})")
        entries = {"schema": str(VERSION), "study": json.dumps(study, sort_keys=True)}
        self._digests.create()
        self._db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", entries.items())
        self._digests.forget(name="meta")
        self._digests.count("meta")

    def _remove_damaged(self, path: Path) -> tuple[str, ...]:
        """Remove cells whose rows have changed, and return their keys; a `RequestError` for damage elsewhere."""
        sound = self._is_sound()
        if not sound:
            # An index holds nothing that its table does not.
            self._db.execute("REINDEX")
        changed = {table: self._digests.changed(table) for table in STORED}
        # Every run makes these anew from the others.
        for table in ("thresholds", "disagreements"):
            if changed.pop(table):
                self._replace(table, {}, ())
        for table, cells in changed.items():
            if "" in cells:
                raise RequestError(f"'{path}' is damaged: rows of the table '{table}' have changed; use another --out")
        damaged = tuple(sorted({cell for cells in changed.values() for cell in cells}))
        for cell in damaged:
            self._remove(cell)
        if not sound and not self._is_sound():
            raise RequestError(f"'{path}' is damaged; use another --out")
        return damaged

    def _is_sound(self) -> bool:
        """Whether the structure of the file, its indices included, has no damage."""
        return self._db.execute("PRAGMA integrity_check(1)").fetchall() == [("ok",)]

    def _remove(self, cell: str) -> None:
        for table in (name for name, columns in STORED.items() if "cell" in columns):
            self._db.execute(f"DELETE FROM {table} WHERE cell = ?", (cell,))
        self._digests.forget(cell=cell)

    def close(self) -> None:
        """Close the database and merge the write-ahead log into the one file."""
        with contextlib.suppress(sqlite3.OperationalError, sqlite3.ProgrammingError):  # read by others, or closed
            self._db.execute("PRAGMA journal_mode=DELETE")
        self._db.close()

    def finished(self) -> dict[str, tuple[str, str]]:
        """Status and code of the cells that have a row, by their key."""
        return {key: (status, code) for key, status, code in self._db.execute("SELECT cell, status, code FROM cells")}

    def ends(self) -> Iterator[tuple[str, str, str, str]]:
        """Cell, hash of its study, status and reason of all cells and queries that are not ok."""
        columns = "cells.cell, cells.study_hash, {0}.status, coalesce({0}.reason, '') FROM cells"
        own = f"SELECT {columns.format('cells')} WHERE cells.status <> 'ok'"
        queries = f"SELECT {columns.format('queries')} JOIN queries USING (cell) WHERE queries.status <> 'ok'"
        return self._db.execute(f"{own} UNION ALL {queries}")

    def write_cell(
        self, cell: Row, queries: Sequence[Row], solutions: Sequence[Row] = (), outputs: Sequence[Row] = (),
        parameters: Sequence[tuple[str, str]] = (),
    ) -> dict[str, Any]:  # fmt: skip
        """Write a cell, its queries, solutions and outputs in one transaction; its earlier rows are replaced.

        `parameters` are names and units of the parameters of its problem, which are kept in the table `meta`.

        Rows that cannot be stored because of their values cost the cell, not the run: it gets an `error` row instead.

        Returns the row of the cell as it is stored. Raises a `StorageError` if the file cannot be written.
        """
        try:
            if parameters:
                self.keep(f"parameters of {cell.get('problem')}", json.dumps(parameters))
            return self._write_cell(cell, queries=queries, solutions=solutions, outputs=outputs)
        except (UnstorableError, sqlite3.Error) as error:
            # Columns that do not depend on the results of the stages of the cell.
            identity = (
                "cell", *KEYS, "queries", "seed", "validation", "validation_options", "study_hash", "code", "machine",
                "threads", "versions", "definition",
            )  # fmt: skip
            row = {name: cell[name] for name in identity if name in cell}
            row.update(status=Status.ERROR.value, reason=f"the results cannot be stored: {error}", queries_ok=0)
            return self._write_cell(row)

    def keep(self, key: str, value: str) -> None:
        """Keep a text in the table `meta`, in place of an earlier one with the same key."""
        if self._db.execute("SELECT 1 FROM meta WHERE key = ? AND value = ?", (key, value)).fetchone():
            return
        with self._writing():
            self._db.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))
            self._digests.forget(name="meta")
            self._digests.count("meta")

    def kept(self, beginning: str) -> dict[str, str]:
        """The texts in `meta` whose keys have this beginning, by the rest of their keys."""
        entries = self._db.execute("SELECT key, value FROM meta").fetchall()
        return {key.removeprefix(beginning): value for key, value in entries if key.startswith(beginning)}

    def _write_cell(self, cell: Row, **others: Sequence[Row]) -> dict[str, Any]:
        with self._writing():
            # A column for every parameter mu_1, mu_2, … of the queries.
            there = {row[1] for row in self._db.execute("PRAGMA table_info(queries)")}
            for name in dict.fromkeys(name for row in others.get("queries", ()) for name in row):
                if name not in there and name.startswith("mu_"):
                    self._db.execute(f'ALTER TABLE queries ADD COLUMN "{name}" REAL')
            self._remove(cell["cell"])
            for table, rows in {"cells": [cell], **others}.items():
                self._insert(table, rows)
                self._digests.count(table, "cell = ?", (cell["cell"],))
        return storable("cells", cell)

    def write_seconds(self, cell: str, own: Row, queries: Mapping[int, Row], rounds: Sequence[Row]) -> None:
        """Write the seconds of a cell that has its rows, in one transaction; earlier ones are replaced.

        `own` are columns of the cell, `queries` those of its queries by their number, `rounds` rows of timings.
        """
        changed = ("cells", "queries") if queries else ("cells",)
        with self._writing():
            for table in changed:
                self._digests.count(table, "cell = ?", (cell,), remove=True)
            self._update("cells", own, cell=cell)
            for number, columns in queries.items():
                self._update("queries", columns, cell=cell, query=number)
            for table in changed:
                self._digests.count(table, "cell = ?", (cell,))
            self._replace("timings", {"cell": cell}, rounds)

    def write_columns(self, cell: str, columns: Row, table: str = "cells") -> None:
        """Write some columns of a cell that has its row, or of all its rows of another table."""
        with self._writing():
            self._digests.count(table, "cell = ?", (cell,), remove=True)
            self._update(table, columns, cell=cell)
            self._digests.count(table, "cell = ?", (cell,))

    def _update(self, table: str, columns: Row, **keys: Any) -> None:
        changes = ", ".join(f'"{name}" = ?' for name in columns)
        same = " AND ".join(f'"{name}" IS ?' for name in keys)
        values = (*storable(table, columns).values(), *storable(table, keys).values())
        self._db.execute(f"UPDATE {table} SET {changes} WHERE {same}", values)

    def fine_queries(self, cell: str) -> tuple[int, ...]:
        """Numbers of the queries of a cell that are ok."""
        rows = self._db.execute("SELECT query FROM queries WHERE cell = ? AND status = 'ok' ORDER BY query", (cell,))
        return tuple(number for (number,) in rows)

    def cell(self, key: str) -> dict[str, Any] | None:
        """The row of a cell, if it has one."""
        return next(self._selected("SELECT * FROM cells WHERE cell = ?", key), None)

    def write_histories(self, histories: Sequence[Sequence[Row]], *, partial: bool = False) -> None:
        """Write histories, each given as its rows; earlier histories of the same name are replaced.

        With `partial`, earlier steps outside the range of the new ones are kept: several writers share a history.
        """
        with self._writing():
            for rows in filter(None, histories):
                steps = [row["step"] for row in rows]
                within = f" AND step BETWEEN {min(steps)} AND {max(steps)}" if partial else ""
                self._replace("histories", {name: rows[0].get(name) for name in _history_axes()}, rows, within)

    def replace(self, table: str, rows: Iterable[Row], **keys: Any) -> None:
        """Replace all rows of a table, or those with these values in the columns `keys`."""
        with self._writing():
            self._replace(table, keys, rows)

    def _replace(self, table: str, keys: Row, rows: Iterable[Row], within: str = "") -> None:
        same = " AND ".join(["TRUE", *(f'"{name}" IS ?' for name in keys)]) + within
        values = tuple(storable(table, keys).values())
        if keys:
            self._digests.count(table, same, values, remove=True)
        else:
            self._digests.forget(name=table)
        self._db.execute(f"DELETE FROM {table} WHERE {same}", values)
        self._insert(table, rows)
        self._digests.count(table, same, values)

    def rows(self, table: str) -> Iterator[dict[str, Any]]:
        """All rows of a table, one after the other."""
        return self._selected(f"SELECT * FROM {table}")

    def fine_solutions(self, cell: str) -> Iterator[dict[str, Any]]:
        """Rows of the solutions table: those of the ok queries of a cell."""
        fine = "SELECT query FROM queries WHERE cell = ? AND status = 'ok'"
        return self._selected(f"SELECT * FROM solutions WHERE cell = ? AND query IN ({fine})", cell, cell)

    def _selected(self, command: str, *values: str) -> Iterator[dict[str, Any]]:
        cursor = self._db.execute(command, values)
        cursor.row_factory = sqlite3.Row
        return map(dict, cursor)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Context of one transaction, rolled back if it cannot be written, or the file is no longer in its place."""
        try:
            with self._db:
                self._db.execute("BEGIN IMMEDIATE")
                yield
                try:
                    there = os.path.samestat(self._path.stat(), self._opened)
                except OSError:
                    there = False
                # SQLite would go on writing into a file that nobody finds any more.
                if not there:
                    remedy = "the same command runs its cells again, with the artefacts that are stored"
                    raise StorageError(f"'{self._path}' was removed or replaced during the run; {remedy}")
        except sqlite3.DatabaseError as error:
            code = sqlite.code_of(error)
            # A full, lost or read-only disk, or a file locked or damaged by another program; the rest is a bug.
            if code not in (
                sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN,
                sqlite3.SQLITE_BUSY, sqlite3.SQLITE_CORRUPT,
            ):  # fmt: skip
                raise
            waited = " by another program for 60 s" if code == sqlite3.SQLITE_BUSY else ""
            raise StorageError(f"results cannot be written: {message_of(error)}{waited}") from None

    def _insert(self, table: str, rows: Iterable[Row]) -> None:
        for row in rows:
            self._db.execute(_insertion(table, tuple(row)), tuple(storable(table, row).values()))


@lru_cache(maxsize=32)
def _insertion(table: str, names: tuple[str, ...]) -> str:
    """Command that inserts a row with these columns, cached: consecutive rows of a table have the same ones."""
    quoted, marks = ", ".join(f'"{name}"' for name in names), ", ".join("?" * len(names))
    return f"INSERT INTO {table} ({quoted}) VALUES ({marks})"


def _refuse_other(path: Path, study: Mapping[str, Any]) -> None:
    try:
        meta = read_meta(path) if path.exists() else {}
    except DamagedResultsError as error:
        raise RequestError(f"{error}; use another --out, or --fresh, which keeps it as {damaged(path).name}") from None
    if not meta:  # empty where a run was killed before its first transaction
        return
    if meta.get("schema") != str(VERSION):
        raise RequestError(f"'{path}' has schema {meta.get('schema')}, this vibench writes {VERSION}; use --out")
    there = study_of(path, meta)
    if there != json.loads(json.dumps(study)):
        other = [key for key in study if there.get(key) != study[key]]
        what = ", ".join(f"{key} {there.get(key)!r} instead of {study[key]!r}" for key in other)
        raise RequestError(f"'{path.parent}' holds results of another study ({what}); use another --out, or --fresh")
