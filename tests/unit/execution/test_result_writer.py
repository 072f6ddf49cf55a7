"""The columns that name a cell or a history."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from samples import STUDY, changed, write_study

from vibench.execution.recording import axis_columns, cell_columns, labels_of
from vibench.interfaces.strategies import Stop
from vibench.results.schema import KEYS, STORED
from vibench.stages.base import Stage
from vibench.stages.cell_queries import cell_queries
from vibench.stages.enrichment import NestedEnrichment
from vibench.stages.infsup_constants import EnergyConstants
from vibench.stages.offline import ConeStage, PODStage
from vibench.stages.snapshots import SnapshotStage
from vibench.study.cells import Cell
from vibench.study.matrix import expand, read_study
from vibench.study.spec import Study


@pytest.fixture
def study(tmp_path: Path) -> Study:
    """A study in which every axis has a label of its own."""
    content = changed(STUDY, "problem", 0, "label", to="membrane")
    content = changed(content, "dual", to=[{"name": "mcpg", "label": "widened"}])
    content = changed(content, "primal", to=[{"name": "offline-pga", "label": "greedy"}])
    return read_study(write_study(tmp_path, content))


@pytest.fixture
def cell(study: Study) -> Cell:
    return expand(study)[0]


def stages_of(stage: Stage) -> Iterator[Stage]:
    yield stage
    for needed in stage.inputs():
        yield from stages_of(needed)


def first(stages: Sequence[Stage], sort: type) -> Stage:
    return next(stage for stage in stages if type(stage) is sort)


@pytest.fixture
def stages(cell: Cell, study: Study) -> list[Stage]:
    return list(stages_of(cell_queries(cell, 20.0)))


def test_cells_and_sizes_are_named_by_columns(cell: Cell) -> None:
    columns = cell_columns(cell)
    assert tuple(columns) == tuple(KEYS)
    assert columns == {
        "problem": "membrane", "problem_options": '{"resolution": "coarse"}', "training": "own",
        "training_options": "{}", "formulation": "mixed", "formulation_options": "{}", "dual": "widened",
        "dual_options": "{}", "primal": "greedy", "primal_options": "{}", "pod_tol": 1e-2, "pod_size": None,
        "dual_tol": 1e-1, "dual_size": None, "primal_tol": 0.5, "solver": "piqp",
        "accuracy": cell.accuracy, "assembly": "full", "bounds": 0, "correction": "none",
    }  # fmt: skip
    columns = cell_columns(replace(cell, pod=Stop(size=5), cone=Stop(size=4)))
    assert [columns[name] for name in ("pod_tol", "pod_size", "dual_tol", "dual_size")] == [None, 5, None, 4]


PROBLEM = {"problem", "problem_options"}
TRAINED = PROBLEM | {"training", "training_options"}
POD = TRAINED | {"pod_tol", "pod_size"}
CONE = TRAINED | {"dual", "dual_options", "dual_tol", "dual_size"}


def test_histories_of_every_stage_have_names_by_their_axes(cell: Cell, stages: list[Stage], study: Study) -> None:
    for sort, names in (
        (SnapshotStage, TRAINED), (PODStage, POD), (ConeStage, CONE),
        (NestedEnrichment, POD | CONE | {"primal", "primal_options", "primal_tol"}), (EnergyConstants, set()),
    ):  # fmt: skip
        columns = axis_columns(first(stages, sort).axes, labels_of([cell]))
        assert set(columns) == names
        assert set(columns) <= set(STORED["histories"])
        of_cell = cell_columns(cell)
        assert columns == {name: of_cell[name] for name in names}
    other = replace(cell, labels=("x", "y", "z"), solver="osqp")
    assert axis_columns(first(stages, PODStage).axes, labels_of([cell, other]))["problem"] == "membrane"
    labels = labels_of(expand(study))
    for one in expand(study):
        for stage in stages_of(cell_queries(one, 20.0)):
            assert set(axis_columns(stage.axes, labels)) <= set(STORED["histories"])
