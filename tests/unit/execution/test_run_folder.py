"""The folder of a run: one run at a time, nothing of others."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from vibench.errors import RequestError
from vibench.execution.run_folder import LOG, REPORT, claimed, clear
from vibench.results.database import ResultsDatabase
from vibench.results.sqlite.reading import FILE

STUDY = {"name": "sample", "seed": 1, "validation": 4}


def refusal(folder: Path) -> str:
    """The line with which a folder is refused."""
    with pytest.raises(RequestError) as caught, claimed(folder):
        pass
    return str(caught.value)


def test_a_folder_has_one_run_at_a_time(tmp_path: Path) -> None:
    """The second one is told who the first is; a folder that was claimed before is no foreign one."""
    with claimed(tmp_path / "run"):
        assert f"another run writes into '{tmp_path / 'run'}' (process {os.getpid()} on" in refusal(tmp_path / "run")
    with claimed(tmp_path / "run"):
        pass


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "is a file" in refusal(tmp_path / "file")
    assert "cannot be written" in refusal(tmp_path / "file" / "below")


def test_a_folder_with_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    line = refusal(tmp_path)
    assert "not empty" in line
    assert FILE in line
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_only_what_a_run_writes_is_cleared(tmp_path: Path) -> None:
    ResultsDatabase(tmp_path, STUDY).close()
    (tmp_path / "tables").mkdir()
    made, kept = (LOG, REPORT, "tables/cells.csv"), ("notes.txt", "tables/notes.txt", FILE)
    for name in (*made, "notes.txt", "tables/notes.txt"):
        (tmp_path / name).touch()
    clear(tmp_path, "sample", pytest.fail)
    assert [name for name in (*made, *kept) if (tmp_path / name).exists()] == list(kept)


def test_the_folder_of_another_study_is_not_cleared(tmp_path: Path) -> None:
    ResultsDatabase(tmp_path, STUDY).close()
    (tmp_path / LOG).touch()
    with pytest.raises(RequestError, match="holds results of the study 'sample'"):
        clear(tmp_path, "another", pytest.fail)
    assert (tmp_path / LOG).exists()


def test_a_damaged_results_file_is_kept_under_another_name(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"hello")
    notes: list[str] = []
    clear(tmp_path, "sample", notes.append)
    assert (tmp_path / f"{FILE}.damaged").read_bytes() == b"hello"
    assert len(notes) == 1
    assert "it is kept as" in notes[0]
