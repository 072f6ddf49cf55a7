"""A study on the packs of problems gives the numbers of the problems, in full and in reduced assembly."""

from pathlib import Path

import numpy as np
import pandas as pd
from running import MEASURED, Vibench
from samples import write_study

from vibench.results.read import read_table

STUDY = {
    "name": "packed", "seed": 2022, "validation": 4, "accuracy": 1e-8, "solvers": ["piqp"], "dual": ["mcpg"],
    "primal": ["offline-pga"], "assembly": ["full", "reduced"], "timing_rounds": 1,
    "tolerances": [{"pod": [1e-2], "dual": [1e-1], "primal": {"offline-pga": [0.5]}}],
}  # fmt: skip
ORIGIN = {"cell", "problem_options", "model", "study_hash", "code", "definition", "artefact", "cell_a", "cell_b"}

RESOLUTION = {"obstacle": 150, "hertz": 300}


def numbers(folder: Path, table: str, problem: str) -> pd.DataFrame:
    """Rows of a problem without columns that are measured or name it, in the order of cells and queries."""
    found = read_table(folder / "runs" / "packed" / "results.sqlite", table)
    cells = read_table(folder / "runs" / "packed" / "results.sqlite", "cells").set_index("cell")
    if table == "solutions":
        found = found.join(cells[["problem", "dual", "primal", "assembly"]], on="cell")
    if table == "histories":
        found = found[found["quantity"] != "aspect_ratio"]  # diagnostics are no part of a pack
    if table == "outputs":
        found = found[found["linear"] == 1]  # nor are functions of the solution
    if table == "queries":
        found = found.drop(columns="outputs")
    found = found[found["problem"] == problem]
    kept = found[[name for name in found if name not in ORIGIN and not name.endswith((*MEASURED, "sign"))]]
    keys = ["primal", "assembly", "output", "query", "stage", "quantity", "step", "dual_tol"]
    return kept.sort_values([key for key in keys if key in kept]).reset_index(drop=True)


def test_a_study_on_packs_gives_the_numbers_of_their_problems(vibench: Vibench, tmp_path: Path) -> None:
    entries = []
    for problem, resolution in RESOLUTION.items():
        option = f"resolution={resolution}"
        sets = ["--validation", str(STUDY["validation"]), "--seed", str(STUDY["seed"])]
        done = vibench(tmp_path, "pack", problem, f"{problem}-pack", "--option", option, *sets)
        assert done.returncode == 0, done.stderr
        entries.append({"name": problem, "label": problem, "options": {"resolution": resolution}})
        entries.append({"name": "pack", "label": f"{problem}-pack", "options": {"path": f"{problem}-pack"}})
    write_study(tmp_path, STUDY | {"problem": entries})
    done = vibench(tmp_path, "run", "study.toml", "--strict", timeout=600.0)
    assert done.returncode == 0, done.stdout + done.stderr
    for problem in RESOLUTION:
        for table in ("cells", "queries", "histories", "solutions", "outputs"):
            found, expected = (numbers(tmp_path, table, name) for name in (f"{problem}-pack", problem))
            assert len(found) == len(expected) > 0
            for name in set(expected) - {"problem"}:
                if pd.api.types.is_numeric_dtype(expected[name]):
                    np.testing.assert_allclose(found[name], expected[name], rtol=1e-10, atol=1e-10, err_msg=name)
                elif not isinstance(expected[name].iloc[0], bytes):
                    assert found[name].equals(expected[name]), name
