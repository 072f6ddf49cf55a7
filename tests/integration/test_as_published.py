"""The algorithms as published, written around cvxopt, and vibench's own come to the same models."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.sparse as sp

from vibench import Stop
from vibench.timing import timed

pytest.importorskip("cvxopt", reason="the algorithms as published leave every quadratic program to cvxopt")
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import as_published
import published


@pytest.mark.long
@pytest.mark.parametrize(("problem", "nodes"), [("obstacle", 60), ("hertz", 700)])
def test_both_make_one_model(problem: str, nodes: int, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    # the seconds do not matter here
    monkeypatch.setattr(as_published, "median_seconds", lambda work, **_: timed(work))
    # published greedies take seconds for each generator
    small = replace(as_published.CASES[problem], queries=4, cone=Stop(tolerance=5e-2))
    monkeypatch.setitem(as_published.CASES, problem, small)
    arguments = [problem, "--resolution", str(nodes), "--repeats", "1", "--out", str(tmp_path)]
    assert as_published.main(arguments) == 0, capsys.readouterr().out
    times = pd.read_csv(tmp_path / f"as-published-{problem}.csv")
    queries = {f"{name}{solver}" for name in as_published.QUERIES for solver in ("", ", piqp")}
    queries |= {as_published.COMPILED} & set(times["stage"])  # not every model can be compiled
    assert set(times["stage"]) == {*as_published.STAGES, *as_published.TOTALS, *queries}
    assert (times.loc[times["stage"] != "reduction", ["transcription [s]", "ours [s]"]] > 0.0).all(axis=None)
    one, other = (times.set_index("stage")["transcription [s]"][list(of)] for of in as_published.TOTALS.values())
    assert times.set_index("stage")["transcription [s]"][list(as_published.TOTALS)].tolist() == pytest.approx(
        [one.sum(), other.sum()], rel=1e-4
    )


def test_broken_checks_are_told_and_line_9_leaves_nothing_to_take_out() -> None:
    fine, above, none = ("fine", 1.0, 1.0), ("above", 1.1, 1.0), ("none", float("nan"), 1.0)
    assert as_published.broken([fine, above, none]) == [above, none]
    # θ₁ = (1, 1, 0), θ₂ = (1, 2, 1): ν₂ ∝ (0, 1, 1). A generator beyond the support of θ takes no part.
    chi = np.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]]).T
    rest = published._line_9(np.array([1.0, 2.0, 1.0, 0.0]), chi, sp.eye_array(4))
    np.testing.assert_allclose(rest / rest.max(), [0.0, 1.0, 1.0, 0.0], atol=1e-9)
    assert rest[3] == 0.0
