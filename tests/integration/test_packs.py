"""A study on the pack of a problem gives the numbers of the problem, in full and in reduced assembly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from running import Vibench
from samples import write_study

from vibench.results import tables

STUDY = {
    "name": "packed",
    "seed": 2022,
    "validation": 4,
    "accuracy": 1e-8,
    "solvers": ["piqp"],
    "dual": ["mcpg"],
    "primal": ["online-supremizers", "offline-pga"],
    "assembly": ["full", "reduced"],
    "timing_rounds": 1,
    "tolerances": [{"pod": [1e-2], "dual": [1e-1], "primal": {"offline-pga": [0.5]}}],
}
ORIGIN = {"cell", "problem_options", "model", "study_hash", "code", "definition", "artefact", "cell_a", "cell_b"}
"""Columns that name the problem or its code."""

MEASURED = {"peak_memory_mib", "slowdown", "disturbed", "benefit_threshold", "threshold_low", "threshold_high", "sign"}
"""Columns that depend on the machine."""

RESOLUTION = {"obstacle": 160, "hertz": 300}


def numbers(folder: Path, table: str) -> pd.DataFrame:
    """A table without columns that are measured or name the problem, in the order of cells and queries."""
    found = tables.read(folder / "runs" / "packed" / "results.sqlite", table)
    names = tables.read(folder / "runs" / "packed" / "results.sqlite", "cells").set_index("cell")
    if table == "solutions":
        found = found.join(names[["dual", "primal", "assembly"]], on="cell")
    if table == "histories":
        found = found[found["quantity"] != "aspect_ratio"]  # diagnostics are no part of a pack
    seconds = {name for name in found if name.endswith("_s")}
    kept = found[[name for name in found if name not in ORIGIN | MEASURED | seconds]]
    keys = ["primal", "assembly", "query", "stage", "quantity", "step", "dual_tol"]
    return kept.sort_values([key for key in keys if key in kept]).reset_index(drop=True)


@pytest.mark.parametrize("problem", RESOLUTION)
def test_a_study_on_a_pack_gives_the_numbers_of_its_problem(problem: str, vibench: Vibench, tmp_path: Path) -> None:
    resolution = RESOLUTION[problem]
    written = vibench(
        tmp_path,
        "pack",
        problem,
        "model",
        "--option",
        f"resolution={resolution}",
        "--validation",
        "4",
        "--seed",
        "2022",
    )
    assert written.returncode == 0, written.stderr
    options = {"plugin": (problem, {"resolution": resolution}), "pack": ("pack", {"path": str(tmp_path / "model")})}
    for name, (plugin, given) in options.items():
        (tmp_path / name).mkdir()
        entry = {"name": plugin, "label": "model", "options": given}
        study = write_study(tmp_path / name, STUDY | {"problem": [entry]})
        done = vibench(tmp_path / name, "run", study, "--jobs", "1", "--strict")
        assert done.returncode == 0, done.stdout + done.stderr
    for table in ("cells", "queries", "histories", "solutions"):
        found, expected = numbers(tmp_path / "pack", table), numbers(tmp_path / "plugin", table)
        assert len(found) == len(expected) > 0
        for name in expected:
            if pd.api.types.is_numeric_dtype(expected[name]):
                np.testing.assert_allclose(found[name], expected[name], rtol=1e-10, atol=1e-10, err_msg=name)
            elif not isinstance(expected[name].iloc[0], bytes):
                assert found[name].equals(expected[name]), name
