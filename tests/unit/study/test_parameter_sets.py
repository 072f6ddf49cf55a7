import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packs import Cable, manifest, write_cable, write_manifest
from samples import STUDY, changed, write_study

from vibench import ParameterBox, RequestError
from vibench.plugins.plugin import Plugin
from vibench.study.cells import Cell
from vibench.study.matrix import expand, read_study, study_of_cell
from vibench.study.parameter_sets import OWN_TRAINING, ParameterSet, parameters_of

SOBOL = {"name": "sobol", "size": 8, "seed": 1}


def cells_of(content: Mapping[str, Any], folder: Path) -> list[Cell]:
    return expand(read_study(write_study(folder, content)))


def plugin(name: str, options: str) -> Plugin:
    return Plugin("sampling strategy", name, options, "").as_installed()


def test_studies_have_the_sets_of_their_problems_or_an_axis_with_labels(tmp_path: Path) -> None:
    plain = cells_of(STUDY, tmp_path)
    assert {(cell.training, cell.validation) for cell in plain} == {(OWN_TRAINING, ParameterSet("validation", 3, 7))}
    named = cells_of(changed(STUDY, "training", to="own"), tmp_path)
    assert [cell.key for cell in named] == [cell.key for cell in plain]
    sets = ["own", SOBOL, {**SOBOL, "seed": 2, "label": "other"}]
    cells = cells_of(changed(STUDY, "training", to=sets), tmp_path)
    assert len(cells) == 3 * len(cells_of(STUDY, tmp_path))
    assert {cell.training.label: cell.training.options for cell in cells} == {
        "own": "{}", "sobol": '{"seed": 1, "size": 8}', "other": '{"seed": 2, "size": 8}',
    }  # fmt: skip
    assert len({cell.key for cell in cells}) == len(cells)
    assert {str(cell).split(" · ")[0] for cell in cells} == {"obstacle", "obstacle (sobol)", "obstacle (other)"}


def test_problems_and_restored_cells_have_sets_of_their_own(tmp_path: Path) -> None:
    problems = [{**STUDY["problem"][0], "training": SOBOL, "validation": 5}, {"name": "radial-obstacle"}]
    validation = {"name": "random", "options": {"size": 7, "seed": 4}}
    content = changed(changed(STUDY, "problem", to=problems), "validation", to=validation)
    cells = cells_of(content, tmp_path)
    found = {(c.problem.name, c.training.label, c.validation.count, c.validation.label) for c in cells}
    assert found == {("obstacle", "sobol", 5, "own"), ("radial-obstacle", "own", 7, "random")}
    content = changed(changed(STUDY, "training", to=SOBOL), "validation", to={"name": "random", "size": 7, "seed": 4})
    cell = cells_of(content, tmp_path)[0]
    assert Cell.from_definition(cell.definition) == cell
    (alone,) = expand(study_of_cell(cell, "sample"))
    assert (alone.key, str(alone)) == (cell.key, str(cell))
    assert (alone.training.label, alone.validation.label) == ("sobol", "random")
    # one parameter of both sets is allowed, see "same" below
    shared = changed(STUDY, "training", to={"name": "list", "points": [[1.0, 0, 0], [0.9, 0, 0]]})
    assert cells_of(changed(shared, "validation", to={"name": "list", "points": [[1.0, 0, 0], [1.1, 0, 0]]}), tmp_path)


def test_files_are_beside_the_study_part_of_the_code_and_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    (tmp_path / "sets").mkdir()
    file = tmp_path / "sets" / "points.csv"
    file.write_text("centre_x,scale,centre_y\n0.01, 0.9, -0.02\n0.02,1.0,0\n")
    content = changed(STUDY, "training", to={"name": "file", "path": "sets/points.csv"})
    (cell, *_) = cells_of(content, tmp_path)
    assert parameters_of(cell.problem, cell.training).tolist() == [[0.9, 0.01, -0.02], [1.0, 0.02, 0.0]]
    file.write_text("centre_x,scale,centre_y\n0.01,0.9,-0.02\n")
    (again, *_) = cells_of(content, tmp_path)
    assert again.key == cell.key
    assert again.code != cell.code
    np.save(tmp_path / "points.npy", np.array([[0.9, 0.0, 0.0]]))
    content = changed(STUDY, "training", to={"name": "file", "options": {"path": "points.npy"}})
    assert len(cells_of(content, tmp_path)) == len(cells_of(STUDY, tmp_path))
    os.mkfifo(tmp_path / "pipe.csv")
    for path in ("pipe.csv", "/dev/zero"):  # reading them would not end
        content = changed(STUDY, "training", to={"name": "file", "path": path})
        with pytest.raises(RequestError, match="cannot be read: it is no regular file"):
            cells_of(content, tmp_path)
    (tmp_path / "points.csv").write_text("\u00b5\n0.5\n", encoding="utf-8")
    box = ParameterBox(("\u03bc",), np.zeros(1), np.ones(1), ("1",))
    assert plugin("file", json.dumps({"path": f"{tmp_path}/points.csv"})).create().parameters(box).tolist() == [[0.5]]
    for shape in ((-1, 3), (2**40, 3), (2**62, 2**62), (0, 3)):
        with (tmp_path / "points.npy").open("wb") as file:
            np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
            file.write(bytes(48))
        content = changed(STUDY, "training", to={"name": "file", "path": "points.npy"})
        with pytest.raises(RequestError, match=r"points.npy' cannot be read|shape \(0, 3\)"):
            cells_of(content, tmp_path)


BAD: dict[str, tuple[tuple[str, Any], list[str]]] = {
    "unknown strategy": (("training", "sobl"), ["no sampling strategy is called 'sobl'; did you mean 'sobol'?"]),
    "unknown option": (
        ("training", {**SOBOL, "sise": 3}), ["no option of sampling strategy 'sobol' is called 'sise'", "'size'"],
    ),
    "missing option": (("training", {"name": "sobol", "size": 4}), ["'sobol' needs the option 'seed' (int ≥ 0"]),
    "size": (("training", {**SOBOL, "size": 0}), ["option 'size' of sampling strategy 'sobol' is 0; expected int ≥ 1"]),
    "options of own": (("training", {"name": "own", "size": 3}), ["training.0", "has no options (found 'size')"]),
    "label of own": (("training", {**SOBOL, "label": "own"}), ["'own' is the problem's own set and no label"]),
    "no set": (("training", []), ["training: List should have at least 1 item"]),
    "number": (("training", 12), ["training.0: expected a name, or a table with one"]),
    "own validation": (("validation", "own"), ["validation: give the number of parameters in the problem's own set"]),
    "no validation": (("validation", 0), ["validation: Input should be greater than or equal to 1 (found 0)"]),
    "log of what": (("training", {**SOBOL, "log": ["mu1"]}), ["no parameter is called 'mu1'", "centre_x"]),
    "log of zero": (("training", {**SOBOL, "log": ["centre_x"]}), ["'centre_x' cannot have a log scale", "-0.05"]),
    "counts": (("training", {"name": "grid", "counts": [3, 3]}), ["'counts' has 2 entries for the 3 parameters"]),
    "too many": (("training", {"name": "grid", "counts": [100000]}), ["expected at most 100000"]),
    "a short point": (("training", {"name": "list", "points": [[1.0, 0.0]]}), ["point 0 has 2 values", "scale,"]),
    "outside": (
        ("training", {"name": "list", "points": [[1.0, 0, 0], [1.3, 0, 0]]}),
        ["'list' for problem 'obstacle': parameter 1 has 'scale' = 1.3, outside the box [0.8, 1.2]"],
    ),
    "twice": (("training", {"name": "list", "points": [[1, 0, 0], [1, 0, 0]]}), ["parameter 1, [1.0, 0.0, 0.0]"]),
    "infinite": (("training", {"name": "list", "points": [[np.inf, 0, 0]]}), ["option 'points'", "expected list"]),
    "no file": (("training", {"name": "file", "path": "no.csv"}), ["no.csv' cannot be read: No such file"]),
    "a folder": (("training", {"name": "file", "path": "."}), ["cannot be read: Is a directory"]),
    "sort of file": (("training", {"name": "file", "path": "text.txt"}), ["is neither a .csv nor a .npy file"]),
    "columns": (("training", {"name": "file", "path": "two.csv"}), ["has the columns a, b; expected scale, centre_x"]),
    "a word": (("training", {"name": "file", "path": "word.csv"}), ["word.csv' cannot be read", "could not convert"]),
    "rows": (("training", {"name": "file", "path": "ragged.csv"}), ["has a row without 3 values"]),
    "empty": (("training", {"name": "file", "path": "empty.csv"}), ["shape (0, 3); expected (P, 3)"]),
    "pickle": (("training", {"name": "file", "path": "object.npy"}), ["object.npy' cannot be read"]),
    "complex": (("training", {"name": "file", "path": "complex.npy"}), ["of the type complex128; expected real"]),
    "flat": (("training", {"name": "file", "path": "flat.npy"}), ["parameters of shape (3,); expected (P, 3)"]),
    "not finite": (("training", {"name": "file", "path": "nan.npy"}), ["parameter 0 has 'scale' = nan, which is not"]),
    "greedy validation": (
        ("validation", {"name": "greedy", "candidates": 9, "tolerance": 0.1}), ["'greedy' chooses training parameters"],
    ),
    "same": (("validation", {"name": "grid", "counts": [5]}), ["all validation parameters of problem 'obstacle' are"]),
}  # fmt: skip


def test_what_is_wrong_with_a_set_is_one_line(tmp_path: Path) -> None:
    head = "scale,centre_x,centre_y\n"
    for name, text in {
        "text.txt": "1", "two.csv": "a,b\n1,2\n", "word.csv": head + "1,x,0\n", "ragged.csv": head + "1,0\n",
        "empty.csv": head,
    }.items():  # fmt: skip
        (tmp_path / name).write_text(text)
    np.save(tmp_path / "object.npy", np.array([{}]), allow_pickle=True)
    np.save(tmp_path / "complex.npy", np.ones((1, 3), complex))
    np.save(tmp_path / "flat.npy", np.ones(3))
    np.save(tmp_path / "nan.npy", np.full((1, 3), np.nan))
    for (key, value), words in BAD.values():
        with pytest.raises(RequestError) as refused:
            cells_of(changed(STUDY, key, to=value), tmp_path)
        assert [word for word in words if word not in str(refused.value)] == [], refused.value
        assert "\n" not in str(refused.value)


def test_a_problem_with_matrices_at_listed_parameters_alone_takes_no_others(tmp_path: Path) -> None:
    content, folder = manifest(), write_cable(tmp_path / "cable")
    content["operators"]["g"] = {"each": "listed.npz:g{}"}
    write_manifest(folder, content)
    listed = [*content["parameters"]["training"], *content["parameters"]["validation"]]
    np.savez(folder / "listed.npz", **{f"g{k}": Cable().at(*mu).g for k, mu in enumerate(listed)})
    problem = [{"name": "pack", "options": {"path": str(folder)}}]
    study = changed(changed(STUDY, "problem", to=problem), "validation", to=1)
    with pytest.raises(RequestError, match="has matrices only at its 5 listed parameters; choose among those"):
        cells_of(changed(study, "training", to=SOBOL), tmp_path)
    chosen = {"name": "list", "points": listed[:2]}
    assert len(cells_of(changed(study, "training", to=chosen), tmp_path)) == len(cells_of(STUDY, tmp_path))
