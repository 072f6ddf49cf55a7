"""Digests of the rows of a results file: SQLite finds pages whose structure is broken, but no changed numbers."""

from __future__ import annotations

import hashlib
import marshal
import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

from vibench.results.columns import STORED

META = ("key", "value")
"""Columns of the meta table."""

NONE = "0"
"""Digest of no rows."""

CREATE = "CREATE TABLE IF NOT EXISTS digests (name TEXT, cell TEXT, total TEXT, PRIMARY KEY (name, cell))"
"""The table of the digests: one for each cell in each table, or for a whole table that has no cells."""

FORMAT = 2
"""Format of marshal for the rows: its later ones depend on how often an object is used."""


PART = 4096
"""Rows that are read at a time: a large table has more than memory should hold."""


class DigestError(Exception):
    """Rows that are not those that were written; the message names the table, and a cell if it has some."""


class Digests:
    """The digests in a results file: sums over rows, which follow a change of few rows without reading the others.

    A row counts 2¹²⁸ and its digest of 128 bits (BLAKE2b). The order of the rows does not matter, nor do columns that
    were added after them.
    """

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db

    def count(self, table: str, same: str = "TRUE", values: Sequence[Any] = (), *, sign: int = 1) -> None:
        """Add the rows of a table under a condition, before they are changed with `sign` −1."""
        cursor = self._db.execute(f'SELECT * FROM "{table}" WHERE {same}', values)
        for cell, total in _totals([column[0] for column in cursor.description], cursor).items():
            stored = self._db.execute("SELECT total FROM digests WHERE name = ? AND cell = ?", (table, cell)).fetchone()
            now = int(stored[0] if stored else NONE, 16) + sign * total
            self._db.execute("INSERT OR REPLACE INTO digests VALUES (?, ?, ?)", (table, cell, f"{now:x}"))

    def forget(self, **keys: str) -> None:
        """Remove the digests of a table or of a cell, whose rows are all replaced."""
        same = " AND ".join(f"{name} = ?" for name in keys)
        self._db.execute(f"DELETE FROM digests WHERE {same}", tuple(keys.values()))

    def changed(self, table: str) -> tuple[str, ...]:
        """Cells whose rows are not those that were written; "" for a table without cells."""
        names, rows = self._opened(table)
        return self._compared(table, _totals(names, rows))

    def verified(
        self, table: str, cells: Sequence[str] = (), order: Sequence[str] = ()
    ) -> Iterator[tuple[list[str], list[tuple[Any, ...]]]]:
        """Columns and rows of a table, or those of some cells, in parts of at most `PART` rows: at least one part.

        `order` are terms of SQL; without, rows come in the order in which they were written.

        Raises a `DigestError`, after the last part, if they are not those that were written.
        """
        names, cursor = self._opened(table, cells, order)
        totals, rows = Counter[Any](), cursor.fetchmany(PART)
        yield names, rows
        while rows:
            totals.update(_totals(names, rows))
            if rows := cursor.fetchmany(PART):
                yield names, rows
        if changed := self._compared(table, totals, cells):
            whose = f" of the cell {changed[0]}" if changed[0] else ""
            raise DigestError(f"rows{whose} in the table '{table}' are not those that were written")

    def _opened(
        self, table: str, cells: Sequence[str] = (), order: Sequence[str] = ()
    ) -> tuple[list[str], sqlite3.Cursor]:
        # An index may be damaged, too: the table itself is read.
        query = f'SELECT * FROM "{table}" NOT INDEXED WHERE {of_cells(cells)}'
        try:
            cursor = self._db.execute(f"{query} ORDER BY {', '.join(order)}" if order else query, cells)
        except UnicodeDecodeError:  # of the name of a column
            raise DigestError(f"the columns of the table '{table}' are not those that were written") from None
        names = [column[0] for column in cursor.description]
        declared = META if table == "meta" else tuple(STORED[table])
        if names != [*declared, *(f"mu_{k + 1}" for k in range(len(names) - len(declared)))]:
            raise DigestError(f"the columns of the table '{table}' are not those that were written")
        return names, cursor

    def _compared(self, table: str, totals: Mapping[Any, int], cells: Sequence[str] = ()) -> tuple[str, ...]:
        query = f"SELECT cell, total FROM digests NOT INDEXED WHERE name = ? AND {of_cells(cells)}"
        written = dict(self._db.execute(query, (table, *cells)))
        now = {str(key): f"{total:x}" for key, total in totals.items()}
        either = sorted(map(str, written.keys() | now.keys()))
        return tuple(key for key in either if written.get(key, NONE) != now.get(key, NONE))


def of_cells(cells: Sequence[str]) -> str:
    """The condition that a row belongs to one of some cells, which are its values; no cells stand for all."""
    return f"cell IN ({', '.join('?' * len(cells))})" if cells else "TRUE"


def _totals(names: Sequence[str], rows: Iterable[tuple[Any, ...]]) -> dict[Any, int]:
    """Sum over the rows of each cell."""
    at, totals = (names.index("cell") if "cell" in names else None), dict[Any, int]()
    for cell, group in groupby(rows, key=(lambda row: row[at]) if at is not None else lambda _: ""):
        totals[cell] = totals.get(cell, 0) + sum(map(_digest, group))
    return totals


def _digest(row: tuple[Any, ...]) -> int:
    count = len(row)
    while count and row[count - 1] is None:
        count -= 1
    code = hashlib.blake2b(marshal.dumps(row[:count], FORMAT), digest_size=16)
    return (1 << 128) + int.from_bytes(code.digest())
