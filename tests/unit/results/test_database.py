"""The results file: one transaction a cell, and no mixture of studies."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import RECORDED, cell_row, query_rows

from vibench.errors import RequestError, StorageError
from vibench.results import database as module
from vibench.results.database import ResultsDatabase
from vibench.results.schema import STORED, TABLES, VERSION
from vibench.results.sqlite import FILE, read_meta, read_rows
from vibench.text import LONGEST


def seen(folder: Path, table: str) -> list[tuple[Any, ...]]:
    """The rows of a table as another process sees them."""
    db = sqlite3.connect(folder / FILE)
    try:
        return db.execute(f"SELECT * FROM {table}").fetchall()
    finally:
        db.close()


def refusal(action: Callable[[], object]) -> str:
    with pytest.raises(RequestError) as caught:
        action()
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_a_new_folder_gets_every_table(journal: ResultsDatabase, tmp_path: Path) -> None:
    for table in TABLES:
        assert list(journal.rows(table)) == []
    assert read_meta(tmp_path / "run" / FILE)["schema"] == str(VERSION)


def test_a_cell_and_its_queries_come_back_as_written(journal: ResultsDatabase, tmp_path: Path) -> None:
    cell, queries = cell_row(), query_rows(count=3)
    journal.write_cell(cell, queries)
    assert list(journal.rows("cells")) == [cell]
    assert list(journal.rows("queries")) == queries
    assert len(seen(tmp_path / "run", "queries")) == 3


def test_missing_columns_are_null(journal: ResultsDatabase) -> None:
    journal.write_cell({"cell": "c1", "status": "error"}, [])
    (row,) = journal.rows("cells")
    assert row == dict.fromkeys(STORED["cells"]) | {"cell": "c1", "status": "error"}


def test_columns_are_added_for_every_parameter(journal: ResultsDatabase) -> None:
    journal.write_cell(cell_row("c1"), [row | {"mu_3": 3.0} for row in query_rows("c1", 1)])
    journal.write_cell(cell_row("c2"), query_rows("c2", 1, mu_1=9.0))
    first, second = journal.rows("queries")
    assert (first["mu_1"], first["mu_2"], first["mu_3"]) == (0.0, 2.0, 3.0)
    assert (second["mu_1"], second["mu_2"], second["mu_3"]) == (9.0, 2.0, None)


def test_columns_of_parameters_are_found_again(journal: ResultsDatabase, tmp_path: Path) -> None:
    journal.write_cell(cell_row("c1"), query_rows("c1"))
    again = ResultsDatabase(tmp_path / "run", RECORDED)
    again.write_cell(cell_row("c2"), query_rows("c2"))
    assert len(list(again.rows("queries"))) == 4
    again.close()


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


def test_a_column_of_the_cell_itself_that_cannot_be_stored_is_named(journal: ResultsDatabase) -> None:
    assert "'rank_gap'" in journal.write_cell(cell_row(rank_gap=1j), query_rows())["reason"]
    assert list(journal.rows("queries")) == []


def test_solutions_that_cannot_be_stored_are_named(journal: ResultsDatabase) -> None:
    stored = journal.write_cell(cell_row(), query_rows(), [{"cell": "c1", "query": 0, "x": "not bytes"}])
    assert "'x' of the table 'solutions'" in stored["reason"]


def test_a_rewrite_that_cannot_be_stored_leaves_nothing_of_the_earlier_rows(journal: ResultsDatabase) -> None:
    journal.write_cell(cell_row(), query_rows())
    journal.write_cell(cell_row(), [*query_rows(count=1), *query_rows(status=None)])
    assert [row["status"] for row in journal.rows("cells")] == ["error"]
    assert list(journal.rows("queries")) == []


def test_a_disk_that_fails_is_no_fault_of_the_values(journal: ResultsDatabase) -> None:
    journal.write_cell(cell_row(), query_rows())
    before = list(journal.rows("cells")), list(journal.rows("queries"))
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


def test_a_name_that_looks_like_a_uri_is_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("file:run", "file:run?mode=memory", "a%20b#c", ":memory:", "\udcff"):
        made = ResultsDatabase(Path(name), RECORDED)
        made.write_cell(cell_row(), [])
        made.close()
        assert read_meta(Path(name) / FILE)["schema"] == str(VERSION)
        assert (tmp_path / name / FILE).is_file()
    assert len(list(tmp_path.iterdir())) == 5


def test_a_rewritten_cell_has_only_its_new_queries(journal: ResultsDatabase) -> None:
    journal.write_cell(cell_row("c1", status="error"), query_rows("c1", 4))
    journal.write_cell(cell_row("c2"), query_rows("c2", 2))
    journal.write_cell(cell_row("c1"), query_rows("c1", 1, gap=0.25))
    assert {row["cell"]: row["status"] for row in journal.rows("cells")} == {"c1": "ok", "c2": "ok"}
    assert sorted((row["cell"], row["query"]) for row in journal.rows("queries")) == [("c1", 0), ("c2", 0), ("c2", 1)]
    assert [row["gap"] for row in journal.rows("queries") if row["cell"] == "c1"] == [0.25]


def test_finished_tells_status_and_code(journal: ResultsDatabase) -> None:
    journal.write_cell(cell_row("c1", status="ok", code="new"), [])
    journal.write_cell(cell_row("c2", status="timeout", code="old"), [])
    assert journal.finished() == {"c1": ("ok", "new"), "c2": ("timeout", "old")}


def test_what_was_written_is_there_for_the_next_run(journal: ResultsDatabase, tmp_path: Path) -> None:
    journal.write_cell(cell_row(), query_rows())
    journal.close()
    again = ResultsDatabase(tmp_path / "run", RECORDED)
    assert len(again.finished()) == 1
    assert len(list(again.rows("queries"))) == 2
    again.close()


def test_a_run_that_dies_loses_no_written_cell(journal: ResultsDatabase, tmp_path: Path) -> None:
    """What a copy of the folder holds while the journal is open is what a crash would leave."""
    journal.write_cell(cell_row(), query_rows())
    shutil.copytree(tmp_path / "run", tmp_path / "copy")
    again = ResultsDatabase(tmp_path / "copy", RECORDED)
    assert len(list(again.rows("cells"))) == 1
    assert len(list(again.rows("queries"))) == 2
    again.close()


HISTORY = {"artefact": "pod-1", "stage": "pod", "quantity": "error", "step": 0, "value": 1.0}


def test_histories_replace_those_of_the_same_name(journal: ResultsDatabase) -> None:
    journal.write_histories([[HISTORY, HISTORY | {"step": 1, "value": 0.5}]])
    journal.write_histories([[HISTORY | {"artefact": "pod-2", "pod_tol": 0.75}]])
    journal.write_histories([[HISTORY | {"value": 0.25}]])
    found = sorted((row["artefact"], row["step"], row["value"]) for row in journal.rows("histories"))
    assert found == [("pod-1", 0, 0.25), ("pod-2", 0, 1.0)]


def test_a_failing_write_of_histories_leaves_the_earlier_ones(journal: ResultsDatabase) -> None:
    journal.write_histories([[HISTORY]])
    with pytest.raises(sqlite3.Error):
        journal.write_histories([[HISTORY | {"step": 1}, HISTORY | {"surprise": 1}]])
    assert [row["step"] for row in journal.rows("histories")] == [0]


def test_thresholds_replace_all_earlier_ones(journal: ResultsDatabase) -> None:
    row = {"problem": "p", "benefit_threshold": 3.0, "meaning": "from"}
    journal.replace("thresholds", [row, row])
    journal.replace("thresholds", [row | {"benefit_threshold": 4.0}])
    assert [row["benefit_threshold"] for row in journal.rows("thresholds")] == [4.0]


def test_numbers_of_numpy_are_stored_as_numbers(journal: ResultsDatabase) -> None:
    """SQLite would take NumPy's integers for bytes."""
    journal.write_cell(cell_row(N=np.int64(12)), query_rows(count=1, iterations=np.int32(7)))
    journal.write_histories([[HISTORY | {"value": np.int64(2)}]])
    assert next(journal.rows("cells"))["N"] == 12
    assert next(journal.rows("queries"))["iterations"] == 7
    assert next(journal.rows("histories"))["value"] == 2


@pytest.mark.parametrize(("key", "value"), [("name", "other"), ("seed", 2), ("validation", 5), ("accuracy", 1e-8)])
def test_results_of_another_study_are_refused(key: str, value: Any, journal: ResultsDatabase, tmp_path: Path) -> None:
    line = refusal(lambda: ResultsDatabase(tmp_path / "run", RECORDED | {key: value}))
    assert str(tmp_path / "run") in line
    assert "another study" in line
    assert f"{key} {RECORDED[key]!r} instead of {value!r}" in line


def test_results_of_another_schema_are_refused(
    journal: ResultsDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "VERSION", VERSION + 1)
    line = refusal(lambda: ResultsDatabase(tmp_path / "run", RECORDED))
    assert f"schema {VERSION}" in line
    assert str(VERSION + 1) in line


def test_a_refused_folder_is_left_as_it_was(journal: ResultsDatabase, tmp_path: Path) -> None:
    journal.write_cell(cell_row(), query_rows())
    journal.close()
    before = (tmp_path / "run" / FILE).read_bytes()
    refusal(lambda: ResultsDatabase(tmp_path / "run", RECORDED | {"seed": 2}))
    assert (tmp_path / "run" / FILE).read_bytes() == before


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "cannot be written" in refusal(lambda: ResultsDatabase(tmp_path / "file" / "below", RECORDED))


def test_a_name_of_a_column_that_is_no_text_is_damage(tmp_path: Path) -> None:
    ResultsDatabase(tmp_path, RECORDED).close()
    path = tmp_path / FILE
    path.write_bytes(path.read_bytes().replace(b'"peak_memory_mib"', b'"\xa0eak_memory_mib"'))
    assert "the columns of the table 'cells' are not those" in refusal(lambda: read_rows(path, "cells"))
    assert "the columns of the table 'cells' are not those" in refusal(lambda: ResultsDatabase(tmp_path, RECORDED))


def test_an_empty_folder_will_do(tmp_path: Path) -> None:
    made = ResultsDatabase(tmp_path, RECORDED)
    made.write_cell(cell_row(), [])
    assert len(list(made.rows("cells"))) == 1
    made.close()


@pytest.mark.parametrize("content", [b"hello", b"SQLite format 3\x00 and then nothing"], ids=["text", "cut off"])
def test_a_file_that_is_no_database_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(content)
    line = refusal(lambda: ResultsDatabase(tmp_path, RECORDED))
    assert FILE in line
    assert "not a results file" in line
    assert (tmp_path / FILE).read_bytes() == content


def test_a_database_of_something_else_is_refused(tmp_path: Path) -> None:
    db = sqlite3.connect(tmp_path / FILE)
    db.execute("CREATE TABLE notes (text TEXT)")
    db.close()
    assert "not a results file" in refusal(lambda: ResultsDatabase(tmp_path, RECORDED))


def test_a_results_file_with_a_broken_study_is_refused(journal: ResultsDatabase, tmp_path: Path) -> None:
    db = sqlite3.connect(tmp_path / "run" / FILE)
    db.execute("UPDATE meta SET value = 'nonsense' WHERE key = 'study'")
    db.commit()
    db.close()
    assert FILE in refusal(lambda: ResultsDatabase(tmp_path / "run", RECORDED))


def test_a_file_left_empty_by_a_killed_run_is_taken_over(tmp_path: Path) -> None:
    (tmp_path / FILE).touch()
    made = ResultsDatabase(tmp_path, RECORDED)
    assert made.finished() == {}
    made.close()


def test_a_name_no_folder_can_have_is_refused(tmp_path: Path) -> None:
    assert "output folder" in refusal(lambda: ResultsDatabase(tmp_path / ("a" * 300), RECORDED))


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder nobody can write to")
def test_a_folder_that_cannot_be_made_is_refused() -> None:
    assert "cannot be written" in refusal(lambda: ResultsDatabase(Path("/proc/vibench"), RECORDED))


def test_a_database_that_cannot_be_opened_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def locked(*_: object, **__: object) -> None:
        raise sqlite3.OperationalError("database is locked")

    monkeypatch.setattr(module.sqlite3, "connect", locked)
    line = refusal(lambda: ResultsDatabase(tmp_path / "run", RECORDED))
    assert "cannot be written" in line
    assert "locked" in line


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
