import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import qpsolvers
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd
from running import Vibench, run_of
from typer.testing import CliRunner

import vibench
from vibench import RequestError, VariationalInequality
from vibench.cli.main import app
from vibench.execution.recorded_cell import RecordedCell, recorded_cell, recorded_cells
from vibench.plugins import registry
from vibench.qp import kkt_residuals, verification
from vibench.qp.solve import installed_solvers, solve_qp
from vibench.report import replay
from vibench.report.qps_checker import residuals

STUDY = """
name = "small"
seed = 1
timing_rounds = 3
validation = 3
accuracy = [1e-7, 1e-5]
solvers = ["piqp", "osqp"]
dual = ["mcpg"]
primal = ["online-supremizers", "offline-pga"]
[[problem]]
name = "radial-obstacle"
options = { resolution = 200 }
[[tolerances]]
pod = [1e-2]
dual = [1e-1]
primal = { offline-pga = [0.5] }
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_of(STUDY, tmp_path_factory.mktemp("replayed"))


def key(run: Path, solver: str = "piqp") -> str:
    cells = pd.read_csv(run / "tables" / "cells.csv")
    return str(cells[(cells["solver"] == solver) & (cells["primal"] == "offline-pga")]["cell"].iloc[0])


def test_recorded_cells_are_solved_and_replayed_or_refused_in_a_line(run: Path, tmp_path: Path) -> None:
    recorded = recorded_cell(str(run), key(run))
    solutions = recorded.rows("solutions")
    assert sorted(solutions) == [0, 1, 2]
    for query in solutions:
        again = solve_qp(recorded.program(query), "piqp", 1e-7)
        x = np.frombuffer(solutions[query]["x"])
        assert np.array_equal(again.x, x)
    model = vibench.open_run(run).model(key(run)[:8]).reduced
    assert model.fixed_basis.shape[1] == recorded.row["N"] + recorded.row["enrichment"]
    recorded = recorded_cell(str(run), key(run, "osqp"))
    frame = replay.replay(recorded, 2, tmp_path / "program.npz").set_index("solver")
    assert frame.index[0] == "osqp (recorded)"
    assert set(frame.index[1:]) == set(installed_solvers())
    assert frame.loc["piqp", "status"] == "ok"
    assert frame.loc["osqp", "distance"] == pytest.approx(0.0, abs=1e-12)
    stored = recorded.rows("queries")[2]
    for column, name in (("primal", "primal_residual"), ("dual", "dual_residual"), ("gap", "gap")):
        assert frame.loc["osqp (recorded)", column] == pytest.approx(stored[name], rel=1e-6, abs=1e-14)
    program = qpsolvers.Problem.load(str(tmp_path / "program.npz"))
    assert np.array_equal(program.P, recorded.program(2).A)
    assert np.array_equal(program.q, -recorded.program(2).f)
    recorded = recorded_cell(str(run), key(run))
    assert len(recorded_cells(str(run))) == 8
    other = RecordedCell(recorded.path, {**recorded.row, "code": "another"})
    for request, said in (
        (lambda: recorded_cell(str(run), "nothing"), r"0 cells of .* begin with 'nothing'"),
        (lambda: recorded_cell(str(run), ""), "8 cells"),
        (lambda: replay.replay(recorded, 3, tmp_path / "p.npz"), "no query 3; it has 0 to 2"),
        (lambda: replay.replay(recorded, 0, tmp_path / "p.txt"), r"must end in \.npz"),
        (lambda: other.model, "computed by other code"),
    ):
        with pytest.raises(RequestError, match=said):
            request()


def test_stages_whose_artefacts_are_gone_are_run_again(run: Path, artefacts: Path) -> None:
    for file in artefacts.glob("*stage-*"):
        file.unlink()
    before = recorded_cell(str(run), key(run)).rows("queries")[1]["primal_residual"]
    recorded = recorded_cell(str(run), key(run))
    x, alpha = (np.frombuffer(recorded.rows("solutions")[1][name]) for name in ("x", "alpha"))
    again = verification.kkt_residuals(recorded.program(1), x, alpha).primal
    assert again == pytest.approx(before, rel=1e-6, abs=1e-15)


def test_a_solver_that_dies(run: Path, tmp_path: Path, plugins_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(plugins_folder))
    registry.registered.cache_clear()
    monkeypatch.setattr(replay, "installed_solvers", lambda _: ["segfaults", "piqp"])
    frame = replay.replay(recorded_cell(str(run), key(run)), 0, tmp_path / "program.npz").set_index("solver")
    registry.registered.cache_clear()
    assert frame.loc["segfaults", "status"] == "crashed"
    assert "SIGSEGV" in frame.loc["segfaults", "claims"]
    assert frame.loc["piqp", "status"] == "ok"


def test_the_exported_set_is_rechecked_by_a_script_that_knows_nothing_of_vibench(run: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["export", str(run), str(tmp_path / "set")])
    assert done.exit_code == 0, done.output
    assert "6 programs" in done.output  # two reduced models, three queries
    script = tmp_path / "set" / "check.py"
    assert "import vibench" not in script.read_text()
    assert "from vibench" not in script.read_text()

    def check() -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-I", str(script)]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    fine = check()
    assert (fine.returncode, fine.stdout.strip()) == (0, "24 solutions, 24 claimed ok, 0 wrong")
    file = next((tmp_path / "set" / "solutions").glob("*.npz"))
    arrays = dict(np.load(file))
    spoiled = next(name for name in arrays if name.startswith("x_"))
    arrays[spoiled] = arrays[spoiled] * (1.0 + 1e-4)
    np.savez(file, **arrays)
    spoilt = check()
    assert spoilt.returncode == 1
    assert "1 wrong" in spoilt.stdout
    assert CliRunner().invoke(app, ["export", str(run), str(tmp_path / "set")]).exit_code != 0


@pytest.mark.long
@pytest.mark.parametrize(("kib", "arguments"), [(0, ["export"]), (3, ["export"]), (1, ["replay"]), (8, ["report"])])
def test_full_disks_leave_nothing(kib: int, arguments: list[str], run: Path, vibench: Vibench, tmp_path: Path) -> None:
    target = {"replay": [key(run), "--out", "one.npz"], "report": ["--no-figures", "--out", "one.html"]}
    target["export"] = ["set"]
    done = vibench(tmp_path, *arguments, str(run), *target[arguments[0]], file_kib=kib)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"vibench: '{target[arguments[0]][-1]}' cannot be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


@given(
    seed=st.integers(0, 10_000), load=st.sampled_from([0.0, 1e-16, 1.0]), closed=st.sampled_from([0.0, 1.0]),
    share=st.sampled_from([0.0, 1e-7, 1.0]), unit=st.integers(-9, 9),
)  # fmt: skip
def test_residuals_are_those_of_verification(seed: int, load: float, closed: float, share: float, unit: int) -> None:
    """With a load, with one that is round-off, without; of solutions of any size, zero included."""
    rng = np.random.default_rng(seed)
    P, q, G = 10.0**unit * spd(5, rng), load * rng.standard_normal(5), rng.standard_normal((3, 5))
    h, x, z = rng.random(3) - closed, share * rng.standard_normal(5), share * 10.0**unit * rng.random(3)
    found = kkt_residuals(VariationalInequality(P, -q, G, h), x, z)
    assert residuals(P, q, G, h, x, z, 0.0) == pytest.approx([found.primal, found.dual, found.gap], rel=1e-9, abs=1e-15)
