"""Digests of the rows of a results file: SQLite finds pages whose structure is broken, but no changed numbers."""

from __future__ import annotations

import contextlib
import hashlib
import json
import marshal
import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, TypeAlias

from vibench.errors import RequestError
from vibench.files import scratch
from vibench.qp.status import Status
from vibench.results.schema import STORED, VERSION
from vibench.text import json_object, one_line, printable, shown


class DigestError(Exception):
    """Rows differ from those that were written; the message names the table, and the cell if it has cells."""


class Digests:
    """The digests in a results file: sums over rows, which follow a change of few rows without reading the others.

    SQLite notices pages whose structure is broken, but no changed numbers. A row counts 2¹²⁸ and its digest of 128
    bits (BLAKE2b). The order of the rows does not matter, nor do columns that were added after them.
    """

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def create(self) -> None:
        """Create the table of digests: one for each cell in each table, or for a whole table without cells."""
        columns = "name TEXT, cell TEXT, total TEXT, PRIMARY KEY (name, cell)"
        self._db.execute(f"CREATE TABLE IF NOT EXISTS digests ({columns})")

    def count(self, table: str, same: str = "TRUE", values: Sequence[Any] = (), *, remove: bool = False) -> None:
        """Add the rows of a table under a condition to the digests, or remove them before they are changed."""
        cursor = self._db.execute(f'SELECT * FROM "{table}" WHERE {same}', values)
        for cell, total in _totals([column[0] for column in cursor.description], cursor).items():
            stored = self._db.execute("SELECT total FROM digests WHERE name = ? AND cell = ?", (table, cell)).fetchone()
            now = int(stored[0] if stored else "0", 16) + (-total if remove else total)
            self._db.execute("INSERT OR REPLACE INTO digests VALUES (?, ?, ?)", (table, cell, f"{now:x}"))

    def forget(self, **keys: str) -> None:
        """Remove the digests of a table or of a cell, whose rows are all replaced."""
        same = " AND ".join(f"{name} = ?" for name in keys)
        self._db.execute(f"DELETE FROM digests WHERE {same}", tuple(keys.values()))

    def changed(self, table: str) -> tuple[str, ...]:
        """Cells whose rows differ from those that were written; "" for a table without cells."""
        names, rows = self._opened(table)
        return self._compared(table, _totals(names, rows))

    def verified(
        self, table: str, cells: Sequence[str] = (), order: Sequence[str] = ()
    ) -> Iterator[tuple[list[str], list[tuple[Any, ...]]]]:
        """Columns and rows of a table, or those of some cells, in parts of some thousand rows: at least one part.

        `order` are terms of SQL; without, rows come in the order in which they were written.

        Raises a `DigestError`, after the last part, if they are not those that were written.
        """
        names, cursor = self._opened(table, cells, order)
        totals, rows = Counter[Any](), cursor.fetchmany()
        yield names, rows
        while rows:
            totals.update(_totals(names, rows))
            if rows := cursor.fetchmany():
                yield names, rows
        if changed := self._compared(table, totals, cells):
            whose = f" of the cell {changed[0]}" if changed[0] else ""
            raise DigestError(f"rows{whose} in the table '{table}' are not those that were written")

    def _opened(self, table: str, keys: Sequence[str] = (), by: Sequence[str] = ()) -> tuple[list[str], sqlite3.Cursor]:
        # An index may be damaged, too: the table itself is read.
        query = f'SELECT * FROM "{table}" NOT INDEXED WHERE {of_cells(keys)}'
        try:
            cursor = self._db.execute(f"{query} ORDER BY {', '.join(by)}" if by else query, keys)
        except UnicodeDecodeError:  # of the name of a column
            raise DigestError(f"the columns of the table '{table}' are not those that were written") from None
        # Rows read at a time: a large table has more than memory should hold.
        cursor.arraysize = 4096
        names = [column[0] for column in cursor.description]
        declared = ("key", "value") if table == "meta" else tuple(STORED[table])
        if names != [*declared, *(f"mu_{k + 1}" for k in range(len(names) - len(declared)))]:
            raise DigestError(f"the columns of the table '{table}' are not those that were written")
        return names, cursor

    def _compared(self, table: str, totals: Mapping[Any, int], cells: Sequence[str] = ()) -> tuple[str, ...]:
        query = f"SELECT cell, total FROM digests NOT INDEXED WHERE name = ? AND {of_cells(cells)}"
        written = dict(self._db.execute(query, (table, *cells)))
        now = {str(key): f"{total:x}" for key, total in totals.items()}
        either = sorted(map(str, written.keys() | now.keys()))
        return tuple(key for key in either if written.get(key, "0") != now.get(key, "0"))


def of_cells(cells: Sequence[str]) -> str:
    """SQL condition that a row belongs to one of some cells, given as values; without cells, to any."""
    return f"cell IN ({', '.join('?' * len(cells))})" if cells else "TRUE"


def _totals(names: Sequence[str], rows: Iterable[tuple[Any, ...]]) -> dict[Any, int]:
    at, totals = (names.index("cell") if "cell" in names else None), dict[Any, int]()
    for cell, group in groupby(rows, key=(lambda row: row[at]) if at is not None else lambda _: ""):
        totals[cell] = totals.get(cell, 0) + sum(map(_digest, group))
    return totals


def _digest(row: tuple[Any, ...]) -> int:
    count = len(row)
    while count and row[count - 1] is None:
        count -= 1
    # Later formats of marshal than 2 depend on how often an object is used.
    code = hashlib.blake2b(marshal.dumps(row[:count], 2), digest_size=16)
    return (1 << 128) + int.from_bytes(code.digest())


FILE = "results.sqlite"


class DamagedResultsError(RequestError):
    """A results file that cannot be read: cut off, overwritten, or from a disk that failed."""


def damaged(path: Path) -> Path:
    """Path of a damaged database that is kept."""
    return Path(f"{path}.damaged")


def code_of(error: sqlite3.Error) -> int:
    """Primary error code of SQLite; 0 for errors of Python's own."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


@contextlib.contextmanager
def open_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    """Context with a connection that cannot write to the results file, and runs no code that its schema names.

    What it reads is `printable`. A database whose last writer was killed is read with its write-ahead log, for which
    SQLite makes an index beside it: in a folder that cannot be written, copies of both are read.
    """
    with contextlib.ExitStack() as stack:
        connection = stack.enter_context(contextlib.closing(connect(path, "ro")))
        if not _has_index(connection) and path.is_file():
            copy = stack.enter_context(scratch()) / path.name
            for end in ("", "-wal"):
                with contextlib.suppress(FileNotFoundError):
                    shutil.copyfile(f"{path}{end}", f"{copy}{end}")
            connection = stack.enter_context(contextlib.closing(connect(copy, "ro")))
        connection.execute("PRAGMA trusted_schema=OFF")
        connection.text_factory = text_reader()
        try:
            yield connection
        except UnicodeDecodeError as error:
            # Python decodes what SQLite says of a damaged schema, which may quote any bytes of it.
            raise DamagedResultsError(f"'{path}' is damaged: {error}") from None


def connect(path: Path, mode: Literal["ro", "rwc"]) -> sqlite3.Connection:
    """Open a database that is no pipe or device, to read it only or to create it where it is missing."""
    # Those may have no end, also under the names of the files beside it.
    for beside in (f"{path}{end}" for end in ("", "-wal", "-shm", "-journal")):
        if os.path.exists(beside) and not os.path.isfile(beside):  # noqa: PTH110, PTH113
            raise RequestError(f"'{beside}' is no regular file; remove it")
    # Another program may hold a lock for long; a minute is the longest wait.
    if (length := len(os.fsencode(path.absolute()))) > 504:
        raise RequestError(f"'{path}' has a path of {length} bytes, and SQLite opens none beyond 504: move its folder")
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=60.0)


def _has_index(connection: sqlite3.Connection) -> bool:
    """Whether the database can be read where it is: it needs no index of a write-ahead log, or one can be made."""
    try:
        connection.execute("PRAGMA schema_version").fetchone()
    except sqlite3.DatabaseError as error:
        # Damage is reported by what reads it.
        return code_of(error) not in (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)
    return True


def set_aside(path: Path) -> None:
    """Rename a database and its write-ahead log to "….damaged", in place of earlier ones."""
    # The log first: a new database must not find it.
    for end in ("-wal", ""):
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{end}").replace(f"{damaged(path)}{end}")
    Path(f"{path}-shm").unlink(missing_ok=True)


def text_reader() -> Callable[[bytes], str]:
    """Makes texts that others may have written printable, cached: most rows of a table have the same texts."""
    return lru_cache(maxsize=1 << 16)(lambda stored: printable(stored.decode("utf-8", errors="replace")))


def parameters_of(path: Path) -> dict[str, list[tuple[str, str]]]:
    """Names and units of mu_1, mu_2, … by the label of the problem, as far as a results file has them."""
    texts = {key: value for key, value in read_meta(path).items() if key.startswith("parameters of ")}
    found = {}
    for key, text in texts.items():
        try:
            found[key.removeprefix("parameters of ")] = [(str(name), str(unit)) for name, unit in json.loads(text)]
        except (TypeError, ValueError):
            strange = f"{shown(text)} as the {key}"
            raise DamagedResultsError(f"'{path}' has {strange}, expected pairs of texts") from None
    return found


def read_meta(path: Path) -> dict[str, str]:
    """The meta table of a results file; empty if the file has no tables.

    Raises a `DamagedResultsError` if the file cannot be read, and a `RequestError` if it is a database, but no results
    file.
    """
    try:
        with open_read_only(path) as db:
            kinds = {kind for (kind,) in db.execute("SELECT type FROM sqlite_master")}
            if strange := kinds - {"table", "index"}:
                raise RequestError(f"'{path}' is not a results file of vibench: it has a {min(strange)}")
            damage = "; ".join(line for (line,) in db.execute("PRAGMA quick_check(1)") if line != "ok")
            if damage:
                raise DamagedResultsError(f"'{path}' is damaged: {one_line(damage)}")
            meta = dict(db.execute("SELECT key, value FROM meta")) if kinds else {}
            if meta.get("schema") == str(VERSION):  # other versions are refused, or have no digests
                list(Digests(db).verified("meta"))
            return meta
    except DigestError as error:
        raise DamagedResultsError(f"'{path}' is damaged: {error}") from None
    except sqlite3.Error as error:
        damaged = code_of(error) in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
        kind = DamagedResultsError if damaged else RequestError
        raise kind(f"'{path}' is not a results file of vibench: {one_line(str(error))}") from None


# Columns and some rows of a table.
Part: TypeAlias = tuple[list[str], list[tuple[Any, ...]]]


def read_rows(path: Path, table: str, cells: Sequence[str] = ()) -> Part:
    """Columns and rows of a table of a results file, or those of some cells, in the order in which they were written.

    Raises a `RequestError` if they are damaged, or have a status that does not exist.
    """
    names, rows = list[str](), list[tuple[Any, ...]]()
    for names, part in read_parts(path, table, cells):  # noqa: B007  there is at least one part
        rows += part
    if "status" in names:
        strange = {row[names.index("status")] for row in rows}.difference(status.value for status in Status)
        if strange:
            expected = f"expected one of {', '.join(Status)}"
            raise RequestError(f"'{path}' has the status {str(min(strange, key=str))[:60]!a} in '{table}', {expected}")
    return names, rows


def read_parts(path: Path, table: str, cells: Sequence[str] = (), order: Sequence[str] = ()) -> Iterator[Part]:
    """`read_rows` in parts of some thousand rows, at least one, whatever their status; `order` are terms of SQL.

    Raises a `RequestError` after the last part if they are damaged.
    """
    try:
        with open_read_only(path) as db, db:
            db.execute("BEGIN")  # a run that writes in between changes neither rows nor digests
            yield from Digests(db).verified(table, cells, order)
    except DigestError as error:
        what = "run its study again, which computes damaged cells anew"
        raise RequestError(f"'{path}' is damaged: {error}; {what}") from None
    except (sqlite3.Error, OverflowError, MemoryError) as error:
        raise RequestError(f"'{path}' cannot be read: {one_line(str(error))}") from None


def study_of(path: Path, meta: Mapping[str, str]) -> dict[str, Any]:
    """The settings of the study of a results file, from its meta table; a `RequestError` if it does not hold them."""
    study = json_object(meta.get("study"))
    if study is None:
        raise RequestError(f"'{path}' does not say which study it belongs to; use --out")
    return study
