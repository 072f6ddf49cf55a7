"""Packs are found beside the study, wherever vibench is started; moved ones where the user says, edited ones never."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from packs import MANIFEST, Cable, write_cable, write_manifest
from running import Main, Shared, refused, rows
from samples import toml

import vibench
from vibench.results.sqlite import FILE

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
        code, _, err = main("run", str(folder / "study.toml"), *out)
        assert (code, err) == (0, "")

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    return shutil.copytree(shared("cables", make), tmp_path / "home")


def key(folder: Path) -> str:
    return str(rows(folder / "run")[0]["cell"])


def test_what_results_say_of_a_pack_is_its_path_beside_the_study(made: Path, main: Main) -> None:
    (row,) = rows(made / "run")
    assert row["problem_options"] == '{"path": "packs/cable"}'
    assert row["status"] == "ok"
    code, out, _ = main("run", str(made / "study.toml"), "--dry-run")  # of the copy
    assert (code, out.split()[0]) == (0, row["cell"])


def test_a_pack_that_was_moved_and_renamed_is_where_the_user_says(made: Path, main: Main, tmp_path: Path) -> None:
    run, at = str(made / "run"), "packs/cable=../new/rope"
    (tmp_path / "new").mkdir()
    (made / "packs" / "cable").rename(tmp_path / "new" / "rope")
    line = refused(main("replay", run, key(made)[:6], "--at", "packs/cable=nowhere"), "there is no such folder")
    assert "--at packs/cable=PATH" in line
    refused(main("replay", run, key(made)[:6], "--at", "cable=x"), "no file or folder of the cell is called 'cable'")
    refused(main("replay", run, key(made)[:6], "--at", "cable"), "expected NAME=PATH")
    code, out, err = main("replay", run, key(made)[:6], "--at", at, "--out", "program.npz")
    assert (code, err) == (0, "")
    assert "piqp (recorded)" in out
    assert main("export", run, key(made), "model.npz", "--at", at)[0] == 0
    assert main("export", run, "set", "--at", at)[0] == 0
    code, _, err = main(
        "run", f"{run}/{FILE}", "--cell", key(made), "--at", at, "--out", "again", "--jobs", "1", "--no-figures"
    )
    assert (code, err) == (0, "")
    (row,) = rows(Path("again"))
    assert (row["cell"], row["status"], row["problem_options"]) == (key(made), "ok", '{"path": "packs/cable"}')
    model = vibench.open_run(run, at={"packs/cable": "../new/rope"}).model(key(made))
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
    (tmp_path / "study.toml").write_text(
        toml(STUDY | {"problem": [{"name": "pack", "options": {"path": f"{name}/cable"}} for name in ("a", "b")]})
    )
    code, out, _ = main("run", str(tmp_path / "study.toml"), "--dry-run")
    assert (code, out.splitlines()[-1]) == (0, "2 cells")
