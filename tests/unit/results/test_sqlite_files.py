"""Results files that others lock, remove, replace, damage, or keep where nothing can be written."""

import contextlib
import hashlib
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from running import execute
from samples import cell_row

from vibench.errors import RequestError, StorageError
from vibench.execution.recording import claimed
from vibench.results.database import ResultsDatabase
from vibench.results.read import read_table, results_file
from vibench.results.schema import STORED, VERSION
from vibench.results.sqlite import DAMAGED, FILE, DamagedResultsError, open_read_only, read_meta, read_rows, set_aside

STUDY = {"name": "sample", "seed": 1, "validation": 4}
NOBODY = 65534


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ResultsDatabase]:
    made = ResultsDatabase(tmp_path / "run", STUDY)
    made.write_cell(cell_row(), [])
    yield made
    made.close()


def test_a_lock_is_waited_for_and_named_if_it_is_never_released(database: ResultsDatabase, tmp_path: Path) -> None:
    """A minute, not SQLite's five seconds; the wait itself is SQLite's."""
    assert database._db.execute("PRAGMA busy_timeout").fetchone() == (60_000,)
    with open_read_only(tmp_path / "run" / FILE) as db:
        assert db.execute("PRAGMA busy_timeout").fetchone() == (60_000,)
    database._db.execute("PRAGMA busy_timeout=1")
    with contextlib.closing(sqlite3.connect(tmp_path / "run" / FILE)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StorageError, match="database is locked by another program for 60 s"):
            database.write_cell(cell_row("c2"), [])
    database.write_cell(cell_row("c2"), [])
    assert [row["cell"] for row in database.rows("cells")] == ["c1", "c2"]


@pytest.mark.parametrize("replaced", [False, True])
def test_a_file_that_is_gone_is_noticed_at_a_commit(replaced: bool, database: ResultsDatabase, tmp_path: Path) -> None:
    (tmp_path / "run").rename(tmp_path / "elsewhere")
    if replaced:
        with contextlib.closing(ResultsDatabase(tmp_path / "run", STUDY)) as other:
            other.write_cell(cell_row("theirs"), [])
    for write in (
        lambda: database.write_cell(cell_row("c2"), []),
        lambda: database.replace("thresholds", []),
        lambda: database.write_seconds("c1", {"timing_rounds": 3}, {}, []),
    ):
        with pytest.raises(StorageError, match=r"run/results.sqlite' was removed or replaced during the run"):
            write()
    database.close()
    assert read_table(tmp_path / "elsewhere" / FILE, "cells")["cell"].tolist() == ["c1"]
    if replaced:
        assert read_table(tmp_path / "run" / FILE, "cells")["cell"].tolist() == ["theirs"]


@contextlib.contextmanager
def without_privileges() -> Iterator[None]:
    """For root no folder is read-only."""
    before = os.geteuid()
    if before == 0:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(before)


@pytest.mark.parametrize("ends", [("",), ("", "-wal"), ("", "-wal", "-shm")], ids=["alone", "log", "log and index"])
def test_what_a_killed_run_left_is_read_in_a_folder_that_cannot_be_written(
    ends: tuple[str, ...], database: ResultsDatabase, tmp_path: Path
) -> None:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as parent:
        folder = Path(parent) / "run"
        folder.mkdir()
        if "-wal" not in ends:  # everything is in the file itself, whose header says that there may be a log
            database._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        for end in ends:
            shutil.copyfile(f"{tmp_path / 'run' / FILE}{end}", f"{folder / FILE}{end}")
            Path(f"{folder / FILE}{end}").chmod(0o444)
        folder.chmod(0o555)
        Path(parent).chmod(0o755)
        with without_privileges():
            assert results_file(str(folder)) == folder / FILE
            assert read_table(folder / FILE, "cells")["cell"].tolist() == ["c1"]
            assert sorted(path.name for path in folder.iterdir()) == sorted(FILE + end for end in ends)
        folder.chmod(0o755)


def test_a_file_that_is_not_there_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="unable to open"):
        read_meta(tmp_path / FILE)
    assert list(tmp_path.iterdir()) == []


def damage(path: Path) -> None:
    """Overwrite the first page."""
    with path.open("r+b") as file:
        file.write(b"\xff" * 2000)


def test_a_damaged_file_is_refused_with_what_to_do(tmp_path: Path) -> None:
    ResultsDatabase(tmp_path, STUDY).close()
    damage(tmp_path / FILE)
    with pytest.raises(RequestError) as caught:
        ResultsDatabase(tmp_path, STUDY)
    assert "\n" not in str(caught.value)
    assert "--fresh, which keeps it as results.sqlite.damaged" in str(caught.value)


def test_a_file_set_aside_takes_its_log_along(database: ResultsDatabase, tmp_path: Path) -> None:
    """A new file of its name would be recovered from the old log."""
    path = tmp_path / "run" / FILE
    copy = tmp_path / "copy" / FILE
    copy.parent.mkdir()
    for end in ("", "-wal", "-shm"):
        shutil.copyfile(f"{path}{end}", f"{copy}{end}")
    set_aside(copy)
    assert {path.name for path in copy.parent.iterdir()} == {f"{FILE}{DAMAGED}", f"{FILE}{DAMAGED}-wal"}
    with claimed(copy.parent), contextlib.closing(ResultsDatabase(copy.parent, STUDY)) as anew:
        assert list(anew.rows("cells")) == []


def test_the_file_of_another_application_is_not_damaged(tmp_path: Path) -> None:
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as other:
        other.execute("CREATE TABLE notes (text TEXT)")
    with pytest.raises(RequestError) as caught:
        read_meta(tmp_path / FILE)
    assert not isinstance(caught.value, DamagedResultsError)


def test_what_others_have_written_is_printable_when_it_is_read(journal: ResultsDatabase, tmp_path: Path) -> None:
    journal.write_cell(cell_row(), [])
    execute(tmp_path / "run", "UPDATE cells SET reason = CAST(x'411b5b324aff' AS TEXT), problem = 'a' || char(10)")
    with open_read_only(tmp_path / "run" / FILE) as db:
        assert db.execute("SELECT problem, reason FROM cells").fetchall() == [("a\\n", "A\\u001b[2J\ufffd")]


def test_a_text_of_many_rows_is_kept_once(journal: ResultsDatabase, tmp_path: Path) -> None:
    """The histories of a large study have tens of millions of texts, and hundreds that differ."""
    for key in ("one", "other"):
        journal.write_cell(cell_row(cell=key, reason="neither a letter nor a name"), [])
    names, (one, other) = read_rows(tmp_path / "run" / FILE, "cells")
    reason = names.index("reason")
    assert one[reason] == "neither a letter nor a name"
    assert one[reason] is other[reason]


def test_two_slashes_are_no_authority(journal: ResultsDatabase, tmp_path: Path) -> None:
    assert read_meta(Path(f"/{tmp_path}") / "run" / FILE)["schema"] == str(VERSION)


def test_other_columns_are_another_version() -> None:
    """A file with other columns under the same version would be refused as damaged."""
    declared = [
        (table, *((name, f"{column.kind} {column.constraint}".strip()) for name, column in columns.items()))
        for table, columns in STORED.items()
    ]
    # the first digits of the digest of tables and columns, by version
    assert {VERSION: hashlib.sha256(repr(declared).encode()).hexdigest()[:4]} == {21: "4cee"}
