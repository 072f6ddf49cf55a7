import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import STUDY as FULL_STUDY
from samples import cell_row, changed, write_study

from vibench import RequestError, Stop
from vibench.execution import recording
from vibench.execution.recording import axis_columns, cell_columns, claimed, clear, labels_of
from vibench.results.database import ResultsDatabase
from vibench.results.schema import KEYS, STORED
from vibench.results.sqlite import FILE
from vibench.stages.assessment import refutation
from vibench.stages.base import Stage
from vibench.stages.cell_queries import cell_queries
from vibench.stages.enrichment import NestedEnrichment
from vibench.stages.infsup_constants import EnergyConstants
from vibench.stages.offline import ConeStage, PODStage
from vibench.stages.snapshots import SnapshotStage
from vibench.study.cells import Cell
from vibench.study.matrix import expand, read_study
from vibench.study.spec import Limits, Study

STUDY = {"name": "sample", "seed": 1, "validation": 4}


def refusal(folder: Path) -> str:
    with pytest.raises(RequestError) as caught, claimed(folder):
        pass
    return str(caught.value)


def test_what_is_no_folder_of_one_run_is_refused(tmp_path: Path) -> None:
    """The second one is told who the first is; a folder that was claimed before is no foreign one."""
    with claimed(tmp_path / "run"):
        assert f"another run writes into '{tmp_path / 'run'}' (process {os.getpid()} on" in refusal(tmp_path / "run")
    with claimed(tmp_path / "run"):
        pass
    (tmp_path / "file").touch()
    assert "is a file" in refusal(tmp_path / "file")
    assert "cannot be written" in refusal(tmp_path / "file" / "below")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    line = refusal(tmp_path / "full")
    assert "not empty" in line
    assert FILE in line
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["notes.txt"]


def test_folders_are_cleared_of_what_their_own_run_writes(tmp_path: Path) -> None:
    ResultsDatabase(tmp_path, STUDY).close()
    (tmp_path / recording.LOG).touch()
    with pytest.raises(RequestError, match="holds results of the study 'sample'"):
        clear(tmp_path, "another", pytest.fail)
    assert (tmp_path / recording.LOG).exists()
    ResultsDatabase(tmp_path, STUDY).close()
    (tmp_path / "tables").mkdir()
    made, kept = (recording.LOG, recording.REPORT, "tables/cells.csv"), ("notes.txt", "tables/notes.txt", FILE)
    for name in (*made, "notes.txt", "tables/notes.txt"):
        (tmp_path / name).touch()
    clear(tmp_path, "sample", pytest.fail)
    assert [name for name in (*made, *kept) if (tmp_path / name).exists()] == list(kept)
    (tmp_path / FILE).write_bytes(b"hello")
    notes: list[str] = []
    clear(tmp_path, "sample", notes.append)
    assert ((tmp_path / f"{FILE}.damaged").read_bytes(), len(notes)) == (b"hello", 1)
    assert "it is kept as" in notes[0]


BEFORE = Limits(query_seconds=20.0, cell_seconds=600.0, memory_gib=8.0)

ENDS: dict[str, tuple[str, str, str]] = {
    "done": ("before", "ok", ""),
    "slow": ("before", "timeout", "in cone: stopped after cell_seconds = 600 s"),
    "large": ("before", "error", "in POD: out of memory: the limit is memory_gib = 8"),
    "wrong": ("before", "error", "ArithmeticError: no pivot"),
    "long ago": ("a study without known limits", "timeout", "stopped after query_seconds = 1 s"),
}
"""Study, status and reason of cells by their keys."""


@pytest.fixture
def database(tmp_path: Path) -> Iterator[ResultsDatabase]:
    """Ends of cells of a study with the limits `BEFORE`, among them one that crashed after a query took too long."""
    found = ResultsDatabase(tmp_path, {"name": "ends", "seed": 0, "validation": 2})
    for cell, (study, status, reason) in ENDS.items():
        found.write_cell({"cell": cell, "study_hash": study, "status": status, "reason": reason}, [])
    queries: list[dict[str, Any]] = [{"cell": "both", "query": k, "status": s} for k, s in enumerate(("timeout", "ok"))]
    found.write_cell({"cell": "both", "study_hash": "before", "status": "crashed"}, queries)
    found.keep("limits of before", BEFORE.model_dump_json())
    yield found
    found.close()


def test_cells_ended_by_a_limit_of_their_row_are_run_again_where_it_is_larger(database: ResultsDatabase) -> None:
    for limits, again in (
        ({}, set()), ({"query_seconds": 1.0, "cell_seconds": 1.0, "memory_gib": 1.0}, set()),
        ({"query_seconds": 21.0}, {"slow", "both"}), ({"cell_seconds": 601.0}, {"slow", "both"}),
        ({"memory_gib": 9.0, "query_seconds": 1.0}, {"large"}),
        ({"memory_gib": 9.0, "cell_seconds": 601.0}, {"slow", "both", "large"}),
    ):  # fmt: skip
        assert recording.ended_by_smaller_limits(database, BEFORE.model_copy(update=limits)) == again
    larger = BEFORE.model_copy(update={"cell_seconds": 700.0})
    database.keep("limits of after", larger.model_dump_json())
    database.write_cell({"cell": "slow", "study_hash": "after", "status": "timeout"}, [])
    assert recording.ended_by_smaller_limits(database, larger) == {"both"}
    assert recording.ended_by_smaller_limits(database, BEFORE) == set()


def test_a_refuted_bound_refutes_all_bounds_of_its_problem_and_no_other(database: ResultsDatabase) -> None:
    refuted = {"status": "refuted", "reason": "the error of λ is 2 times its bound", "bounds": 1}
    for key, changes in {"a": {"bounds": 1}, "b": refuted, "c": {"bounds": 0}, "d": {"bounds": 1, "problem": "other"},
                         "e": {"bounds": 1, "status": "failed", "reason": "no"}}.items():  # fmt: skip
        database.write_cell(cell_row() | {"cell": key} | changes, [])
    recording.refute(database)
    cells = {row["cell"]: (row["status"], row["reason"]) for row in database.rows("cells")}
    assert cells["a"] == ("refuted", "as the bounds of cell b: the error of λ is 2 times its bound")
    assert [cells[key][0] for key in "bcde"] == ["refuted", "ok", "ok", "failed"]
    assert {row["cell"] for row in database.rows("cells") if row["certificate"] == "refuted"} == {"a", "b", "e"}


def test_an_error_above_its_bound_and_the_accuracy_of_the_reference_refutes_it() -> None:
    row = {
        "status": "ok", "reference_bound": 1e-7, "error_u_energy_absolute": 1.0, "bound_online_u_energy": 2.0,
        "error_lambda_natural_absolute": 1.0, "error_lambda_natural": 0.1, "bound_online_lambda_natural": 1.0,
    }  # fmt: skip
    assert refutation(row) == {}
    assert refutation(row | {"bound_online_lambda_natural": 1.0 - 0.9e-6}) == {}  # F = 10, known to 1e-6
    found = refutation(row | {"bound_online_lambda_natural": 0.5})
    assert (found["status"], found["reason"][:37]) == ("refuted", "the error of λ is 2 times its bound: ")
    assert refutation(row | {"bound_online_u_energy": np.nan})["status"] == "refuted"
    assert refutation(row | {"status": "failed", "bound_online_lambda_natural": 0.5}) == {}
    assert refutation({"status": "ok"}) == {}


@pytest.fixture
def study(tmp_path: Path) -> Study:
    content = changed(FULL_STUDY, "problem", 0, "label", to="membrane")
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
