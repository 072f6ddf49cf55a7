"""The task "calibration": chains of every ok cell in a table of their own, made up for where they are missing."""

from pathlib import Path

import numpy as np
import pytest
from samples import pga_reduction

import vibench
from vibench.calibration.data import Prior, Sensors, synthetic
from vibench.calibration.decisions import Decisions
from vibench.calibration.metropolis import Metropolis
from vibench.results.read import read_table
from vibench.stages.calibration import _unbounded
from vibench_problems.radial import Radial


class Coarse(Radial):
    def __init__(self) -> None:
        super().__init__("coarse")


class Deaf(Coarse):
    outputs = ()


def study(*task: str) -> vibench.Study:
    return vibench.Study(
        name="work", validation=2, problem=[Coarse, Deaf], dual=["mcpg"], primal=["offline-pga"], solvers=["piqp"],
        assembly=["reduced"], bounds=[True], timing_rounds=1, timing_rounds_min=1, task=list(task),
        tolerances=[{"pod": [1e-3], "dual": [1e-2], "primal": {"offline-pga": [0.5]}}],
    )  # fmt: skip


@pytest.mark.long
def test_every_ok_cell_has_chains_or_a_reason_also_where_the_task_is_added_later(tmp_path: Path) -> None:
    vibench.run(study(), tmp_path / "run", jobs=1, progress=False)
    assert read_table(tmp_path / "run" / "results.sqlite", "calibrations").empty
    run = vibench.run(study("calibration"), tmp_path / "run", jobs=1, progress=False)
    found = read_table(tmp_path / "run" / "results.sqlite", "calibrations")
    assert set(found["cell"]) == set(run.cells["cell"])
    deaf, rows = found[found["problem"] == "Deaf"], found[found["problem"] == "Coarse"]
    assert deaf["reason"].tolist() == ["the problem has no linear outputs, which sensors have to be"]
    assert rows["noise"].tolist() == [0.03, 0.01, 0.003]
    assert set(rows["claim"]) == {"exact"}
    assert (rows["asked"] < 0.1).all()
    assert (rows["questions"] <= 2 * rows["asked"] * rows["decisions"] + 2 * rows["audits"]).all()
    assert (rows["calibration_s"] < rows["hf_chain_s"]).all()


def test_a_model_without_bounds_walks_the_high_fidelity_chain_and_its_wrong_decisions_are_counted() -> None:
    problem = Coarse()
    model = pga_reduction(problem, vibench.Stop(size=2), vibench.Stop(size=1)).model
    names = tuple(output.name for output in problem.outputs)
    chains, exact = [], Sensors(problem)(np.array([0.17, 0.1]))
    for models in ((_unbounded(model, names),), ()):
        decisions = Decisions(problem, synthetic(problem, exact, 0.01, 1), models, 0.01, 0)
        chain = Metropolis(decisions, Prior.of(problem.parameters), 10, 5)
        while chain.steps < 60:
            chain.step()
        chains.append(chain)
    counts = chains[0].decisions.counts
    assert np.array_equal(chains[0].states, chains[1].states)
    assert counts.undecided == counts.decisions
    assert 0 < counts.wrong < counts.decisions
