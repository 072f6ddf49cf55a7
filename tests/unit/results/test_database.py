import contextlib
import hashlib
import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from running import execute, refusal
from samples import RECORDED, cell_row, query_rows

from vibench.errors import RequestError, StorageError
from vibench.execution.recording import claimed
from vibench.results import database as module
from vibench.results.database import ResultsDatabase
from vibench.results.read import read_table, results_file
from vibench.results.schema import STORED, TABLES, VERSION
from vibench.results.sqlite import FILE, DamagedResultsError, connect, open_read_only, read_meta, read_rows, set_aside
from vibench.text import LONGEST


def test_cells_come_back_as_written_after_a_crash_and_in_the_next_run(journal: ResultsDatabase, tmp_path: Path) -> None:
    """What a copy of the folder holds while the journal is open is what a crash would leave."""
    run, rows = tmp_path / "run", (cell_row("c1"), query_rows("c1", 3))
    assert [row for table in TABLES for row in journal.rows(table)] == []
    assert read_meta(run / FILE)["schema"] == str(VERSION)
    journal.write_cell(*rows)
    shutil.copytree(run, tmp_path / "copy")
    with contextlib.closing(ResultsDatabase(tmp_path / "copy", RECORDED)) as crashed:
        for found in (journal, crashed):
            assert (list(found.rows("cells")), list(found.rows("queries"))) == ([rows[0]], rows[1])
    journal.write_cell({"cell": "c2", "status": "timeout", "code": "old"}, [])
    journal.close()
    with contextlib.closing(ResultsDatabase(run, RECORDED)) as again:
        missing = dict.fromkeys(STORED["cells"]) | {"cell": "c2", "status": "timeout", "code": "old"}
        assert list(again.rows("cells")) == [rows[0], missing]
        assert again.finished() == {"c1": ("ok", "text"), "c2": ("timeout", "old")}
        again.write_cell(cell_row("c3"), [row | {"mu_3": 3.0} for row in query_rows("c3", 1, mu_1=9.0)])
        again.write_cell(cell_row("c4"), query_rows("c4", 1))
        parameters = [(row["mu_1"], row["mu_2"], row["mu_3"]) for row in again.rows("queries")]
    assert parameters[2:] == [(0.2, 4.0, None), (9.0, 2.0, 3.0), (0.0, 2.0, None)]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"status": None}, ["'status'", "'queries'", "missing"]), ({"gap": object()}, ["'gap'", "object is no REAL"]),
        ({"gap": "wide"}, ["'gap'", "str is no REAL"]), ({"gap": 10**400}, ["'gap'", "too large"]),
        ({"iterations": 2**80}, ["'iterations'", "81 bits"]), ({"iterations": 2.5}, ["'iterations'", "float"]),
        ({"mu_1": [1.0]}, ["'mu_1'", "list is no REAL"]), ({"surprise": 1.0}, ["no column named surprise"]),
        ({"cell": "of nobody"}, ["FOREIGN KEY"]),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)  # fmt: skip
@pytest.mark.parametrize("position", [0, 2])
def test_a_row_that_cannot_be_stored_costs_its_cell_and_no_other(
    fault: dict[str, Any], words: list[str], position: int, journal: ResultsDatabase, tmp_path: Path
) -> None:
    queries = query_rows(count=3)
    queries[position] |= fault
    stored = journal.write_cell(cell_row(error_u_mean=0.5, definition="{}"), queries)
    journal.write_cell(cell_row("c2"), query_rows("c2"))
    failed, fine = journal.rows("cells")
    assert {name: value for name, value in failed.items() if value is not None} == stored
    assert (failed["cell"], failed["status"], failed["queries_ok"], failed["queries"]) == ("c1", "error", 0, 3)
    assert failed["reason"].startswith("the results cannot be stored: ")
    assert [word for word in words if word not in failed["reason"]] == []
    assert (failed["code"], failed["definition"], failed["solver"]) == ("text", "{}", "text")
    assert failed["error_u_mean"] is None
    assert fine["status"] == "ok"
    assert {row["cell"] for row in journal.rows("queries")} == {"c2"}
    assert journal.finished() == {"c1": ("error", "text"), "c2": ("ok", "text")}  # a later run resumes behind both


def test_what_cannot_be_stored_is_named_and_leaves_nothing_of_earlier_rows(journal: ResultsDatabase) -> None:
    for cell, queries, solutions, words in (
        (cell_row(rank_gap=1j), query_rows(), [], "'rank_gap'"),
        (cell_row(), query_rows(), [{"cell": "c1", "query": 0, "x": "not bytes"}], "'x' of the table 'solutions'"),
        (cell_row(), [*query_rows(count=1), *query_rows(status=None)], [], "'status'"),
    ):
        journal.write_cell(cell_row(), query_rows())
        before = list(journal.rows("cells")), list(journal.rows("queries"))
        assert words in journal.write_cell(cell, queries, solutions)["reason"]
        assert [row["status"] for row in journal.rows("cells")] == ["error"]
        assert list(journal.rows("queries")) == []
    # a disk that fails is no fault of the values
    journal.write_cell(cell_row(), query_rows())
    journal._db.execute("PRAGMA query_only=ON")
    with pytest.raises(StorageError, match="cannot be written"):
        journal.write_cell(cell_row(status="error"), query_rows(count=1))
    assert (list(journal.rows("cells")), list(journal.rows("queries"))) == before


@given(st.text(st.characters()), st.integers(-(10**300), 10**300) | st.floats() | st.none())
def test_any_text_and_any_number_can_be_written_and_read(text: str, number: Any) -> None:
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.closing(ResultsDatabase(Path(folder), RECORDED)) as journal,
    ):
        columns = {"problem": text, "dual": text, "primal": text, "reason": text, "solver": text}
        content = {text.encode("utf-8", "replace").decode(): number}
        options = json.dumps(content, ensure_ascii=False)
        journal.write_cell(cell_row(fallbacks=text, definition=options, **columns), query_rows(**columns, gap=number))
        history = {"artefact": "a", "stage": "pod", "problem": text, "step": 0, "quantity": text, "value": 1.0}
        for value in (1.0, 2.0):
            journal.write_histories([[history | {"value": value}]])
        for table, count in (("cells", 1), ("queries", 2), ("histories", 1)):
            found = list(journal.rows(table))
            assert len(found) == count, table
            assert all(value.isprintable() for row in found for value in row.values() if isinstance(value, str))
        assert str(json.loads(next(journal.rows("cells"))["definition"])) == str(content)


def test_a_long_text_is_cut_and_json_is_not(journal: ResultsDatabase) -> None:
    whole = json.dumps({"points": list(range(5000))})
    journal.write_cell(cell_row(reason="x" * 50_000_000, problem_options=whole, definition=whole), [])
    (row,) = journal.rows("cells")
    assert (row["problem_options"], row["definition"]) == (whole, whole)
    assert row["reason"].endswith("x… (50000000 characters)")
    assert len(row["reason"]) == 2 * LONGEST


def test_names_like_uris_are_names_and_those_of_no_text_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("file:run", "file:run?mode=memory", "a%20b#c", ":memory:", "\udcff"):
        made = ResultsDatabase(Path(name), RECORDED)
        made.write_cell(cell_row(), [])
        made.close()
        assert read_meta(Path(name) / FILE)["schema"] == str(VERSION)
        assert (tmp_path / name / FILE).is_file()
    assert len(list(tmp_path.iterdir())) == 5
    ResultsDatabase(tmp_path, RECORDED).close()
    path = tmp_path / FILE
    path.write_bytes(path.read_bytes().replace(b'"peak_memory_mib"', b'"\xa0eak_memory_mib"'))
    assert "the columns of the table 'cells' are not those" in refusal(lambda: read_rows(path, "cells"))
    assert "the columns of the table 'cells' are not those" in refusal(lambda: ResultsDatabase(tmp_path, RECORDED))


def test_rewritten_cells_thresholds_and_histories_replace_earlier_ones(journal: ResultsDatabase) -> None:
    history = {"artefact": "pod-1", "stage": "pod", "quantity": "error", "step": 0, "value": 1.0}
    journal.write_histories([[history, history | {"step": 1, "value": 0.5}]])
    journal.write_histories([[history | {"artefact": "pod-2", "pod_tol": 0.75}]])
    # SQLite would take NumPy's integers for bytes
    journal.write_histories([[history | {"value": np.int64(2)}]])
    journal.write_cell(cell_row(N=np.int64(12)), query_rows(count=1, iterations=np.int32(7)))
    assert (next(journal.rows("cells"))["N"], next(journal.rows("queries"))["iterations"]) == (12, 7)
    with pytest.raises(sqlite3.Error):
        journal.write_histories([[history | {"step": 1}, history | {"surprise": 1}]])
    found = sorted((row["artefact"], row["step"], row["value"]) for row in journal.rows("histories"))
    assert found == [("pod-1", 0, 2), ("pod-2", 0, 1.0)]
    journal.write_cell(cell_row("c1", status="error"), query_rows("c1", 4))
    journal.write_cell(cell_row("c2"), query_rows("c2", 2))
    journal.write_cell(cell_row("c1"), query_rows("c1", 1, gap=0.25))
    assert {row["cell"]: row["status"] for row in journal.rows("cells")} == {"c1": "ok", "c2": "ok"}
    assert sorted((row["cell"], row["query"]) for row in journal.rows("queries")) == [("c1", 0), ("c2", 0), ("c2", 1)]
    assert [row["gap"] for row in journal.rows("queries") if row["cell"] == "c1"] == [0.25]
    row = {"problem": "p", "benefit_threshold": 3.0, "meaning": "from"}
    journal.replace("thresholds", [row, row])
    journal.replace("thresholds", [row | {"benefit_threshold": 4.0}])
    assert [row["benefit_threshold"] for row in journal.rows("thresholds")] == [4.0]


def test_other_studies_are_refused(journal: ResultsDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    journal.write_cell(cell_row(), query_rows())
    journal.close()
    before = (run / FILE).read_bytes()
    for key, value in (("name", "other"), ("seed", 2), ("validation", 5), ("accuracy", 1e-8)):
        line = refusal(lambda key=key, value=value: ResultsDatabase(run, RECORDED | {key: value}))
        for words in (f"{run}", "another study", f"{key} {RECORDED[key]!r} instead of {value!r}"):
            assert words in line
    with monkeypatch.context() as patch:
        patch.setattr(module, "VERSION", VERSION + 1)
        line = refusal(lambda: ResultsDatabase(run, RECORDED))
    assert f"schema {VERSION}" in line
    assert str(VERSION + 1) in line
    assert (run / FILE).read_bytes() == before
    with contextlib.closing(sqlite3.connect(run / FILE)) as db:
        db.execute("UPDATE meta SET value = 'nonsense' WHERE key = 'study'")
        db.commit()
    assert FILE in refusal(lambda: ResultsDatabase(run, RECORDED))


def test_folders_and_files_that_cannot_be_made_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    assert "cannot be written" in refusal(lambda: ResultsDatabase(tmp_path / "file" / "below", RECORDED))
    assert "output folder" in refusal(lambda: ResultsDatabase(tmp_path / ("a" * 300), RECORDED))
    if Path("/proc").is_dir():  # where nobody can write
        assert "cannot be written" in refusal(lambda: ResultsDatabase(Path("/proc/vibench"), RECORDED))

    def locked(*_: object, **__: object) -> None:
        raise sqlite3.OperationalError("database is locked")

    monkeypatch.setattr(module.sqlite3, "connect", locked)
    line = refusal(lambda: ResultsDatabase(tmp_path / "run", RECORDED))
    assert "cannot be written" in line
    assert "locked" in line


def test_a_file_that_is_no_results_file_is_refused_unless_a_killed_run_left_it_empty(tmp_path: Path) -> None:
    (tmp_path / FILE).touch()
    with contextlib.closing(ResultsDatabase(tmp_path, RECORDED)) as made:
        assert made.finished() == {}
    (tmp_path / FILE).unlink()
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as db:
        db.execute("CREATE TABLE notes (text TEXT)")
    for content in (None, b"hello", b"SQLite format 3\x00 and then nothing"):
        if content:
            (tmp_path / FILE).write_bytes(content)
        before, line = (tmp_path / FILE).read_bytes(), refusal(lambda: ResultsDatabase(tmp_path, RECORDED))
        assert FILE in line
        assert "not a results file" in line
        assert content is None or (tmp_path / FILE).read_bytes() == before


def test_histories_of_other_code_give_way_and_parts_of_a_sweep_stay(tmp_path: Path) -> None:
    journal = ResultsDatabase(tmp_path, {"name": "some"})

    def rows(artefact: str, stage: str, first: int, count: int) -> list[dict[str, Any]]:
        keys = {"artefact": artefact, "stage": stage, "problem": "wire", "quantity": "error"}
        return [keys | {"step": first + k, "value": 1.0} for k in range(count)]

    journal.write_histories([rows("old", "pod", 0, 5)])
    journal.write_histories([rows("new", "pod", 0, 3)])
    for first, artefact in ((0, "a"), (4, "b"), (0, "c")):
        journal.write_histories([rows(artefact, "training", first, 4)], partial=True)
    found = [(row["stage"], row["artefact"], row["step"]) for row in journal.rows("histories")]
    journal.close()
    assert sorted(found) == sorted(
        [("pod", "new", k) for k in range(3)] + [("training", "c", k) for k in range(4)]
        + [("training", "b", k) for k in range(4, 8)]
    )  # fmt: skip


NOBODY = 65534


@pytest.fixture
def database(journal: ResultsDatabase) -> ResultsDatabase:
    journal.write_cell(cell_row(), [])
    return journal


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
        with contextlib.closing(ResultsDatabase(tmp_path / "run", RECORDED)) as other:
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
def test_what_a_killed_run_left_is_readable(ends: tuple[str, ...], database: ResultsDatabase, tmp_path: Path) -> None:
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


def test_files_that_are_missing_of_others_or_of_a_path_too_long_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="unable to open"):
        read_meta(tmp_path / FILE)
    assert list(tmp_path.iterdir()) == []
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as other:
        other.execute("CREATE TABLE notes (text TEXT)")
    with pytest.raises(RequestError) as caught:
        read_meta(tmp_path / FILE)
    assert not isinstance(caught.value, DamagedResultsError)
    with pytest.raises(RequestError, match="has a path of 601 bytes, and SQLite opens none beyond 504"):
        connect(Path(f"/{'d' * 600}/"), "ro")
    (tmp_path / FILE).unlink()
    ResultsDatabase(tmp_path, RECORDED).close()
    with (tmp_path / FILE).open("r+b") as file:  # the first page is overwritten
        file.write(b"\xff" * 2000)
    assert "--fresh, which keeps it as results.sqlite.damaged" in refusal(ResultsDatabase, tmp_path, RECORDED)


def test_a_file_set_aside_takes_its_log_along(database: ResultsDatabase, tmp_path: Path) -> None:
    """A new file of its name would be recovered from the old log."""
    path = tmp_path / "run" / FILE
    copy = tmp_path / "copy" / FILE
    copy.parent.mkdir()
    for end in ("", "-wal", "-shm"):
        shutil.copyfile(f"{path}{end}", f"{copy}{end}")
    set_aside(copy)
    assert {path.name for path in copy.parent.iterdir()} == {f"{FILE}.damaged", f"{FILE}.damaged-wal"}
    with claimed(copy.parent), contextlib.closing(ResultsDatabase(copy.parent, RECORDED)) as anew:
        assert list(anew.rows("cells")) == []


def test_text_is_printable_and_kept_once(journal: ResultsDatabase, tmp_path: Path) -> None:
    journal.write_cell(cell_row(), [])
    execute(tmp_path / "run", "UPDATE cells SET reason = CAST(x'411b5b324aff' AS TEXT), problem = 'a' || char(10)")
    with open_read_only(tmp_path / "run" / FILE) as db:
        assert db.execute("SELECT problem, reason FROM cells").fetchall() == [("a\\n", "A\\u001b[2J\ufffd")]
    # The histories of a large study have tens of millions of texts, and hundreds that differ.
    for key in ("one", "other"):
        journal.write_cell(cell_row(cell=key, reason="neither a letter nor a name"), [])
    names, (_, one, other) = read_rows(tmp_path / "run" / FILE, "cells")
    reason = names.index("reason")
    assert one[reason] == "neither a letter nor a name"
    assert one[reason] is other[reason]
    assert read_meta(Path(f"/{tmp_path}") / "run" / FILE)["schema"] == str(VERSION)


def test_other_columns_are_another_version() -> None:
    """A file with other columns under the same version would be refused as damaged."""
    declared = [
        (table, *((name, f"{column.kind} {column.constraint}".strip()) for name, column in columns.items()))
        for table, columns in STORED.items()
    ]
    # the first digits of the digest of tables and columns, by version
    assert {VERSION: hashlib.sha256(repr(declared).encode()).hexdigest()[:4]} == {24: "b3b9"}
