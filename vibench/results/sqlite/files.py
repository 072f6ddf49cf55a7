"""SQLite files as such: locked by other programs, in folders that cannot be written, or damaged."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

from vibench.files import TEMPORARY

BUSY_SECONDS = 60.0
"""Longest wait for a lock that another program holds."""

DAMAGE = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
"""SQLite's error codes of a damaged file."""

DAMAGED = ".damaged"
"""What `set_aside` adds to the name of a file."""

LOG, INDEX = "-wal", "-shm"
"""What SQLite adds to the name of a database for its write-ahead log, and for the index of that."""


def code_of(error: sqlite3.Error) -> int:
    """SQLite's error code, without the bits that tell variants of an error apart; 0 for errors of Python's own."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


@contextlib.contextmanager
def connected_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    """Context with a connection that cannot write to a database.

    A database whose last writer was killed is read with its write-ahead log, for which SQLite makes an index beside it:
    in a folder that cannot be written, copies of both are read.
    """
    with contextlib.ExitStack() as stack:
        connection = stack.enter_context(contextlib.closing(_connection(path)))
        if not _has_index(connection) and path.is_file():
            copy = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=TEMPORARY))) / path.name
            for end in ("", LOG):
                with contextlib.suppress(FileNotFoundError):
                    shutil.copyfile(f"{path}{end}", f"{copy}{end}")
            connection = stack.enter_context(contextlib.closing(_connection(copy)))
        yield connection


def _connection(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=BUSY_SECONDS)


def _has_index(connection: sqlite3.Connection) -> bool:
    """Whether a database needs no index of a write-ahead log, or one can be made beside it."""
    try:
        connection.execute("PRAGMA schema_version").fetchone()
    except sqlite3.OperationalError as error:
        return code_of(error) not in (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY)
    except sqlite3.DatabaseError:  # damaged: the reader will be told
        return True
    return True


def set_aside(path: Path) -> None:
    """Rename a database and its write-ahead log by `DAMAGED`; earlier ones of that name are replaced."""
    for end in (LOG, ""):  # the log first: a new database must not find it
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{end}").replace(f"{path}{DAMAGED}{end}")
    Path(f"{path}{INDEX}").unlink(missing_ok=True)
