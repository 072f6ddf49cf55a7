import hashlib
import os
import pickle
import shutil
import sqlite3
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from running import PATIENCE, execute

from vibench import NumericalError, RequestError
from vibench.cli.result_commands import export, replay_query, show, write_report
from vibench.execution.recording import REPORT, claimed
from vibench.files import locked, write_atomically
from vibench.report import figures
from vibench.results.read import read_table, results_file
from vibench.results.show import export as write_export
from vibench.results.sqlite import FILE
from vibench.stages import artefacts
from vibench.stages.artefacts import Artefact, Store, usable_store
from vibench.timing import NO_TIME


class Payload:
    """Unpickled, it makes a file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.file,)


@pytest.fixture
def run(quick_run: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    shutil.copy(quick_run / FILE, folder)
    return folder


def test_a_planted_artefact_runs_no_code(tmp_path: Path) -> None:
    """Under the name of another and with the digest of its own: it counts as damaged."""
    folder, proof = tmp_path / "store", tmp_path / "proof"
    Store(folder).put("pod-1", 1, NO_TIME, ())
    path = folder / "pod-1.artefact"
    for content in (pickle.dumps(Payload(proof)), pickle.dumps(Artefact(Payload(proof), NO_TIME, (), "here"))):
        for digest in (hashlib.sha256(b"pod-1\0" + content).digest(), bytes(32), path.read_bytes()[:32], b""):
            path.write_bytes(digest + content)
            assert Store(folder).get("pod-1") is None
    assert not proof.exists()
    with pytest.raises(NumericalError, match="Payload cannot be stored"):
        Store(folder).put("pod-2", Payload(proof), NO_TIME, ())
    pickle.loads(pickle.dumps(Payload(proof)))
    assert proof.exists()  # the payload would have run
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(("named", "mode", "refused"), [
    (False, 0o700, False), (False, 0o755, False), (False, 0o775, True), (False, 0o777, True),
    (True, 0o770, False), (True, 0o777, True),
])  # fmt: skip
def test_shared_folders(named: bool, mode: int, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that the user names may be shared with a group on purpose, and never with everybody."""
    monkeypatch.delenv("VIBENCH_CACHE", raising=False)
    monkeypatch.setattr(artefacts.platformdirs, "user_cache_dir", lambda name: str(tmp_path))
    if named:
        monkeypatch.setenv("VIBENCH_CACHE", str(tmp_path))
    usable_store()
    (tmp_path / "artefacts").chmod(mode)
    if refused:
        with pytest.raises(RequestError, match="others may write into the folder for artefacts"):
            usable_store()
    else:
        usable_store()


def test_results_with_code_or_cells_that_name_files_elsewhere_are_refused(run: Path, tmp_path: Path) -> None:
    for kind, planted in (
        ("trigger", "CREATE TRIGGER t AFTER INSERT ON cells BEGIN DELETE FROM queries; END"),
        ("view", "CREATE VIEW t AS SELECT load_extension('x')"),
    ):
        execute(run, planted)
        for command in (show, write_report, partial(export, words=["set"])):
            with pytest.raises(RequestError, match=f"is not a results file of vibench: it has a {kind}"):
                command(str(run))
        execute(run, f"DROP {kind} t")
    (cell,) = sqlite3.connect(run / FILE).execute("SELECT cell FROM cells LIMIT 1").fetchone()
    before = sorted(tmp_path.rglob("*"))
    for name in ("../../outside", "/tmp/outside", "", "0123456789ABCDEF", "0123456789abcde\n"):
        execute(run, "PRAGMA foreign_keys=OFF", f"UPDATE cells SET cell = '{name}' WHERE cell = '{cell}'")
        cell = name
        with pytest.raises(RequestError, match="expected 16 hexadecimal digits"):
            export(str(run), [str(tmp_path / "set")])
        with pytest.raises(RequestError, match="expected 16 hexadecimal digits"):
            replay_query(str(run), name[:4])
        assert sorted(tmp_path.rglob("*")) == before


def test_reports_leave_results_paths_are_names_and_a_damaged_page_is_found(run: Path, tmp_path: Path) -> None:
    before = (run / FILE).read_bytes()
    for out in (run / FILE, run / ".." / run.name / FILE):
        with pytest.raises(RequestError, match="is the results file itself"):
            write_report(str(run), out, figures=False)
    with pytest.raises(RequestError, match="cannot be written"):
        write_report(str(run), run / "nowhere" / "report.html", figures=False)
    assert (run / FILE).read_bytes() == before
    for name in ("a b?mode=rwc", "100%", "#1", "ü//x"):
        (tmp_path / name).mkdir(parents=True)
        shutil.copy(run / FILE, tmp_path / name)
        assert len(read_table(results_file(str(tmp_path / name)), "cells")) == 36
    with pytest.raises(RequestError, match="no results in"):
        show("//nowhere/run")  # the address of a host
    # Most of the file is content; a page whose structure is broken makes every command say so in a line.
    content = bytearray((run / FILE).read_bytes())
    for start in range(4096 * 3, 4096 * 40, 4096):
        content[start : start + 8] = b"\xff" * 8
    (run / FILE).write_bytes(bytes(content))
    with pytest.raises(RequestError, match=r"is damaged|is not a results file"):
        show(str(run))


def test_links_in_place_of_locks_and_tables_are_not_followed(tmp_path: Path, run: Path) -> None:
    valuable = tmp_path / "valuable"
    valuable.write_text("kept")
    folder = tmp_path / "runs"
    folder.mkdir()
    (folder / ".lock").symlink_to(valuable)
    with pytest.raises(RequestError, match="is a symbolic link"), locked(folder / ".lock", busy="busy"):
        pass
    with pytest.raises(RequestError, match="is a symbolic link"), claimed(folder):
        pass
    assert valuable.read_text() == "kept"
    valuable = tmp_path / "valuable"
    valuable.write_text("kept")
    folder = run / "tables"
    folder.mkdir()
    for name in ("cells.csv", "cells.csv.part", "summary.md"):
        (folder / name).symlink_to(valuable)
    write_export(run / FILE, folder)
    (run / REPORT).symlink_to(valuable)
    write_report(str(run), figures=False)
    assert valuable.read_text() == "kept"
    assert not (folder / "cells.csv").is_symlink()


PIPES = """
import os, sys
from pathlib import Path
from vibench.benchmarks.comparison import read_benchmarks
from vibench.errors import RequestError
from vibench.report.figures import read_captions
from vibench.results.database import ResultsDatabase
from vibench.results.read import read_table
from vibench.study.matrix import read_study

folder = Path(sys.argv[1])

def said(name, call):
    os.mkfifo(folder / name)
    try:
        print(call())
    except RequestError as error:
        print(str(error).replace(f"{folder}/", ""))
    (folder / name).unlink()

for end in ("-wal", "-shm", "-journal"):
    said(f"results.sqlite{end}", lambda: read_table(folder / "results.sqlite", "cells"))
    said(f"results.sqlite{end}", lambda: ResultsDatabase(folder, {}, anew=True))
(folder / "results.sqlite").unlink()
said("results.sqlite", lambda: ResultsDatabase(folder, {}))
said("captions.json", lambda: read_captions(folder))
said("before.json", lambda: read_benchmarks(folder / "before.json"))
said("study.toml", lambda: read_study(str(folder / "study.toml")))
"""
"""A process of its own, since opening a pipe would wait for ever."""


@pytest.mark.long
def test_pipes_of_others_are_refused_wherever_a_file_is_opened(run: Path) -> None:
    command = [sys.executable, "-c", PIPES, str(run)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        *(f"'results.sqlite{end}' is no regular file; remove it" for end in ("-wal", "-shm", "-journal") for _ in "12"),
        "'results.sqlite' is no regular file; remove it",
        "{}",
        "'before.json' cannot be read as a file of pytest-benchmark (OSError: [Errno 22] it is no regular file)",
        "study file 'study.toml' is not a file",
    ]


def test_only_figures_of_vibench_are_removed(tmp_path: Path) -> None:
    ours, theirs = ["obstacle-convergence.png", "hertz-bounds.svg"], ["my-own.svg", "errors.txt", "errors.png"]
    for name in (*ours, *theirs):
        (tmp_path / name).touch()
    figures.remove(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(theirs)
    figures.remove(tmp_path / "nowhere")


def test_a_file_is_written_whole_as_masks_say_and_over_no_pipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As /dev/null would be replaced, for an administrator."""
    target = tmp_path / "table.csv"
    for mask, mode in ((0o022, 0o644), (0o027, 0o640), (0o077, 0o600)):
        before = os.umask(mask)
        try:
            write_atomically(target, b"before")
        finally:
            os.umask(before)
        assert target.stat().st_mode & 0o777 == mode
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="it is no regular file"):
        write_atomically(tmp_path / "pipe", b"")
    assert (tmp_path / "pipe").is_fifo()
    monkeypatch.setattr(Path, "replace", lambda self, other: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(OSError, match="No space left"):
        write_atomically(target, b"after")
    assert {path.name for path in tmp_path.iterdir()} == {"table.csv", "pipe"}
    assert target.read_text() == "before"
