"""Running the command as a user would, and looking at what it leaves behind."""

import contextlib
import os
import signal
import sqlite3
import subprocess
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from samples import write_study
from typer.testing import CliRunner

from vibench import RequestError
from vibench.cli.main import app
from vibench.results.schema import KEYS, STORED, TABLES
from vibench.results.sqlite import FILE, Digests, text_reader
from vibench.testing.checks import CheckResult, Verdict

Vibench = Callable[..., "subprocess.CompletedProcess[str]"]

PATIENCE = 600.0
"""Seconds after which a process that does not end is taken to hang: a busy machine may take minutes for a short run."""

Main = Callable[..., tuple[int, str, str]]
"""Calls the command in this process: exit code, what was printed, and errors."""

Register = Callable[..., None]
"""Makes entry points, given as (group, name, value), the only ones there are."""

Shared = Callable[[str, Callable[[Path], object]], Path]
"""Makes a folder of a name by a function, once for all parallel workers."""

Changed = Callable[..., Path]


def run_of(study: str, folder: Path) -> Path:
    """The run of a study, given as the text of its file, in a folder: by one process, without figures."""
    (folder / "study.toml").write_text(study)
    options = ["--out", str(folder / "run"), "--jobs", "1", "--no-figures"]
    done = CliRunner().invoke(app, ["run", str(folder / "study.toml"), *options])
    assert done.exit_code == 0, done.output
    return folder / "run"


@contextlib.contextmanager
def started(command: list[str], folder: Path, plugins: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that leads a group of its own; whoever is left of the group at the end is killed.

    Ctrl-C does to it what it does in a terminal, also where the tests run with Ctrl-C ignored, as in the background.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        command, cwd=folder, env=os.environ | {"PYTHONPATH": str(plugins), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    signal.signal(signal.SIGINT, before)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def rows(folder: Path, table: str = "cells") -> list[dict[str, Any]]:
    db = sqlite3.connect(folder / FILE)
    db.row_factory = sqlite3.Row
    try:
        return [dict(row) for row in db.execute(f"SELECT rowid, * FROM {table} ORDER BY rowid")]
    finally:
        db.close()


def failures(results: Sequence[CheckResult]) -> dict[str, str]:
    return {result.check: result.message for result in results if result.verdict is Verdict.FAILED}


def execute(folder: Path, *statements: str) -> None:
    """Change the results in a folder by SQL, with their digests: as somebody would who wrote the file."""
    db, touched = sqlite3.connect(folder / FILE), set[str]()

    def note(action: int, table: str | None, *_: str | None) -> int:
        # what foreign keys take along is told, too
        if action in (sqlite3.SQLITE_INSERT, sqlite3.SQLITE_UPDATE, sqlite3.SQLITE_DELETE):
            touched.add(str(table))
        return sqlite3.SQLITE_OK

    db.execute("PRAGMA foreign_keys=ON")
    db.set_authorizer(note)
    for statement in statements:
        db.execute(statement)
    db.set_authorizer(None)
    seal(db, touched)
    db.commit()
    db.close()


def seal(db: sqlite3.Connection, tables: Collection[str] = ("meta", *STORED)) -> None:
    db.text_factory = text_reader()
    for table in {"meta", *STORED}.intersection(tables):
        Digests(db).forget(name=table)
        Digests(db).count(table)


def by_solver(folder: Path) -> dict[str, dict[str, Any]]:
    return {row["solver"]: row for row in rows(folder)}


def run_wire(
    vibench: Vibench, folder: Path, *options: str, study: Mapping[str, Any] | None = None, **more: Any
) -> tuple[str, list[dict[str, Any]]]:
    """Run a study of a wire, or that of a folder once more; gives what was printed and the rows of the cells."""
    if study is not None:
        write_study(folder, study)
    done = vibench(folder, "run", "study.toml", "--jobs", "1", *options, **more)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout, rows(folder / "runs" / "wire")


def read_until(process: subprocess.Popen[str], words: str) -> None:
    printed = ""
    while words not in printed:
        line = process.stdout.readline()
        assert line, f"the run ended: {printed}"
        printed += line


def workers(pid: int) -> list[int]:
    found: list[int] = []
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            lines = {number: Path(f"/proc/{number}/cmdline").read_text() for number in children.read_text().split()}
            found += [int(number) for number, line in lines.items() if "vibench.execution.worker" in line]
    return found


DECIDED = (
    "UPDATE cells SET hf_setup_s = 0.001, hf_s = 0.1",
    "UPDATE thresholds SET offline_a_s = 0.001, online_a_s = 0.1, meaning = 'from', "
    "benefit_threshold = (offline_b_s - 0.001) / (0.1 - online_b_s) WHERE primal_a = 'high-fidelity'",
    "UPDATE thresholds SET threshold_low = 0.9 * benefit_threshold, threshold_high = 1.1 * benefit_threshold "
    "WHERE primal_a = 'high-fidelity'",
)
"""Statements with which every break-even against the high-fidelity model is decided, however busy the machine was."""

MEASURED = (
    "_s", "peak_memory_mib", "slowdown", "disturbed", "benefit_threshold", "threshold_low", "threshold_high", "meaning",
    "pace", "gain", "gain_low", "gain_high", "timed_rounds", "rounds_missing", "offline_repeats",
)  # fmt: skip
"""How the columns end that hold seconds, memory, or what follows from them, such as how often something was timed."""


def numbers(folder: Path) -> dict[str, pd.DataFrame]:
    """The tables of a run without seconds, memory, and what follows from them; in an order of their own."""
    found = {table: pd.read_csv(folder / "tables" / f"{table}.csv") for table in TABLES}
    return {table: rows[[name for name in rows if not name.endswith(MEASURED)]] for table, rows in found.items()}


def without_seconds(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in row if not name.endswith((*MEASURED, "timing_rounds", "timing_reason"))}


def assert_same_numbers(one: Path, other: Path) -> None:
    """Two runs of a study that differ in nothing but their times.

    To the last bit, but for solvers that in one of the runs gave two answers to the same program: of theirs, queries
    that are ok in both runs are the same to round-off, and whatever does not depend on the solver is the same.
    """
    ours, theirs = numbers(one), numbers(other)
    queries = pd.concat([ours["queries"], theirs["queries"]])
    shaky = set(queries.loc[queries["repeatable"] == 0, "solver"])
    for table, frame in ours.items():
        # not all problems have quantities of interest, and few studies a task
        assert len(frame) > 0 or table in ("outputs", "calibrations"), table
        (ours_exact, ours_loose), (theirs_exact, theirs_loose) = (_split(t, shaky) for t in (frame, theirs[table]))
        pd.testing.assert_frame_equal(ours_exact, theirs_exact, check_exact=True)
        given = [name for name in frame.columns if name in KEYS or name.startswith(UNSOLVED)]
        pd.testing.assert_frame_equal(ours_loose[given], theirs_loose[given], check_exact=True)
        if table == "queries":
            fine = (ours_loose["status"] == "ok") & (theirs_loose["status"] == "ok")
            close = [part[fine].drop(columns=["repeatable", "iterations"]) for part in (ours_loose, theirs_loose)]
            pd.testing.assert_frame_equal(*close, rtol=1e-5, atol=1e-9)


UNSOLVED = ("cell", "model", "N", "R", "rank", "gram", "enrichment", "dim_", "beta_", "mu_", "code", "definition")
"""How the columns begin that do not depend on what a solver answers."""


def _split(frame: pd.DataFrame, shaky: set[str]) -> tuple[pd.DataFrame, pd.DataFrame]:
    solvers = frame.columns.intersection(["solver", "solver_a", "solver_b"])
    theirs = frame[solvers].isin(shaky).any(axis=1)
    return frame[~theirs], frame[theirs]


def succeeded(outcome: tuple[int, str, str]) -> str:
    """What a command printed; fails unless it succeeded and had nothing to say on standard error."""
    code, out, err = outcome
    assert (code, err) == (0, "")
    return out


def refused(outcome: tuple[int, str, str], *words: str) -> str:
    """The one line of a request that was refused; fails unless it was, and holds these words."""
    code, out, err = outcome
    assert code == 2, err
    assert out == ""
    assert err.endswith("\n")
    assert len(err.splitlines()) == 1, err
    assert err.startswith("vibench: ")
    assert "Traceback" not in err
    assert [word for word in words if word not in err] == [], err
    return err


def refusal(action: Callable[..., object], *arguments: object, **named: object) -> str:
    """The one line by which a call refuses a request; fails unless it does."""
    with pytest.raises(RequestError) as caught:
        action(*arguments, **named)
    line = str(caught.value)
    assert line.strip()
    assert line.splitlines() == [line]
    return line
