import re
import shutil
from pathlib import Path

import pandas as pd
import pytest
from running import Vibench, assert_same_numbers, by_solver, execute, rows, run_wire, without_seconds
from samples import wire_study, write_study

import vibench.execution.run  # noqa: F401  lists the classes of all stages
from vibench.results.schema import TABLES
from vibench.results.sqlite import FILE
from vibench.study.parameter_sets import CHUNKS

SOLVERS = ["piqp", "careful", "gives-up"]


@pytest.fixture(scope="module")
def first(vibench: Vibench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a study with a finished run of three cells, one of which is not ok."""
    folder = tmp_path_factory.mktemp("first")
    done = vibench(folder, "run", write_study(folder, wire_study(solvers=SOLVERS)), "--jobs", "1", figures=True)
    assert done.returncode == 0, done.stderr
    assert [row["status"] for row in rows(folder / "runs" / "wire")] == ["ok", "ok", "failed"]
    return folder


@pytest.fixture
def again(first: Path, tmp_path: Path) -> Path:
    shutil.copytree(first, tmp_path / "again")
    return tmp_path / "again"


def test_results_are_where_the_study_is_named_and_a_second_run_does_nothing_new(vibench: Vibench, again: Path) -> None:
    folder = again / "runs" / "wire"
    assert {one.name for one in (folder / "tables").iterdir()} == {*(f"{table}.csv" for table in TABLES), "summary.md"}
    before = {table: rows(again / "runs" / "wire", table) for table in TABLES if table != "histories"}
    printed, _ = run_wire(vibench, again)
    assert "3 cells, 0 to run, 0 stages" in printed
    assert {table: rows(again / "runs" / "wire", table) for table in before} == before
    assert "3 cells, 2 ok, 1 not ok" in printed


def test_retry_redoes_what_was_not_ok(vibench: Vibench, again: Path) -> None:
    before = by_solver(again / "runs" / "wire")
    execute(again / "runs" / "wire", "UPDATE cells SET reason = 'old'")
    printed, after = run_wire(vibench, again, "--retry")
    assert "3 cells, 1 to run, 1 stages" in printed
    reasons = {row["solver"]: row["reason"] for row in after}
    assert reasons == {"piqp": "old", "careful": "old", "gives-up": before["gives-up"]["reason"]}
    redone = {row["solver"] for row in after if row | {"reason": ""} != before[row["solver"]] | {"reason": ""}}
    assert redone <= {"gives-up"}  # its row is the same again where even the peak of the memory is
    assert len(rows(again / "runs" / "wire", "queries")) == 9


@pytest.mark.long
def test_fresh_starts_over_and_keeps_notes_and_damaged_results(vibench: Vibench, again: Path) -> None:
    execute(again / "runs" / "wire", "UPDATE cells SET reason = 'old'")
    notes = [again / "runs" / "wire" / name for name in ("notes.txt", "tables/notes.txt", "figures/my-own.svg")]
    for note in notes:
        note.parent.mkdir(exist_ok=True)
        note.write_text("precious")
    printed, after = run_wire(vibench, again, "--fresh")
    assert "3 cells, 3 to run" in printed
    assert len(after) == 3
    assert "old" not in {row["reason"] for row in after}
    assert [note.read_text() for note in notes] == ["precious"] * 3
    # It is kept; without --fresh it is refused in a line that says so.
    path = again / "runs" / "wire" / FILE
    path.write_bytes(b"\xff" * 5000)
    refused = vibench(again, "run", "study.toml")
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1
    assert "or --fresh, which keeps it as results.sqlite.damaged" in refused.stderr
    printed, after = run_wire(vibench, again, "--fresh")
    assert f"is kept as 'runs/wire/{FILE}.damaged'" in printed.splitlines()[0]
    assert "3 cells, 3 to run" in printed
    assert len(after) == 3
    assert path.with_name(f"{FILE}.damaged").read_bytes() == b"\xff" * 5000


def test_a_cell_without_row_is_done_again(vibench: Vibench, again: Path, artefacts: Path) -> None:
    """With those artefacts it needs that are gone."""
    folder = again / "runs" / "wire"
    execute(folder, "DELETE FROM cells WHERE solver = 'careful'")
    lost = list(artefacts.glob("pod-*"))
    for artefact in lost:
        artefact.unlink()
    before = by_solver(folder)
    printed, after = run_wire(vibench, again)
    assert "3 cells, 1 to run, 2 stages" in printed
    assert any(artefact.exists() for artefact in lost)
    assert {row["solver"]: row["status"] for row in after} == {"piqp": "ok", "careful": "ok", "gives-up": "failed"}
    others = [without_seconds(row) for row in after if row["solver"] != "careful"]
    assert others == [without_seconds(before[name]) for name in ("piqp", "gives-up")]
    assert by_solver(folder)["piqp"]["online_s"] != before["piqp"]["online_s"]  # timed together with the new one
    assert len(rows(folder, "queries")) == 9


def test_other_cells_join_those_of_a_study_and_strict_fails_where_one_is_not_ok(vibench: Vibench, again: Path) -> None:
    printed, after = run_wire(vibench, again, "--solver", "osqp", "--pod-tol", "0.1")
    assert "1 cells, 1 to run" in printed
    assert [row["solver"] for row in after] == [*SOLVERS, "osqp"]
    assert len(pd.read_csv(again / "runs" / "wire" / "tables" / "cells.csv")) == 4
    for solvers, code in ((["piqp", "gives-up"], 1), (["piqp", "careful", "ecos"], 0)):
        chosen = [option for solver in solvers for option in ("--solver", solver)]
        done = vibench(again, "run", "study.toml", "--strict", "--jobs", "1", *chosen)
        assert (done.returncode, done.stderr) == (code, "")


def test_an_edited_plugin_is_run_again(vibench: Vibench, again: Path, plugins_folder: Path, tmp_path: Path) -> None:
    """Problem and solvers come from the package that was edited, and one of them now does its work."""
    shutil.copytree(plugins_folder, tmp_path / "edited")
    with (tmp_path / "edited" / "fake_plugins.py").open("a", encoding="utf-8") as source:
        source.write("\n\ngives_up = careful\n")
    printed, after = run_wire(vibench, again, plugins=tmp_path / "edited")
    assert "3 cells, 3 to run" in printed
    assert [row["status"] for row in after] == ["ok"] * 3


def test_too_little_memory_is_a_reason(vibench: Vibench, tmp_path: Path) -> None:
    """Less than a worker needs to come to life; numerical libraries may then wait until their time is over."""
    _, (row,) = run_wire(vibench, tmp_path, study=wire_study(limits={"memory_gib": 0.05, "cell_seconds": 5.0}))
    assert row["status"] in ("error", "crashed", "timeout")
    assert row["reason"]


def test_a_run_in_which_nothing_works_comes_to_its_end(vibench: Vibench, tmp_path: Path) -> None:
    """One problem raises, and of the other every query takes too long."""
    study = wire_study(problem=["wire-raises", "wire"], limits={"query_seconds": 1e-9})
    printed, after = run_wire(vibench, tmp_path, study=study)
    found = {row["problem"]: row for row in after}
    assert {problem: row["status"] for problem, row in found.items()} == {"wire-raises": "error", "wire": "timeout"}
    assert "the limit is 1e-09 s" in found["wire"]["reason"]
    assert {row["queries_ok"] for row in found.values()} == {0}
    assert "2 cells, 0 ok, 2 not ok" in printed

    # with a larger limit the cell that it had ended is run again, once; what raises is not
    printed, after = run_wire(vibench, tmp_path, study=study | {"limits": {"query_seconds": 20.0}})
    assert "2 cells, 1 to run" in printed
    assert {row["problem"]: row["status"] for row in after} == {"wire-raises": "error", "wire": "ok"}
    assert "2 cells, 0 to run" in run_wire(vibench, tmp_path)[0]


def test_a_problem_that_fails_first_leaves_the_one_beside_it_alone(vibench: Vibench, tmp_path: Path) -> None:
    """What the good problem waits for is not dropped when the stages of the bad one fail before it could begin."""
    study = wire_study(problem=["wire-raises", "wire"], primal=["decorrelated", "online-supremizers"])
    _, after = run_wire(vibench, tmp_path, study=study)
    found = {(row["problem"], row["primal"]): row["status"] for row in after}
    statuses = {"wire-raises": "error", "wire": "ok"}
    assert found == {(problem, primal): status for problem, status in statuses.items() for primal in study["primal"]}


def test_plugins_whose_requirements_are_missing_are_unavailable(vibench: Vibench, tmp_path: Path) -> None:
    printed, after = run_wire(vibench, tmp_path, "--strict", study=wire_study(dual=["cone-needs", "cpg"]))
    found = {row["dual"]: row for row in after}
    assert {dual: row["status"] for dual, row in found.items()} == {"cone-needs": "unavailable", "cpg": "ok"}
    reason = "the dual strategy 'cone-needs' needs no-such-distribution, which is not installed"
    assert found["cone-needs"]["reason"] == f"{reason}: `pip install no-such-distribution`"
    assert printed.count(reason) == 2  # when the run begins, and among what is not ok
    (folder := tmp_path / "other").mkdir()
    study = write_study(folder, wire_study(primal=["decorrelated", "online-supremizers"], solvers=["ecos"]))
    done = vibench(folder, "run", study, "--jobs", "1")
    assert done.returncode == 1
    # Where its distribution is installed the broken module is the reason.
    reason = done.stderr.removeprefix("vibench: no cell could run here: ").removesuffix("\n")
    assert re.fullmatch("the QP solver 'ecos' (is not installed: `pip install ecos`|cannot be imported: .+)", reason)
    first, results = done.stdout.splitlines()
    assert (first, results.split()[0]) == ("2 cells, 0 to run, 0 stages", "results:")
    assert {row["reason"] for row in rows(folder / "runs" / "wire")} == {reason}


def test_the_number_of_jobs_changes_no_result(vibench: Vibench, tmp_path: Path) -> None:
    write_study(tmp_path, wire_study(
        problem=[{"name": "wire", "label": "long", "options": {"nodes": 40}}], solvers=["piqp", "osqp", "gives-up"],
        primal=["offline-pga"],
        tolerances=[{"pod": [1e-3], "dual": [1e-2], "primal": {"offline-pga": [0.5]}}],
    ))  # fmt: skip
    for jobs in ("1", "2"):
        done = vibench(tmp_path, "run", "study.toml", "--jobs", jobs, "--out", jobs, "--fresh")
        assert done.returncode == 0, done.stderr
    assert_same_numbers(tmp_path / "1", tmp_path / "2")


def test_clean_shows_and_frees_artefacts(vibench: Vibench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VIBENCH_CACHE", str(tmp_path / "cache"))
    run_wire(vibench, tmp_path, study=wire_study())
    artefacts = tmp_path / "cache" / "artefacts"
    count = len(list(artefacts.glob("*.artefact")))
    refused = vibench(tmp_path, "clean")
    assert refused.returncode == 2
    assert "--yes" in refused.stderr
    for options, left in ((("--dry-run",), count), (("--older-than", "1"), count), (("--yes",), 0)):
        done = vibench(tmp_path, "clean", *options)
        assert (done.returncode, done.stderr) == (0, "")
        assert re.search(rf"high fidelity solutions +{2 * CHUNKS} ", done.stdout)
        assert len(list(artefacts.glob("*.artefact"))) == left
    assert "MiB freed" in done.stdout
    assert (tmp_path / "runs" / "wire" / FILE).exists()
