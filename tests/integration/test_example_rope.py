import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from forking import run_pytest
from running import Vibench
from samples import ROUNDS, write_study
from sources import SOURCES, mentions

from vibench import MEMBERS
from vibench.results.read import read_table
from vibench.results.sqlite import FILE

EXAMPLE = Path(__file__).parents[2] / "examples" / "vibench-rope"

BUILT_IN = ("decorrelated", "online-supremizers", "offline-pga")
OWN = "fixed-supremizers"
FORMULATION = "shepard"

STUDY: dict[str, Any] = {
    "name": "rope-here", "seed": 3, "validation": 3, "solvers": ["piqp"], "dual": ["mcpg"],
    "primal": [*BUILT_IN, OWN], "formulation": ["mixed", FORMULATION], "assembly": ["full", "reduced"],
    "problem": [{"name": "rope", "options": {"half": 16}}],
    "tolerances": [{"pod": [1e-2], "dual": [1e-1], "primal": {"offline-pga": [0.5]}}], "timing_rounds": ROUNDS,
}  # fmt: skip


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package; what builds and tests leave behind is not left in the checkout."""
    rubbish = shutil.ignore_patterns("__pycache__", ".*", "dist")
    return Path(shutil.copytree(EXAMPLE, tmp_path_factory.mktemp("example") / "vibench-rope", ignore=rubbish))


@pytest.fixture(scope="module")
def site(example: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the package is installed, and not its sources but its wheel."""
    folder = tmp_path_factory.mktemp("site")
    quietly = ["--quiet", "--disable-pip-version-check", "--no-index", "--no-deps", "--no-build-isolation"]
    install = [sys.executable, "-m", "pip", "install", *quietly, "--target", str(folder), str(example)]
    subprocess.run(install, check=True, capture_output=True, text=True)
    return folder


@pytest.fixture(scope="module")
def cells(vibench: Vibench, site: Path, example: Path) -> tuple[pd.DataFrame, pd.DataFrame, str]:
    study = write_study(example.parent, STUDY)
    done = vibench(example.parent, "run", study, "--jobs", "1", "--strict", plugins=site)
    assert (done.returncode, done.stderr) == (0, "")
    path = example.parent / "runs" / STUDY["name"] / FILE
    return read_table(path, "cells"), read_table(path, "queries"), done.stdout


def test_the_package_is_found_through_its_entry_points_alone(vibench: Vibench, site: Path, tmp_path: Path) -> None:
    *cells, last = vibench(tmp_path, "run", "rope", "--dry-run", plugins=site).stdout.splitlines()
    assert last == "33 cells"
    assert sum(f"· {FORMULATION} ·" in cell for cell in cells) == 1
    assert sum(f" {OWN} " in cell for cell in cells) == 8
    texts = {source.stem: source.read_text() for source in SOURCES}
    assert [stem for stem, text in texts.items() for name in ("rope", OWN, FORMULATION) if mentions(name, text)] == []


def test_every_cell_has_row_and_line_is_stable(cells: tuple[pd.DataFrame, pd.DataFrame, str], example: Path) -> None:
    found, queries, printed = cells
    assert set(found["status"]) == {"ok"}
    (interpolated,) = found[found["formulation"] == FORMULATION].to_dict("records")
    assert (interpolated["dual"], interpolated["primal"], interpolated["solver"]) == ("–", "–", "–")
    assert interpolated["offline_formulation_s"] > 0.0
    found = found[found["formulation"] == "mixed"]
    assert set(zip(found["dual"], found["primal"], found["assembly"], strict=True)) == {
        (dual, primal, way) for dual in STUDY["dual"] for primal in STUDY["primal"] for way in STUDY["assembly"]
    }
    assert len(found) == 8
    assert len(queries) == 9 * STUDY["validation"]
    assert "no check of constants, bounds and solvers failed" in printed
    reduced = found[found["assembly"] == "reduced"]
    assert {name: set(reduced[f"terms_{name}"]) for name in MEMBERS} == {"A": {2}, "f": {0}, "B": {0}, "g": {2}}
    assert set(reduced["fallbacks"]) == {""}
    assert "rope: a full solution takes " in printed
    compared = pd.read_csv(example.parent / "runs" / STUDY["name"] / "tables" / "thresholds.csv")
    pairs = set(zip(compared["primal_a"], compared["primal_b"], strict=True))
    assert {("online-supremizers", OWN), ("online-supremizers", "offline-pga")} <= pairs
    found, queries, _ = cells
    rows = queries.merge(found[["cell", "primal", "assembly"]], on="cell", suffixes=("", "_of_cell"))
    rows = rows.sort_values(["assembly", "query"], ignore_index=True)
    ours, online, plain = (rows[rows["primal"] == name] for name in (OWN, "online-supremizers", "decorrelated"))
    assert len(ours) == len(online) == len(plain) == 2 * STUDY["validation"]
    np.testing.assert_allclose(ours["beta_span"], online["beta_span"], rtol=1e-8)
    np.testing.assert_allclose(ours["error_lambda"], online["error_lambda"], rtol=1e-4, atol=1e-9)
    assert (ours["beta_span"] > 1e-3).all()
    assert (plain["beta_span"].to_numpy() < ours["beta_span"].to_numpy()).any()


@pytest.mark.long
def test_checks_and_tests_of_the_package_pass_where_installed(vibench: Vibench, site: Path, example: Path) -> None:
    assert " passed, 0 failed, 0 skipped" in vibench(example.parent, "check", FORMULATION, plugins=site).stdout
    done = run_pytest(example, site, "-p", "no:cacheprovider")
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout
