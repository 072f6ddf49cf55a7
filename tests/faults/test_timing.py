"""Runs in which something goes wrong while seconds are measured: answers are kept, and so are the other seconds."""

from pathlib import Path

import pytest
from running import Vibench, by_solver, rows, run_wire
from samples import ROUNDS, wire_study

ANSWERS = 6
"""Calls of the solver before the timing begins: two for each of three queries."""


@pytest.mark.long
@pytest.mark.parametrize(("last_call", "lost"), [(ANSWERS + 1, 1), (ANSWERS + 1 + ROUNDS, 1), (ANSWERS, 0)])
def test_a_solver_that_dies_in_a_round_costs_that_round(
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
