"""Problems of another nature with all strategies, and sensible means.

A bar below and above its yield stress, where λ = 0 at some parameters; a perpetual put; a block that an indenter drives
alone, without load, where it reaches it. They have every dual strategy with one primal one, and the other way round.
"""

from pathlib import Path
from typing import Any

import other_problems
import pytest
from running import Vibench, rows
from samples import install, write_study

from vibench.model.errors import UNMEASURABLE
from vibench.report.findings import findings
from vibench.results.read import read_table
from vibench.results.sqlite import FILE

REGISTERED = {"vibench.problems": {"torsion": "Torsion", "put": "Put", "block": "Block"}}

SIGNED = "pod-dual"
"""The negative control: with generators of any sign a put has no feasible point, and a bar sticks to its obstacle."""

DUALS = ["cpg", "mcpg", "enlarged-cpg", "angle-greedy", "nmf", "orthant", "dictionary", SIGNED]
PRIMALS = ["decorrelated", "online-supremizers", "offline-pga", "infsup-greedy", "pod-supremizers"]

WITHOUT = {"torsion": 2, "put": 0, "lifted": 3}

STUDY: dict[str, Any] = {
    "name": "others", "seed": 5, "validation": 6, "accuracy": 1e-8, "solvers": ["piqp"], "dual": DUALS,
    "primal": PRIMALS, "timing_rounds": 1,
    "problem": [
        {"name": "torsion", "options": {"cells": 8}}, {"name": "put", "options": {"cells": 60}},
        {"name": "block", "label": "lifted", "options": {"lowest": -0.04}},
    ],
    "tolerances": [
        {"pod": [1e-2], "dual": [5e-2],
         "primal": {"offline-pga": [0.5], "infsup-greedy": [0.7], "pod-supremizers": [1e-2]}},
    ],
}  # fmt: skip


@pytest.fixture(scope="module")
def run(vibench: Vibench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("others")
    plugins = install(folder / "site", other_problems, REGISTERED)
    study = write_study(folder, STUDY)
    for some in (("--primal", "offline-pga"), ("--dual", "mcpg")):
        done = vibench(folder, "run", study, "--jobs", "1", *some, plugins=plugins, timeout=400.0)
        assert done.returncode == 0, done.stderr
    return folder / "runs" / STUDY["name"]


@pytest.mark.long
def test_every_query_is_ok_and_means_are_sensible_without_contact_too(run: Path) -> None:
    """But a put with generators of any sign and no supremizer, for which no point is feasible.

    Means of λ below yield were 1e1 to 1e3, solver noise over 1e-12 of the largest multiplier.
    """
    cells = read_table(run / FILE, "cells")
    assert len(cells) == len(WITHOUT) * (len(DUALS) + len(PRIMALS) - 1)
    lost = cells[cells["status"] != "ok"]
    assert set(zip(lost["problem"], lost["dual"], lost["status"], strict=True)) <= {("put", SIGNED, "infeasible")}
    fine = cells[(cells["dual"] != SIGNED)]
    assert fine["error_u_mean"].between(0.0, 0.1).all()
    assert fine.loc[fine["enrichment_kind"] != "none", "error_lambda_mean"].between(0.0, 0.3).all()
    assert fine["error_lambda_mean"].between(0.0, 6.0).all()  # without supremizers λ is not determined
    without = cells["problem"].map(WITHOUT).where(cells["status"] == "ok", 0)
    assert cells["queries_zero_lambda"].tolist() == without.tolist()
    assert (fine["error_lambda_max"] >= fine["error_lambda_mean"]).all()
    queries = read_table(run / FILE, "queries")
    zero = queries["zero_lambda"] == 1
    assert queries[zero].groupby("problem")["query"].nunique().to_dict() == {k: n for k, n in WITHOUT.items() if n}
    ok = queries["status"] == "ok"
    for name, absent in (("lambda", zero), ("u", queries["zero_u"] == 1)):
        for column in (f"error_{name}", f"solver_error_{name}"):
            assert queries.loc[absent, column].isna().all()
        assert queries.loc[ok & ~absent, f"error_{name}"].notna().all()
        assert queries.loc[ok, f"error_{name}_scaled"].notna().all()
        signed = queries["dual"] == SIGNED
        assert queries.loc[ok & absent & ~signed, f"error_{name}_scaled"].max() < UNMEASURABLE
    assert set(queries.loc[queries["zero_u"] == 1, "problem"]) == {"lifted"}
    found = findings(run / FILE)
    for problem, count in WITHOUT.items():
        told = [text for text in found if f"λ of {problem} is zero" in text]
        assert [f"at {count} validation parameters" in text for text in told] == ([True] if count else [])
    assert any("invariants" in text and "hold in all" in text for text in found)
    header = next(line for line in (run / "tables" / "summary.md").read_text().splitlines() if "λ = 0" in line)
    assert "u = 0" in header
    assert {row["zero_lambda"] for row in rows(run, "queries")} == {0, 1}
