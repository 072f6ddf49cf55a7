"""Running a matrix through the command line, with plugins of a third party that misbehave."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from samples import install_fakes, wire_study, write_study
from vibench.journal import FILE
from vibench.schema import TABLES

Vibench = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def plugins_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the third-party package is installed; one of the solvers that are optional is not."""
    folder = install_fakes(tmp_path_factory.mktemp("third-party") / "site")
    (folder / "ecos.py").write_text("raise ImportError('not on this machine')\n")
    return folder


@contextlib.contextmanager
def started(command: list[str], folder: Path, plugins: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that leads a group of its own; whoever is left of the group at the end is killed."""
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(plugins), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@pytest.fixture(scope="module")
def vibench(command: str, plugins_folder: Path) -> Vibench:
    """Function that runs the installed command in a folder."""

    def run(folder: Path, *arguments: str, plugins: Path = plugins_folder) -> subprocess.CompletedProcess[str]:
        with started([command, *arguments], folder, plugins) as process:
            out, err = process.communicate(timeout=120)
        return subprocess.CompletedProcess(arguments, process.returncode, out, err)

    return run


def rows(folder: Path, table: str = "cells") -> list[dict[str, Any]]:
    """The rows of a results file, in the order they were written."""
    db = sqlite3.connect(folder / FILE)
    db.row_factory = sqlite3.Row
    try:
        return [dict(row) for row in db.execute(f"SELECT rowid, * FROM {table} ORDER BY rowid")]
    finally:
        db.close()


def execute(folder: Path, statement: str) -> None:
    db = sqlite3.connect(folder / FILE)
    db.execute("PRAGMA foreign_keys=ON")
    db.execute(statement)
    db.commit()
    db.close()


def by_solver(folder: Path) -> dict[str, dict[str, Any]]:
    return {row["solver"]: row for row in rows(folder)}


BAD_PROBLEMS: Mapping[str, tuple[set[str], str]] = {
    "wire-raises": ({"error"}, "in highfidelity: ArithmeticError: the wire snapped"),
    "wire-nan": ({"error"}, "in highfidelity: f has entries that are not finite at mu = ["),
    "wire-shape": ({"error"}, "in highfidelity: g has shape (11,) at mu = ["),
    "wire-indefinite": ({"error"}, "not positive definite"),
    "wire-broken": ({"error"}, "in highfidelity: OSError: no wire in stock"),
    "wire-hungry": ({"error"}, "out of memory: the limit is memory_gib = 8"),
}
BAD_DUALS: Mapping[str, tuple[set[str], str]] = {
    "cone-raises": ({"error"}, "in cone: LookupError: no generator found"),
    "cone-waits": ({"timeout"}, "in cone: stopped after cell_seconds = 5 s"),
}
BAD_PRIMALS: Mapping[str, tuple[set[str], str]] = {
    "enrichment-raises": ({"error"}, "in enrichment: LookupError: no vector found"),
}
BAD_SOLVERS: Mapping[str, tuple[set[str], str]] = {
    "raises": ({"error"}, "RuntimeError: the solver gave in"),
    "nothing": ({"failed", "error"}, "None"),
    "gives-up": ({"failed"}, "the solver returned nothing: gave up"),
    "nan": ({"nonfinite"}, "not finite"),
    "wrong": ({"inaccurate"}, "residual"),
    "wrong-length": ({"error"}, "3 of 3 queries"),
    "dies": ({"crashed"}, "exit code 7"),
    "ecos": ({"unavailable"}, "the QP solver 'ecos' is not installed"),
}
FINE: Mapping[str, list[str]] = {
    "problem": ["wire"], "dual": ["cpg"], "primal": ["decorrelated", "enrichment-counts"],
    "solver": ["piqp", "careful", "counts"],
}  # fmt: skip


@dataclass(frozen=True)
class Run:
    """A run that ended: its folder, its exit code, and what it said."""

    folder: Path
    code: int
    printed: str
    errors: str


@pytest.fixture(scope="module")
def run(vibench: Vibench, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """One run of a matrix in which almost everything goes wrong."""
    folder = tmp_path_factory.mktemp("misbehaviour")
    waits = {"name": "cone-waits", "options": {"file": str(folder / "never")}}
    study = wire_study(
        problem=[*FINE["problem"], *BAD_PROBLEMS],
        dual=[*FINE["dual"], waits, "cone-raises"],
        primal=[*FINE["primal"], *BAD_PRIMALS],
        solvers=[*FINE["solver"], *BAD_SOLVERS],
        limits={"cell_seconds": 5.0},
    )
    done = vibench(folder, "run", write_study(folder, study), "--jobs", "2", "--out", "out")
    return Run(folder / "out", done.returncode, done.stdout, done.stderr)


@pytest.fixture(scope="module")
def cells(run: Run) -> pd.DataFrame:
    """Its cells."""
    return pd.DataFrame(rows(run.folder)).set_index(["problem", "dual", "primal", "solver"]).sort_index()


def test_every_cell_has_a_row(cells: pd.DataFrame) -> None:
    axes = (
        [*FINE["problem"], *BAD_PROBLEMS],
        [*FINE["dual"], *BAD_DUALS],
        [*FINE["primal"], *BAD_PRIMALS],
        [*FINE["solver"], *BAD_SOLVERS],
    )
    assert sorted(cells.index) == sorted(pd.MultiIndex.from_product(axes))


def test_the_run_is_complete_all_the_same(run: Run) -> None:
    assert run.code == 0
    assert "Traceback" not in run.errors


def test_nothing_is_said_on_standard_error(run: Run) -> None:
    assert run.errors == ""


def test_what_misbehaves_takes_nothing_else_along(cells: pd.DataFrame) -> None:
    fine = cells.loc[list(pd.MultiIndex.from_product(FINE.values()))]
    assert set(fine["status"]) == {"ok"}
    assert set(fine["queries_ok"]) == {3}
    assert set(fine["reason"]) == {""}


@pytest.mark.parametrize("problem", BAD_PROBLEMS)
def test_a_problem_that_misbehaves_costs_its_cells(problem: str, cells: pd.DataFrame) -> None:
    statuses, reason = BAD_PROBLEMS[problem]
    mine = cells.loc[(problem, "cpg", "decorrelated")].drop("ecos")
    assert set(mine["status"]) == statuses
    assert all(reason in found for found in mine["reason"]), set(mine["reason"])


@pytest.mark.parametrize("dual", BAD_DUALS)
def test_a_dual_strategy_that_misbehaves_costs_its_cells(dual: str, cells: pd.DataFrame) -> None:
    statuses, reason = BAD_DUALS[dual]
    mine = cells.xs(("wire", dual), level=("problem", "dual")).drop("ecos", level="solver")
    assert set(mine["status"]) == statuses
    assert set(mine["reason"]) == {reason}


@pytest.mark.parametrize("primal", BAD_PRIMALS)
def test_a_primal_strategy_that_misbehaves_costs_its_cells(primal: str, cells: pd.DataFrame) -> None:
    statuses, reason = BAD_PRIMALS[primal]
    mine = cells.loc[("wire", "cpg", primal)].drop("ecos")
    assert set(mine["status"]) == statuses
    assert set(mine["reason"]) == {reason}


@pytest.mark.parametrize("solver", BAD_SOLVERS)
def test_a_solver_that_misbehaves_costs_its_cells(solver: str, cells: pd.DataFrame) -> None:
    statuses, reason = BAD_SOLVERS[solver]
    mine = cells.xs(("wire", "cpg", solver), level=("problem", "dual", "solver")).loc[FINE["primal"]]
    assert set(mine["status"]) <= statuses
    assert all(reason in found for found in mine["reason"]), set(mine["reason"])
    assert set(mine["queries_ok"]) == {0}
    assert mine["online_s"].isna().all()


def test_a_solver_that_is_not_installed_is_unavailable_everywhere(cells: pd.DataFrame) -> None:
    assert set(cells.xs("ecos", level="solver")["status"]) == {"unavailable"}


def test_every_reason_is_one_line(cells: pd.DataFrame, run: Run) -> None:
    reasons = [*cells["reason"], *(row["reason"] for row in rows(run.folder, "queries"))]
    assert [reason for reason in reasons if "\n" in reason] == []
    assert all(cells["reason"][cells["status"] != "ok"])


def test_every_cell_says_where_its_numbers_come_from(cells: pd.DataFrame) -> None:
    for name in ("seed", "study_hash", "code", "machine", "threads", "versions"):
        assert cells[name].notna().all(), name
        assert (cells[name] != "").all(), name


def test_queries_that_were_asked_have_rows_of_their_own(run: Run) -> None:
    queries = pd.DataFrame(rows(run.folder, "queries"))
    solvers = {*FINE["solver"], "raises", "nothing", "gives-up", "nan", "wrong"}
    assert solvers <= set(queries["solver"])
    assert set(queries.groupby("cell")["query"].apply(tuple)) == {(0, 1, 2)}
    assert set(queries[queries["solver"] == "raises"]["status"]) == {"error"}
    assert queries["mu_1"].between(4.0, 8.0).all()


def test_whole_numbers_are_stored_as_whole_numbers(run: Run) -> None:
    """A plugin may count with NumPy's integers."""
    counts = [row["iterations"] for row in rows(run.folder, "queries") if row["solver"] == "counts"]
    assert counts
    assert set(counts) == {3}
    steps = [row["value"] for row in rows(run.folder, "histories") if row["quantity"] == "steps"]
    assert steps == [0, 1, 2]


def test_progress_counts_up_to_the_number_of_cells(run: Run, cells: pd.DataFrame) -> None:
    counted = [(int(k), int(n)) for k, n in re.findall(r"^\[(\d+)/(\d+)\]", run.printed, re.MULTILINE)]
    assert counted == [(k + 1, len(cells)) for k in range(len(cells))]


def test_the_end_names_what_fell_short(run: Run, cells: pd.DataFrame) -> None:
    fine = int((cells["status"] == "ok").sum())
    assert f"{len(cells)} cells, {fine} ok, {len(cells) - fine} fell short" in run.printed
    for status in set(cells["status"]) - {"ok"}:
        assert re.search(rf"^{status}: ", run.printed, re.MULTILINE)


def test_the_tables_are_written(run: Run, cells: pd.DataFrame) -> None:
    folder = run.folder / "tables"
    assert len(pd.read_csv(folder / "cells.csv")) == len(cells)
    lines = (folder / "summary.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) == len(cells) + 2


SOLVERS = ["piqp", "careful", "gives-up"]


@pytest.fixture(scope="module")
def first(vibench: Vibench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a study with a finished run of three cells, one of which is not ok."""
    folder = tmp_path_factory.mktemp("first")
    done = vibench(folder, "run", write_study(folder, wire_study(solvers=SOLVERS)), "--jobs", "1")
    assert done.returncode == 0, done.stderr
    assert [row["status"] for row in rows(folder / "runs" / "wire")] == ["ok", "ok", "failed"]
    return folder


@pytest.fixture
def again(first: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    shutil.copytree(first, tmp_path / "again")
    return tmp_path / "again"


def run_again(vibench: Vibench, folder: Path, *options: str, **more: Any) -> tuple[str, list[dict[str, Any]]]:
    """Run the study of a folder once more; gives what was printed and the rows of the cells."""
    done = vibench(folder, "run", "study.toml", "--jobs", "1", *options, **more)
    assert done.returncode == 0, done.stderr
    return done.stdout, rows(folder / "runs" / "wire")


def test_the_results_are_where_the_study_is_named(first: Path) -> None:
    folder = first / "runs" / "wire"
    assert (folder / FILE).is_file()
    assert sorted(path.name for path in (folder / "tables").iterdir()) == sorted(
        [*(f"{table}.csv" for table in TABLES), "summary.md"]
    )
    assert list((folder / "figures").glob("*.png"))


def test_a_second_run_does_nothing_new(vibench: Vibench, again: Path) -> None:
    before = {table: rows(again / "runs" / "wire", table) for table in TABLES if table != "histories"}
    printed, _ = run_again(vibench, again)
    assert "3 cells, 0 to run, 0 stages" in printed
    assert {table: rows(again / "runs" / "wire", table) for table in before} == before
    assert "3 cells, 2 ok, 1 fell short" in printed


def test_retry_redoes_what_was_not_ok(vibench: Vibench, again: Path) -> None:
    before = by_solver(again / "runs" / "wire")
    printed, after = run_again(vibench, again, "--retry")
    assert "3 cells, 1 to run, 1 stages" in printed
    assert [row["solver"] for row in after if row != before[row["solver"]]] == ["gives-up"]
    assert len(rows(again / "runs" / "wire", "queries")) == 9


def test_fresh_starts_over_and_leaves_the_notes_somebody_made(vibench: Vibench, again: Path) -> None:
    execute(again / "runs" / "wire", "UPDATE cells SET reason = 'old'")
    (again / "runs" / "wire" / "notes.txt").write_text("precious")
    printed, after = run_again(vibench, again, "--fresh")
    assert "3 cells, 3 to run" in printed
    assert len(after) == 3
    assert "old" not in {row["reason"] for row in after}
    assert (again / "runs" / "wire" / "notes.txt").read_text() == "precious"


def test_a_cell_without_row_is_done_again(vibench: Vibench, again: Path, artefacts: Path) -> None:
    """With those artefacts it needs that are gone."""
    folder = again / "runs" / "wire"
    execute(folder, "DELETE FROM cells WHERE solver = 'careful'")
    lost = list(artefacts.glob("podstage-*"))
    for artefact in lost:
        artefact.unlink()
    before = by_solver(folder)
    printed, after = run_again(vibench, again)
    assert "3 cells, 1 to run, 2 stages" in printed
    assert any(artefact.exists() for artefact in lost)
    assert {row["solver"]: row["status"] for row in after} == {"piqp": "ok", "careful": "ok", "gives-up": "failed"}
    assert [row for row in after if row["solver"] != "careful"] == [before["piqp"], before["gives-up"]]
    assert len(rows(folder, "queries")) == 9


def test_other_cells_join_those_of_the_same_study(vibench: Vibench, again: Path) -> None:
    printed, after = run_again(vibench, again, "--solver", "osqp", "--pod-tol", "0.1")
    assert "1 cells, 1 to run" in printed
    assert [row["solver"] for row in after] == [*SOLVERS, "osqp"]
    assert len(pd.read_csv(again / "runs" / "wire" / "tables" / "cells.csv")) == 4


@pytest.mark.parametrize(("solvers", "code"), [(["piqp", "gives-up"], 1), (["piqp", "careful", "ecos"], 0)])
def test_strict_fails_where_a_cell_is_not_ok(solvers: list[str], code: int, vibench: Vibench, again: Path) -> None:
    chosen = [option for solver in solvers for option in ("--solver", solver)]
    done = vibench(again, "run", "study.toml", "--strict", "--jobs", "1", *chosen)
    assert done.returncode == code
    assert done.stderr == ""


@pytest.fixture
def edited_plugins(plugins_folder: Path, tmp_path: Path) -> Path:
    """The third-party package with another version of its source."""
    shutil.copytree(plugins_folder, tmp_path / "edited")
    with (tmp_path / "edited" / "fake_plugins.py").open("a", encoding="utf-8") as source:
        source.write("\n\ngives_up = careful\n")
    return tmp_path / "edited"


def test_a_plugin_that_was_edited_is_run_again(vibench: Vibench, again: Path, edited_plugins: Path) -> None:
    """Problem and solvers come from the package that was edited, and one of them now does its work."""
    printed, after = run_again(vibench, again, plugins=edited_plugins)
    assert "3 cells, 3 to run" in printed
    assert [row["status"] for row in after] == ["ok"] * 3


def test_a_solver_that_leaves_takes_only_its_cell_along(vibench: Vibench, tmp_path: Path) -> None:
    """`sys.exit` in a plugin ends neither the run nor the other cells."""
    done = vibench(tmp_path, "run", write_study(tmp_path, wire_study(solvers=["leaves", "piqp"])), "--jobs", "1")
    assert done.returncode == 0
    found = by_solver(tmp_path / "runs" / "wire")
    assert {solver: row["status"] for solver, row in found.items()} == {"leaves": "error", "piqp": "ok"}
    assert "SystemExit" in found["leaves"]["reason"]


def test_too_little_memory_is_a_reason(vibench: Vibench, tmp_path: Path) -> None:
    """Less than a worker needs to come to life; numerical libraries may then wait until their time is over."""
    study = wire_study(limits={"memory_gib": 0.05, "cell_seconds": 5.0})
    done = vibench(tmp_path, "run", write_study(tmp_path, study), "--jobs", "1")
    assert "Traceback" not in done.stderr
    assert done.returncode == 0
    (row,) = rows(tmp_path / "runs" / "wire")
    assert row["status"] in ("error", "crashed", "timeout")
    assert row["reason"]


@pytest.fixture
def waiting(tmp_path: Path) -> Path:
    """Folder of a study of two cells; the second waits for a file "go on" there."""
    waits = {"name": "cone-waits", "options": {"file": str(tmp_path / "go on")}}
    write_study(tmp_path, wire_study(dual=["cpg", waits]))
    return tmp_path


def read_until(process: subprocess.Popen[str], words: str) -> None:
    """Read what a process prints until some words come."""
    assert process.stdout is not None
    printed = ""
    while words not in printed:
        line = process.stdout.readline()
        assert line, f"the run ended: {printed}"
        printed += line


@pytest.mark.parametrize(("kill", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)], ids=["interrupted", "killed"])
def test_a_run_that_was_stopped_goes_on_later(
    kill: signal.Signals, code: int, command: str, plugins_folder: Path, vibench: Vibench, waiting: Path
) -> None:
    with started([command, "run", "study.toml", "--jobs", "2"], waiting, plugins_folder) as process:
        read_until(process, "[1/2] ok")
        os.killpg(process.pid, kill)  # the workers too, as a terminal does
        out, err = process.communicate(timeout=60)
    assert process.returncode == code
    assert err == ""
    folder = waiting / "runs" / "wire"
    before = rows(folder)
    assert [row["dual"] for row in before] == ["cpg"]
    if kill is signal.SIGINT:
        assert "interrupted: 1 cells have no row yet" in out
        assert len(pd.read_csv(folder / "tables" / "cells.csv")) == 1

    (waiting / "go on").touch()
    printed, after = run_again(vibench, waiting)
    assert "2 cells, 1 to run" in printed
    assert after[0] == before[0]
    assert [(row["dual"], row["status"]) for row in after] == [("cpg", "ok"), ("cone-waits", "ok")]
    assert len(rows(folder, "queries")) == 6


def test_workers_never_see_an_interrupt(command: str, plugins_folder: Path, waiting: Path) -> None:
    """From the moment on which they come to life; their own Python would answer with a traceback."""
    (waiting / "go on").touch()
    with started([command, "run", "study.toml", "--jobs", "2"], waiting, plugins_folder) as process:
        told, end = 0, time.monotonic() + 60
        while process.poll() is None and time.monotonic() < end:
            for worker in workers(process.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(worker, signal.SIGINT)
                    told += 1
            time.sleep(0.005)
        _, err = process.communicate(timeout=10)
    assert told > 10
    assert (process.returncode, err) == (0, "")


def workers(pid: int) -> list[int]:
    """The worker processes that a process started."""
    found: list[int] = []
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            numbers = children.read_text().split()
            found += [
                int(number) for number in numbers if "vibench.worker" in Path(f"/proc/{number}/cmdline").read_text()
            ]
    return found


def test_a_run_that_is_terminated_leaves_no_worker_behind(command: str, plugins_folder: Path, waiting: Path) -> None:
    """As where a terminal is closed, or a scheduler ends a job: only the command itself is told."""
    with started([command, "run", "study.toml", "--jobs", "2"], waiting, plugins_folder) as process:
        read_until(process, "[1/2] ok")
        process.terminate()
        process.wait(timeout=60)
        for _ in range(100):
            try:
                os.killpg(process.pid, 0)
            except ProcessLookupError:
                return
            time.sleep(0.1)
        pytest.fail("a worker goes on")


def test_a_run_in_which_nothing_works_comes_to_its_end(vibench: Vibench, tmp_path: Path) -> None:
    """One problem raises, and of the other every query takes too long."""
    study = wire_study(problem=["wire-raises", "wire"], limits={"query_seconds": 1e-9})
    done = vibench(tmp_path, "run", write_study(tmp_path, study), "--jobs", "1")
    assert (done.returncode, done.stderr) == (0, "")
    found = {row["problem"]: row for row in rows(tmp_path / "runs" / "wire")}
    assert {problem: row["status"] for problem, row in found.items()} == {"wire-raises": "error", "wire": "timeout"}
    assert "the limit is 1e-09 s" in found["wire"]["reason"]
    assert {row["queries_ok"] for row in found.values()} == {0}
    assert "2 cells, 0 ok, 2 fell short" in done.stdout


MEASURED = ("_s", "peak_memory_mib", "slowdown", "disturbed", "benefit_threshold", "meaning")
"""How the columns end that hold seconds, memory, or what follows from them."""


def test_the_number_of_jobs_changes_no_result(vibench: Vibench, tmp_path: Path) -> None:
    study = wire_study(
        problem=[{"name": "wire", "label": "long", "options": {"nodes": 40}}],
        dual=["cpg", "mcpg"],
        primal=["online-supremizers", "offline-pga"],
        solvers=["piqp", "osqp", "gives-up"],
        tolerances=[{"pod": [1e-3], "dual": [1e-2], "primal": {"offline-pga": [0.5]}}],
    )
    write_study(tmp_path, study)
    found: dict[str, dict[str, pd.DataFrame]] = {}
    for jobs in ("1", "2"):
        done = vibench(tmp_path, "run", "study.toml", "--jobs", jobs, "--out", jobs)
        assert done.returncode == 0, done.stderr
        found[jobs] = {table: pd.read_csv(tmp_path / jobs / "tables" / f"{table}.csv") for table in TABLES}
    for table, one in found["1"].items():
        assert len(one) > 0
        kept = [name for name in one.columns if not name.endswith(MEASURED)]
        pd.testing.assert_frame_equal(one[kept], found["2"][table][kept], check_exact=True)
