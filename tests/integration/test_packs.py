import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.sparse as sp
from packs import MANIFEST, Cable, write_cable, write_manifest
from running import MEASURED, Main, Shared, Vibench, refused, rows, succeeded
from samples import toml, write_study

import vibench as library
from vibench.results.read import read_table
from vibench.results.sqlite import FILE

PACKED = {
    "name": "packed", "seed": 2022, "validation": 2, "accuracy": 1e-8, "solvers": ["piqp"], "dual": ["mcpg"],
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


@pytest.mark.long
def test_a_study_on_packs_gives_the_numbers_of_their_problems(vibench: Vibench, tmp_path: Path) -> None:
    entries = []
    for problem, resolution in RESOLUTION.items():
        option = f"resolution={resolution}"
        sets = ["--validation", str(PACKED["validation"]), "--seed", str(PACKED["seed"])]
        done = vibench(tmp_path, "pack", problem, f"{problem}-pack", "--option", option, *sets)
        assert done.returncode == 0, done.stderr
        entries.append({"name": problem, "label": problem, "options": {"resolution": resolution}})
        entries.append({"name": "pack", "label": f"{problem}-pack", "options": {"path": f"{problem}-pack"}})
    write_study(tmp_path, PACKED | {"problem": entries})
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


STUDY: dict[str, Any] = {
    "name": "cables", "validation": 2, "solvers": ["piqp"], "dual": ["mcpg"], "primal": ["decorrelated"],
    "timing_rounds": 1, "problem": [{"name": "pack", "options": {"path": "packs/cable"}}],
    "tolerances": [{"N": [2], "R": [2]}],
}  # fmt: skip


@pytest.fixture
def made(main: Main, shared: Shared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a study, its pack and its run, which was started elsewhere, as whatever follows is."""

    def make(folder: Path) -> None:
        write_cable(folder / "packs" / "cable")
        (folder / "study.toml").write_text(toml(STUDY))
        out = ("--out", str(folder / "run"), "--jobs", "1", "--no-figures")
        succeeded(main("run", str(folder / "study.toml"), *out))

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    return shutil.copytree(shared("cables", make), tmp_path / "home")


def key(folder: Path) -> str:
    return str(rows(folder / "run")[0]["cell"])


def test_results_name_the_pack_beside_the_study_or_where_it_was_moved(made: Path, main: Main, tmp_path: Path) -> None:
    (row,) = rows(made / "run")
    assert row["problem_options"] == '{"path": "packs/cable"}'
    assert row["status"] == "ok"
    assert succeeded(main("run", str(made / "study.toml"), "--dry-run")).split()[0] == row["cell"]  # of the copy
    run, at = str(made / "run"), "packs/cable=../new/rope"
    (tmp_path / "new").mkdir()
    (made / "packs" / "cable").rename(tmp_path / "new" / "rope")
    line = refused(main("replay", run, key(made)[:6], "--at", "packs/cable=nowhere"), "there is no such folder")
    assert "--at packs/cable=PATH" in line
    refused(main("replay", run, key(made)[:6], "--at", "cable=x"), "no file or folder of the cell is called 'cable'")
    refused(main("replay", run, key(made)[:6], "--at", "cable"), "expected NAME=PATH")
    out = succeeded(main("replay", run, key(made)[:6], "--at", at, "--out", "program.npz"))
    assert "piqp (recorded)" in out
    assert main("export", run, key(made), "model.npz", "--at", at)[0] == 0
    assert main("export", run, "set", "--at", at)[0] == 0
    again = ("--out", "again", "--jobs", "1", "--no-figures")
    succeeded(main("run", f"{run}/{FILE}", "--cell", key(made), "--at", at, *again))
    (row,) = rows(Path("again"))
    assert (row["cell"], row["status"], row["problem_options"]) == (key(made), "ok", '{"path": "packs/cable"}')
    model = library.open_run(run, at={"packs/cable": "../new/rope"}).model(key(made))
    assert np.isfinite(model.solve([5.0, 0.2]).u).all()


@pytest.mark.parametrize("moved", [False, True])
def test_an_edited_pack_is_noticed_wherever_it_is(moved: bool, made: Path, main: Main, tmp_path: Path) -> None:
    pack, at = made / "packs" / "cable", ["--at", f"packs/cable={made / 'packs' / 'cable'}"]
    if moved:
        pack = pack.rename(tmp_path / "rope")
        at = ["--at", f"packs/cable={pack}"]
    sp.save_npz(pack / "A.npz", 2.0 * Cable().A)
    for command in (["replay"], ["export"]):
        files = ["model.npz"] if command == ["export"] else []
        refused(main(*command, str(made / "run"), key(made), *files, *at), "from files that were changed since")


def test_two_packs_of_one_name_elsewhere_are_refused(main: Main, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_cable(tmp_path / name / "cable")
    sp.save_npz(tmp_path / "b" / "cable" / "B.npz", 2.0 * Cable().B)
    write_manifest(tmp_path / "b" / "cable", {name: part for name, part in MANIFEST.items() if name != "solutions"})
    (tmp_path / "study").mkdir()
    problems = [{"name": "pack", "options": {"path": f"../{name}/cable"}} for name in ("a", "b")]
    (tmp_path / "study" / "study.toml").write_text(toml(STUDY | {"problem": problems}))
    refused(main("run", str(tmp_path / "study" / "study.toml"), "--dry-run"), "files of one name in different folders")
    problems = [{"name": "pack", "options": {"path": f"{name}/cable"}} for name in ("a", "b")]
    (tmp_path / "study.toml").write_text(toml(STUDY | {"problem": problems}))
    assert succeeded(main("run", str(tmp_path / "study.toml"), "--dry-run")).splitlines()[-1] == "2 cells"
