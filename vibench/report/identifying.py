"""Removal of paths, user and host from results that are published, and a list of what could still identify somebody."""

from __future__ import annotations

import contextlib
import getpass
import json
import platform
import re
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

from vibench.errors import RequestError
from vibench.results.schema import KEYS, STORED, SqlType
from vibench.results.sqlite import Digests, open_read_only, read_meta, read_rows, text_reader
from vibench.text import brief, json_object, unbroken


def cleaned(path: Path, copy: Path) -> None:
    """Write a copy of a results file without absolute paths, the names of user and host, and the home directory.

    The name of a file at the end of a path stays, if it has an ending. Places of packs and files of points are removed;
    their paths beside the study stay, and the hashes of their content are part of those of the code.

    Raises a `RequestError` if the file is damaged, or the copy cannot be written.
    """
    read_meta(path)
    try:
        copy.parent.mkdir(parents=True)
        with open_read_only(path) as db:
            db.execute("VACUUM INTO ?", (str(copy.absolute()),))
        parents = {Path(place).parent for place in _places(path)}
        # Longer names first: those of folders in others would leave parts of them.
        folders = sorted((str(one) for one in parents if len(one.parts) > 2), key=len, reverse=True)
        inside = [re.compile(rf"(?<!\w){re.escape(folder)}(?![\w-])") for folder in folders]
        texts = {
            table: [name for name in columns if columns[name].kind == SqlType.TEXT] for table, columns in STORED.items()
        }
        with closing(sqlite3.connect(copy)) as db, db:
            db.text_factory = text_reader()
            for table, columns in {"meta": ("value",), **texts}.items():
                if table != "meta":
                    # Refuses damage, which new digests would hide.
                    read_rows(path, table)
                if sum(_clean(db, table, column, inside) for column in columns):
                    digests = Digests(db)
                    digests.forget(name=table)
                    digests.count(table)
        with closing(sqlite3.connect(copy)) as db:
            # Free pages still have the replaced values.
            db.execute("VACUUM")
    except (OSError, sqlite3.Error) as error:
        raise RequestError(f"a copy of '{path}' cannot be written to '{copy.parent}': {error}") from None


def left(paths: Sequence[Path], names: Sequence[str], authors: Sequence[str]) -> Iterator[str]:
    """Lines on what could still identify somebody in cleaned results."""
    yield f"names of runs: {', '.join(names)}"
    if authors:
        yield f"authors: {'; '.join(authors)}"
    tables = [read_rows(path, "cells") for path in paths]
    rows = [dict(zip(columns, row, strict=True)) for columns, found in tables for row in found]
    shown = {
        "machines": ("machine",),
        "labels": ("problem", "training", "formulation", "dual", "primal", "validation"),
        "options": (*(name for name in KEYS if name.endswith("_options")), "validation_options"),
    }
    for title, columns in shown.items():
        values = {str(row[column]) for row in rows for column in columns} - {"{}", "None"}
        if values:
            yield f"{title}: {brief('; '.join(sorted(map(unbroken, values))), 500)}"
    texts = {str(value) for row in rows for value in row.values() if isinstance(value, str)}
    for what, name, pattern in _identities():
        if any(pattern.search(text) for text in texts):
            yield f"the {what} '{name}', in a name or an option"


def _identities() -> list[tuple[str, str, re.Pattern[str]]]:
    """Kind, text and pattern of the names of user and machine, the longest first."""
    found = [("name of the host", platform.node())]
    with contextlib.suppress(RuntimeError):
        found.append(("home directory", str(Path.home())))
    with contextlib.suppress(OSError, KeyError):
        found.append(("user's name", getpass.getuser()))
    long = sorted((one for one in found if len(one[1]) > 1), key=lambda one: -len(one[1]))
    return [(what, name, re.compile(rf"(?<!\w){re.escape(name)}(?!\w)")) for what, name in long]


def _places(path: Path) -> Iterator[str]:
    """Absolute places of the files and folders that cells read."""
    names, rows = read_rows(path, "cells")
    for definition in {row[names.index("definition")] for row in rows}:
        for plugin in (json_object(definition) or {}).values():
            recorded = json_object(plugin.get("places")) if isinstance(plugin, dict) else None
            yield from (str(place) for place in (recorded or {}).values() if str(place).startswith("/"))


def _clean(db: sqlite3.Connection, table: str, column: str, folders: Sequence[re.Pattern[str]]) -> int:
    """Clean the values of a column; returns the number of changed ones."""
    # An absolute path of two parts at least, in a text or in JSON.
    path = re.compile(r"""(?<![\w./])(?:/[^/\s'"`\\:;,<>|()\[\]{}]+){2,}/?""")
    query = f'SELECT DISTINCT CAST("{column}" AS BLOB) FROM "{table}" WHERE "{column}" IS NOT NULL'
    values = db.execute(query).fetchall()
    # Values that identify rows must stay different, so that names in them stay.
    identifies = column in {*KEYS, "cell", "solver_a", "solver_b", "status"}
    names = [] if identifies else [pattern for *_, pattern in _identities()]
    changed = 0
    for (value,) in values:
        text = value.decode(errors="surrogateescape")
        new = _without_places(text) if column == "definition" else text
        for folder in folders:
            new = folder.sub("…", new)
        new = path.sub(_file, new)
        for name in names:
            new = name.sub("…", new)
        if new != text:
            changed += 1
            change = f'UPDATE "{table}" SET "{column}" = CAST(? AS TEXT) WHERE CAST("{column}" AS BLOB) = ?'
            db.execute(change, (new.encode(errors="surrogateescape"), value))
    return changed


def _without_places(definition: str) -> str:
    content = json_object(definition)
    for plugin in (content or {}).values():
        if isinstance(plugin, dict) and "places" in plugin:
            plugin["places"] = "{}"
    return definition if content is None else json.dumps(content, sort_keys=True, ensure_ascii=False)


def _file(match: re.Match[str]) -> str:
    """The name of the file of a path, if it has an ending."""
    name = match[0].rsplit("/", 1)[-1]
    return f"…/{name}" if Path(name).suffix else "…"
