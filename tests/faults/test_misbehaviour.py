"""Solvers of a third party that misbehave, by the command; how each is judged is in tests of trials and borders."""

from pathlib import Path

import fake_plugins
import meddling
import pytest
from running import Vibench, by_solver, execute, rows, run_wire, without_seconds
from samples import FAKES, ROUNDS, install, wire_study, write_study


@pytest.mark.long
def test_a_large_problem_that_finds_no_memory_costs_its_cell_alone(vibench: Vibench, tmp_path: Path) -> None:
    """Not one allocation of a plugin that takes it all: those of libraries, under a limit that suffices for others."""
    large = {"name": "hertz3d", "options": {"resolution": "coarse"}}
    tolerances, limits = [{"N": [2], "R": [2]}], {"memory_gib": 0.8}
    study = wire_study(problem=["radial-obstacle", large], tolerances=tolerances, limits=limits, validation=2)
    _, (other, row) = run_wire(vibench, tmp_path, study=study)
    assert (other["status"], row["status"]) == ("ok", "error")
    assert row["reason"] == "in high-fidelity solutions: out of memory: the limit is memory_gib = 0.8"


def test_queries_that_went_well_before_the_solver_died_are_kept(vibench: Vibench, tmp_path: Path) -> None:
    study = wire_study(solvers=["dies-sometimes", "chatty"], tolerances=[{"N": [3], "dual": [1e-2]}])
    done = vibench(tmp_path, "run", write_study(tmp_path, study), "--jobs", "1", "--out", "out")
    assert (done.returncode, done.stderr) == (0, "")
    said = "solving", "solving past Python"
    assert not any(words in done.stdout for words in said)
    assert all(words in (tmp_path / "out" / "workers.log").read_text() for words in said)
    cell, other = rows(tmp_path / "out")
    assert (cell["status"], cell["queries_ok"]) == ("crashed", 1)
    assert cell["reason"].startswith("2 of 3 queries, first mu=(4.343): the worker process died with signal SIGKILL")
    lost, kept = [[q for q in rows(tmp_path / "out", "queries") if q["cell"] == c["cell"]] for c in (cell, other)]
    assert [query["status"] for query in lost] == ["crashed", "crashed", "ok"]
    assert lost[2]["error_u"] == pytest.approx(kept[2]["error_u"])
    for query, reference in zip(lost, kept, strict=True):
        for name in ("mu_1", "hf_s", "beta_span", "beta_full_cone_lower", "beta_hf_span", "beta_bounds"):
            assert query[name] == reference[name]


ANSWERS = 6
"""Calls of the solver before the timing begins: two for each of three queries."""


@pytest.mark.long
@pytest.mark.parametrize(("last_call", "lost"), [(ANSWERS + 1, 1), (ANSWERS + 1 + ROUNDS, 1), (ANSWERS, 0)])
def test_a_death_costs_its_round(
    last_call: int, lost: int, vibench: Vibench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it dies at an answer, in the last case, it costs that query and no round of the others."""
    monkeypatch.setenv("FAKE_CALLS", str(tmp_path / "calls"))
    monkeypatch.setenv("FAKE_LAST_CALL", str(last_call))
    run_wire(vibench, tmp_path, study=wire_study(solvers=["dies-once", "piqp"]))
    found = by_solver(tmp_path / "runs" / "wire")
    unlucky, other = found["dies-once"], found["piqp"]
    assert (unlucky["status"], unlucky["queries_ok"]) == (("ok", 3) if lost else ("crashed", 2))
    assert (other["status"], other["timing_reason"]) == ("ok", "")
    reason = f"{lost} of {ROUNDS} rounds: the worker process died with signal SIGKILL" if lost else ""
    assert unlucky["timing_reason"] == reason
    assert min(unlucky["online_s"], other["online_s"]) > 0.0
    timed = [row["solver"] for row in rows(tmp_path / "runs" / "wire", "timings")]
    assert (timed.count("dies-once"), timed.count("piqp")) == (ROUNDS - lost, ROUNDS)


@pytest.mark.long
def test_what_was_never_answered_or_timed_leaves_the_others_or_is_timed_next(vibench: Vibench, tmp_path: Path) -> None:
    study = wire_study(solvers=["dies", "raises", "piqp"], dual=["cone-raises", "cpg"])
    (tmp_path / "other").mkdir()
    found = {(row["dual"], row["solver"]): row for row in run_wire(vibench, tmp_path / "other", study=study)[1]}
    assert len(found) == 6
    assert [key for key, row in found.items() if row["online_s"] is not None] == [("cpg", "piqp")]
    assert found["cpg", "piqp"]["timing_rounds"] == ROUNDS
    # As after an interruption between the last answer and the first round; a study may ask for more rounds.
    folder = tmp_path / "runs" / "wire"
    run_wire(vibench, tmp_path, study=wire_study())
    execute(folder, "UPDATE cells SET timing_rounds = NULL, online_s = NULL", "DELETE FROM timings")
    printed, (row,) = run_wire(vibench, tmp_path)
    assert "1 cells, 0 to run, 1 stages" in printed
    assert row["online_s"] > 0.0
    assert len(rows(folder, "timings")) == ROUNDS
    assert "1 cells, 0 to run, 0 stages" in run_wire(vibench, tmp_path)[0]
    assert {row["meaning"] for row in rows(folder, "thresholds")} == {"undecided"}
    assert "0 to run, 1 stages" in run_wire(vibench, tmp_path, study=wire_study(timing_rounds=7))[0]
    assert len(rows(folder, "timings")) == 7
    assert {row["timing_rounds"] for row in rows(folder)} == {7}


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = install(tmp_path_factory.mktemp("site") / "both", fake_plugins, FAKES)
    return add(folder, tmp_path_factory, meddling.MEMBERS)


def add(folder: Path, temporary: pytest.TempPathFactory, members: dict[str, dict[str, str]]) -> Path:
    for part in install(temporary.mktemp("apart") / "site", meddling, members).iterdir():
        part.rename(folder / part.name)
    return folder


@pytest.mark.long
def test_a_package_that_meddles_with_its_process_costs_no_other(vibench: Vibench, both: Path, tmp_path: Path) -> None:
    """One worker process would serve them all; the rounds of the solvers are interleaved."""
    write_study(tmp_path, wire_study(problem=["wire-meddles", "wire"], solvers=["meddling", "roughly", "piqp"]))
    write_study(tmp_path, wire_study(), "alone.toml")
    done = vibench(tmp_path, "run", "study.toml", "--jobs", "1", "--out", "both", plugins=both)
    assert (done.returncode, done.stderr) == (0, "")
    assert vibench(tmp_path, "run", "alone.toml", "--jobs", "1", "--out", "alone", plugins=both).returncode == 0
    found = {(row["problem"], row["solver"]): row for row in rows(tmp_path / "both")}
    (expected,) = rows(tmp_path / "alone")
    for key in [key for key in found if key[0] == "wire-meddles"]:
        assert found[key]["status"] == "error"
        assert "File too large; a plugin limits or closes the files of its process" in found[key]["reason"]
    good, bad, rough = (found["wire", solver] for solver in ("piqp", "meddling", "roughly"))
    ignored = {"rowid", "study", "study_hash"}
    for name in without_seconds(expected).keys() - ignored:
        assert good[name] == expected[name], name
    for row in (good, bad):
        assert (row["status"], row["timing_rounds"], row["timing_reason"]) == ("ok", ROUNDS, "")
        assert row["online_s"] > 0.0
    assert rough["status"] == "ok"
    assert "in other units of the unknowns" in rough["timing_reason"]
    assert "does the solver remember answers?" in rough["timing_reason"]


@pytest.mark.long
def test_a_name_of_two_packages(vibench: Vibench, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    site = add(install(tmp_path / "site", fake_plugins, FAKES), tmp_path_factory, meddling.TAKEN)
    study = wire_study(dual=["cpg", "mcpg"], solvers=["piqp", "careful", "osqp", "counts"])
    found = {(row["dual"], row["solver"]): row for row in run_wire(vibench, tmp_path, study=study, plugins=site)[1]}
    ok = {key for key, row in found.items() if row["status"] == "ok"}
    assert ok == {("mcpg", "piqp"), ("mcpg", "counts")}
    assert {row["status"] for key, row in found.items() if key not in ok} == {"unavailable"}
    reason = found["cpg", "piqp"]["reason"]
    assert reason.startswith("two packages provide the dual strategy 'cpg', so that none is used: ")
    assert "meddling 1.0 (meddling:Meddles)" in reason
    assert "(vibench_strategies.cpg:CPG)" in reason
    assert "fake-plugins 1.0 (fake_plugins:careful)" in found["mcpg", "careful"]["reason"]
    assert "'osqp', so that none is used: qpsolvers, meddling 1.0" in found["mcpg", "osqp"]["reason"]
    listed = vibench(tmp_path, "list", plugins=site)
    assert (listed.returncode, listed.stderr) == (0, "")
    words = " ".join(listed.stdout.split())
    for name in ("'cpg'", "'careful'", "'osqp'"):
        assert f"{name}, so that none" in words or name in words
