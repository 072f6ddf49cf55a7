"""Classes of a script run through a study without any package, and run again when they are edited."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from forking import run_script
from running import PATIENCE

import vibench

SCRIPT = '''
import functools, json, sys
import numpy as np
import scipy.sparse as sp
import vibench
from vibench import InnerProduct, ParameterBox, Problem, VariationalInequality
from vibench.execution.run import Observer

@functools.cache
def steps(nodes):
    return 1.0 / (nodes + 1)

class Wire(Problem):
    """A wire between two fixed ends, pressed with a force mu on a flat support."""
    parameters = ParameterBox(("force",), np.array([4.0]), np.array([8.0]), ("N/m",))

    def __init__(self, nodes: int = 12):
        self.step, ones = steps(nodes), np.ones(nodes)
        self.stiffness = sp.diags_array([2 * ones, -ones[1:], -ones[1:]], offsets=[0, 1, -1]).tocsr() / self.step
        self.mass = sp.diags_array(self.step * ones).tocsr()
        self.V, self.W = InnerProduct(self.stiffness + self.mass), InnerProduct(self.mass)

    def training_set(self):
        return self.parameters.grid(5)

    def assemble(self, mu):
        import depth
        ones = self.step * np.ones(self.V.dim)
        return VariationalInequality(self.stiffness, -mu[0] * ones, -self.mass, depth.DEPTH * ones)

class Slack(Wire):
    def assemble(self, mu):
        raise ValueError("the wire is slack")

class MyCone(vibench.DualStrategy):
    def __init__(self, share: float = 1.0):
        self.share = share

    def reduce(self, snapshots, W, stop):
        return vibench.greedy_cone(snapshots, W, stop)

class Told(Observer):
    cells, lines = 0, ""
    def note(self, line):
        self.lines += line
    def cell(self, cell, row):
        self.cells += 1

if __name__ == "__main__":
    study = vibench.Study(
        name="mine", validation=3, solvers=["piqp"], primal=["decorrelated"], timing_rounds=1,
        problem=[Wire, {"name": Wire(9), "label": "short"}, Slack()],
        dual=[{"name": MyCone, "options": {"share": 0.5}}], tolerances=[{"pod": [1e-2], "dual": [1e-2]}],
    )
    told = Told()
    run = vibench.run(study, sys.argv[1], jobs=1, observer=told)
    cells = run.cells.set_index("problem", drop=False).loc[["Wire", "short", "Slack"]]
    model = run.model(cells["cell"].iloc[0])
    rows = cells[["cell", "problem", "dual", "dual_options", "status", "reason", "error_u_mean"]]
    print(json.dumps([told.cells, model.solve([5.0]).status + told.lines, json.loads(rows.to_json(orient="records"))]))
'''


def run_source(folder: Path, source: str, depth: float = 0.2, *, anew: bool = False) -> tuple[int, str, list[Any]]:
    """Cells that had to be run, the status of a query of the first one's model with notes of the run, and the rows."""
    (folder / "script.py").write_text(source)
    (folder / "depth.py").write_text(f"DEPTH = {depth}")
    if anew:  # by a new interpreter
        line = [sys.executable, "script.py", "out"]
        done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE)
    else:
        done = run_script(folder / "script.py", "out")
    assert done.returncode == 0, done.stderr
    count, status, rows = json.loads(done.stdout.splitlines()[-1])
    return count, status, rows


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("script")
    count, status, rows = run_source(folder, SCRIPT, anew=True)
    assert (count, status) == (3, "ok")
    assert [(row["problem"], row["dual"], row["dual_options"]) for row in rows] == [
        (name, "MyCone", '{"share": 0.5}') for name in ("Wire", "short", "Slack")
    ]
    assert [row["status"] for row in rows] == ["ok", "ok", "error"]
    assert "the wire is slack" in rows[2]["reason"]
    assert rows[0]["error_u_mean"] != rows[1]["error_u_mean"]
    return folder


@pytest.mark.long
def test_the_same_classes_are_not_run_again_and_edited_ones_are(folder: Path) -> None:
    before = vibench.open_run(folder / "out").cells
    assert run_source(folder, f"# a remark\n{SCRIPT}")[0] == 0
    count, said, _ = run_source(folder, SCRIPT, 0.15)
    # A method imports it, and the third class raises before.
    assert count == 2
    for name in ("Wire", "short"):
        assert f"the problem '{name}' reads {folder / 'depth.py'}, changed since: what it computes is computed" in said
    after = vibench.open_run(folder / "out").cells
    assert list(after["cell"]) == list(before["cell"])
    edited = after["problem"] != "Slack"
    for changed in (after["code"] != before["code"], after["error_u_mean"] != before["error_u_mean"]):
        assert changed[edited].all()
    assert (after["code"] == before["code"])[~edited].all()
