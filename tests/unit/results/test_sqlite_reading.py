"""Reading a results file; damage: tests/faults/test_damaged_files.py."""

from __future__ import annotations

from pathlib import Path

from running import execute
from samples import cell_row

from vibench.results.database import ResultsDatabase
from vibench.results.schema import VERSION
from vibench.results.sqlite import FILE, open_read_only, read_meta, read_rows


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
