"""Solvers of a third party that misbehave, by the command; how each is judged is in tests of trials and borders."""

from pathlib import Path

import pytest
from running import Vibench, rows
from samples import wire_study, write_study


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
