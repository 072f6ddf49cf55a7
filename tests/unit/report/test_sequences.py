from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
import qpsolvers
from running import run_of
from typer.testing import CliRunner

from vibench import RequestError, create, open_run
from vibench.cli.main import app
from vibench.execution.recorded_cell import recorded_cells
from vibench.report import replay
from vibench.study.parameter_sets import ParameterSet

STUDY = """
name = "paths"
seed = 1
validation = 2
timing_rounds = 1
timing_rounds_min = 1
accuracy = 1e-9
warm_start = true
solvers = ["proxqp", "piqp"]
dual = ["mcpg"]
primal = ["offline-pga"]
assembly = ["reduced"]
[[problem]]
name = "bearing"
options = { resolution = 100 }
validation = { name = "random-walk", size = 5, seed = 3 }
[[tolerances]]
pod = [1e-2]
dual = [1e-1]
primal = { offline-pga = [0.5] }
"""
WALK = {"size": 5, "seed": 3}


class Problem(qpsolvers.Problem):
    """What the test set uses of qpbenchmark.Problem."""

    name: str

    @staticmethod
    def load(file: str) -> Problem:
        problem = qpsolvers.Problem.load(file)
        problem.name = Path(file).stem
        return problem


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_of(STUDY, tmp_path_factory.mktemp("walked"))


@pytest.fixture(scope="module")
def exported(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "set"
    done = CliRunner().invoke(app, ["export", str(run), str(folder), "--sequence"])
    assert done.exit_code == 0, done.output
    assert "5 programs" in done.output
    return folder


@pytest.fixture
def loaded(exported: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The test set as qpbenchmark loads it: the class whose name is that of the file."""
    monkeypatch.syspath_prepend(str(exported))
    monkeypatch.delitem(sys.modules, "sequences", raising=False)  # a script of the results has the same name
    yield importlib.import_module("sequences").Sequences()
    sys.modules.pop("sequences", None)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("qpbenchmark")
    module.Problem, module.TestSet = Problem, object  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "qpbenchmark", module)


def examine(test_set: Any, run: Path, exported: Path) -> None:
    """Programs, their order, and the residuals of solutions are those of the run."""
    cells = pd.read_csv(run / "tables" / "cells.csv")
    recorded = {one.row["cell"]: one for one in recorded_cells(str(run))}
    (names,) = test_set.sequences().values()
    programs = list(test_set)
    assert [program.name for program in programs] == names
    assert (len(names), len(cells)) == (5, 2)
    box = create("problem", "bearing", {"resolution": 100}).parameters
    walk = create("sampling strategy", "random-walk", WALK).parameters(box)
    table = pd.read_csv(exported / "sequences.csv")
    assert np.array_equal(table[list(box.names)].to_numpy(), walk)
    for query, program in enumerate(programs):
        for cell in cells["cell"]:
            own = recorded[cell].program(query)
            assert np.array_equal(program.P, own.A)
            assert np.array_equal(program.q, -own.f)
            arrays = np.load(exported / "solutions" / f"{program.name}.npz")
            x, z = arrays[f"x_{cell}"], arrays[f"z_{cell}"]
            solution = qpsolvers.Solution(program, found=True, x=x, z=z, y=np.zeros(0), z_box=np.zeros(0))
            primal, dual = np.max(own.B @ x - own.g, initial=0.0), np.abs(own.A @ x - own.f + own.B.T @ z).max()
            assert solution.primal_residual() == pytest.approx(primal, rel=1e-9, abs=1e-15)
            assert solution.dual_residual() == pytest.approx(dual, rel=1e-9, abs=1e-15)
            assert max(primal, dual) < 1e-7
        again = qpsolvers.solve_problem(program, "piqp")
        assert np.allclose(again.x, x, atol=1e-4 * np.abs(x).max())


def test_an_exported_sequence_is_a_set_of_qpbenchmark(stand_in: None, loaded: Any, run: Path, exported: Path) -> None:
    examine(loaded, run, exported)
    command = [sys.executable, "-I", str(exported / "check.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "10 solutions, 10 claimed ok, 0 wrong")


def test_the_released_qpbenchmark_loads_and_solves_it(run: Path, exported: Path, tmp_path: Path) -> None:
    benchmark = pytest.importorskip("qpbenchmark.benchmark")
    test_set = benchmark.load_test_set(str(exported / "sequences.py"))
    examine(test_set, run, exported)
    results = importlib.import_module("qpbenchmark.results").Results(str(tmp_path / "results.csv"), test_set)
    solve = importlib.import_module("qpbenchmark.run").run
    solve(test_set, results, only_settings="high_accuracy", only_solver="piqp")
    assert results.df["found"].all()
    assert results.df["problem"].tolist() == [program.name for program in test_set]
    sys.modules.pop("sequences", None)


def test_queries_of_a_path_start_from_those_before(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    queries = open_run(run).queries.sort_values("query")
    walked = queries[queries["solver"] == "proxqp"]["started_from"]
    assert np.isnan(walked.iloc[0])
    assert walked.tolist()[1:] == [0, 1, 2, 3]
    assert queries[queries["solver"] == "piqp"]["started_from"].isna().all()  # it cannot
    monkeypatch.setattr(ParameterSet, "is_ordered", False)
    with pytest.raises(RequestError, match="along an ordered validation set, such as that of random-walk"):
        replay.export(str(run), tmp_path / "set", sequence=True)
