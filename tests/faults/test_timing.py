"""Runs in which something goes wrong while seconds are measured: answers are kept, and so are the other seconds."""

from pathlib import Path

import pytest
from running import Vibench, by_solver, execute, rows, run_wire
from samples import ROUNDS, wire_study

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
