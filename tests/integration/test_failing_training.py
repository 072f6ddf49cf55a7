"""A study whose third training parameter has no solution, with and without leaving it out."""

from pathlib import Path

import numpy as np
import pytest
from samples import pga_reduction
from vanishing import Declared, Tangled, TangledThird

import vibench
from vibench import NumericalError, Reduction, RequestError, Study
from vibench.stages.artefacts import Store
from vibench.stages.snapshots import solution_stages
from vibench.study.cells import Cell
from vibench.study.matrix import expand, study_of_cell

THIRD = r"at mu = [1.0, 0.0]: ValueError: mesh tangled"


def study(training: object, **more: object) -> Study:
    content = {
        "name": "failing", "training": training, "validation": 4, "problem": [TangledThird], "dual": ["mcpg"],
        "primal": ["offline-pga"], "solvers": ["piqp"], "assembly": ["full", "reduced"], "bounds": [True],
        "formulation": ["mixed", "penalty"], "timing_rounds": 1, "timing_rounds_min": 1,
        "tolerances": [{"pod": [1e-4], "dual": [1e-3], "primal": {"offline-pga": [0.5]}}],
    }  # fmt: skip
    return Study(**content | more)


def test_the_third_training_parameter_ends_the_cells_or_is_skipped_and_recorded(tmp_path: Path) -> None:
    sets = ["own", {"name": "own", "label": "rest", "on_failure": "skip"}]
    run = vibench.run(study(sets), tmp_path / "run", jobs=1, progress=False)
    cells = run.cells
    stopped, kept = cells[cells["training"] == "own"], cells[cells["training"] == "rest"]
    assert len(stopped) == len(kept) == 4
    assert set(stopped["status"]) == {"error"}
    assert all(THIRD in reason for reason in stopped["reason"])
    assert set(kept["status"]) == {"ok"}
    assert set(kept["snapshots"]) == {14}
    assert set(kept["skipped"]) == {1}
    note = f"1 training parameters without a solution were skipped: {THIRD}"
    assert all(note in fallbacks for fallbacks in kept["fallbacks"])
    assert run.model(kept["cell"].iloc[0]).solve([1.4, 0.3]).status == "ok"


def reduction(problem: Declared, on_failure: str) -> Reduction:
    return pga_reduction(problem, 1e-3, assembly="reduced", on_failure=on_failure)


class Lost(vibench.AdaptiveSampling):
    def parameters(self, box: vibench.ParameterBox) -> np.ndarray:
        return box.grid(2, 2)

    def train(self, box: vibench.ParameterBox, trainer: vibench.Trainer) -> None:
        raise KeyError("lost")


def test_failed_solutions_are_offline_time_and_samplings_have_faults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell, clock, assemble = expand(study({"name": "own", "on_failure": "skip"}))[0], [0.0], Tangled.assemble

    def slow(problem: Tangled, mu: np.ndarray) -> vibench.VariationalInequality:
        clock[0] += 7.0 * bool((problem.wrong == mu).all(axis=1).any())
        return assemble(problem, mu)

    monkeypatch.setattr("vibench.timing.process_time", lambda: clock[0])
    monkeypatch.setattr(Tangled, "assemble", slow)
    stages = solution_stages(cell.problem, cell.training)
    (lost,) = solution_stages(cell.problem, expand(study([Lost]))[0].training)
    with pytest.raises(NumericalError, match="the sampling strategy 'Lost' raised KeyError: 'lost'; run"):
        lost.run(Store(tmp_path))
    assert sum(stage.run(Store(tmp_path)).seconds.cpu for stage in stages) == 7.0


@pytest.mark.parametrize("number", [0, 2, 14])
def test_a_reduction_skips_as_a_study(number: int) -> None:
    with pytest.raises(NumericalError, match=r"at mu = \[.*\]: ValueError: mesh tangled"):
        reduction(Tangled(number), "stop").snapshots  # noqa: B018
    skipping = reduction(Tangled(number), "skip")
    rest = np.delete(Declared().training_set(), number, axis=0)
    np.testing.assert_array_equal(skipping.parameters, rest)
    assert len(skipping.snapshots.skipped) == 1
    assert skipping.model.solve([1.4, 0.3]).status == "ok"


def test_no_more_than_a_tenth_is_skipped_and_such_cells_are_others() -> None:
    count = "2 of 15 training parameters have no solution, at most 1 may be skipped"
    with pytest.raises(NumericalError, match=rf"{count}; the first one: at mu = \[1.0, -1.0\]: ValueError"):
        reduction(Tangled(0, 2), "skip").snapshots  # noqa: B018
    with pytest.raises(RequestError, match="on_failure is for training sets"):
        study("own", validation={"name": "sobol", "size": 4, "on_failure": "skip"})
    with pytest.raises(RequestError, match="chooses training parameters by what solutions know; it has none to skip"):
        study({"name": "greedy", "candidates": 10, "tolerance": 0.1, "on_failure": "skip"})
    own = ({"name": "own", "on_failure": choice} for choice in ("stop", "skip"))
    plain, skipping = (expand(study(one, problem=["obstacle"]))[0] for one in own)
    assert plain.key != skipping.key
    assert plain.key == expand(study("own", problem=["obstacle"]))[0].key
    for cell in (plain, skipping):
        assert Cell.from_definition(cell.definition).key == cell.key
        assert expand(study_of_cell(cell, "one"))[0].key == cell.key
