"""Which cells are timed together, when, and when again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from counting import growth
from samples import cell_row, query_rows

from vibench.execution.result_writer import ResultWriter, labels_of
from vibench.execution.timing_plan import TimingPlan
from vibench.qp.status import Status
from vibench.results.database import ResultsDatabase
from vibench.stages.base import Failed
from vibench.stages.cell_queries import cell_queries
from vibench.stages.timing_rounds import TimedCell, TimedRound, TimingRounds
from vibench.study.cells import Cell
from vibench.study.matrix import expand, read_study
from vibench.timing import Seconds

STUDY = read_study("quick")
CELLS = expand(STUDY)
GROUP = [cell for cell in CELLS if cell.problem.name == "hertz" and cell.dual.name == "mcpg"]


@pytest.fixture
def writer(tmp_path: Path) -> ResultWriter:
    return ResultWriter(STUDY, ResultsDatabase(tmp_path, {"name": "quick"}), labels_of(CELLS))


def plan_of(writer: ResultWriter, rounds: int = 12) -> TimingPlan:
    return TimingPlan({cell: cell_queries(cell, 20.0) for cell in CELLS}, rounds, writer)


def write(writer: ResultWriter, cell: Cell, *failed: int, **columns: object) -> None:
    """A row with four queries, of which some failed; it was never timed."""
    queries = query_rows(cell.key, 4)
    for number in failed:
        queries[number]["status"] = "inaccurate"
    own = {"queries_ok": 4 - len(failed), "timing_rounds": None, "online_s": None, "machine": "this one"} | columns
    writer.database.write_cell(cell_row(cell.key, **own), queries)


def timed(stage: TimingRounds, reason: str = "") -> tuple[TimedCell, ...]:
    once = TimedRound({0: Seconds(1.0, 1.0)}, {0: Seconds(2.0, 2.0)}, 1.0)
    return tuple(TimedCell((once,) * stage.rounds, "this one", reason) for _ in stage.cells)


def test_a_group_is_timed_when_its_last_cell_has_its_row(writer: ResultWriter) -> None:
    plan = plan_of(writer)
    assert plan.start(CELLS) == []
    for cell in GROUP[:-1]:
        write(writer, cell)
        assert plan.ended(cell) is None
    write(writer, GROUP[-1], 1, 3)
    stage = plan.ended(GROUP[-1])
    assert stage is not None
    assert set(stage.cells) == {cell_queries(cell, 20.0) for cell in GROUP}
    fine = dict(zip(stage.cells, stage.queries, strict=True))
    assert fine[cell_queries(GROUP[-1], 20.0)] == (0, 2)
    assert fine[cell_queries(GROUP[0], 20.0)] == (0, 1, 2, 3)


def test_cells_without_an_ok_query_are_not_timed_and_hold_nobody_up(writer: ResultWriter) -> None:
    plan = plan_of(writer)
    plan.start(GROUP)
    for cell in GROUP[:-1]:
        write(writer, cell, 0, 1, 2, 3, status="failed")
        plan.ended(cell)
    write(writer, GROUP[-1])
    stage = plan.ended(GROUP[-1])
    assert stage is not None
    assert stage.cells == (cell_queries(GROUP[-1], 20.0),)
    assert plan_of(writer).start([])[0].cells == stage.cells


def test_a_group_of_failures_is_not_timed_at_all(writer: ResultWriter) -> None:
    plan = plan_of(writer)
    plan.start(GROUP)
    for cell in GROUP:
        write(writer, cell, 0, 1, 2, 3, status="failed")
        assert plan.ended(cell) is None


def test_seconds_are_written_once_and_asked_again_for_another_number_of_rounds(writer: ResultWriter) -> None:
    for cell in GROUP:
        write(writer, cell)
    plan = plan_of(writer)
    (stage,) = plan.start([])
    plan.record(stage, timed(stage))
    row = writer.database.cell(GROUP[0].key)
    assert row is not None
    assert (row["online_s"], row["timing_rounds"], row["timing_reason"], row["machine"]) == (3.0, 12, "", "this one")
    timings = [row for row in writer.database.rows("timings") if row["cell"] == GROUP[0].key]
    assert [row["total_s"] for row in timings] == [3.0] * 12
    (query,) = [row for row in writer.database.rows("queries") if row["cell"] == GROUP[0].key and row["query"] == 0]
    assert (query["assemble_s"], query["solve_s"]) == (1.0, 2.0)
    assert plan_of(writer).start([]) == []
    (again,) = plan_of(writer, rounds=20).start([])
    assert again.rounds == 20


def test_a_cell_that_is_done_again_is_timed_together_with_the_others(writer: ResultWriter) -> None:
    for cell in GROUP:
        write(writer, cell)
    plan = plan_of(writer)
    (stage,) = plan.start([])
    plan.record(stage, timed(stage))
    plan = plan_of(writer)
    assert plan.start(GROUP[:1]) == []
    write(writer, GROUP[0])
    stage = plan.ended(GROUP[0])
    assert stage is not None
    assert len(stage.cells) == len(GROUP)


def test_a_failed_timing_leaves_a_reason_and_is_not_tried_for_ever(writer: ResultWriter) -> None:
    for cell in GROUP:
        write(writer, cell)
    plan = plan_of(writer)
    (stage,) = plan.start([])
    plan.record(stage, Failed(Status.CRASHED, "the worker died"))
    row = writer.database.cell(GROUP[0].key)
    assert row is not None
    assert (row["online_s"], row["timing_reason"]) == (None, "all rounds: the worker died")
    assert plan_of(writer).start([]) == []


def test_the_machine_that_timed_a_cell_is_named(writer: ResultWriter) -> None:
    """Break-even compares seconds of one machine alone."""
    for cell in GROUP:
        write(writer, cell)
    plan = plan_of(writer)
    (stage,) = plan.start([])
    plan.record(stage, tuple(TimedCell(one.rounds, "another", "") for one in timed(stage)))
    row = writer.database.cell(GROUP[0].key)
    assert row is not None
    assert row["machine"] == "another; this one"


def test_what_is_not_timing_is_none_of_its_business(writer: ResultWriter) -> None:
    plan_of(writer).record(cell_queries(GROUP[0], 20.0), Failed(Status.ERROR, "anything"))
    assert list(writer.database.rows("cells")) == []


def test_a_group_costs_the_same_however_many_there_are() -> None:
    def run(groups: int) -> Callable[[], object]:
        tolerances = [0.1 / (k + 1) for k in range(groups)]
        asked = {"problem": ["obstacle"], "dual": ["mcpg"], "primal": ["decorrelated"], "pod": tolerances}
        cells = expand(read_study("quick", asked))
        goals = {cell: cell_queries(cell, 20.0) for cell in cells}
        assert all(goal.key for goal in goals.values())  # hashed before the count
        rows = {"queries_ok": 4, "timing_rounds": None}
        database = SimpleNamespace(cell=lambda _: rows, fine_queries=lambda _: (0, 1))
        writer: Any = SimpleNamespace(database=database, seconds=lambda *_: None)

        def work() -> None:
            plan = TimingPlan(goals, 1, writer)
            plan.start(cells)
            for cell in cells:
                if (stage := plan.ended(cell)) is not None:
                    plan.record(stage, Failed(Status.ERROR, "not here"))

        return work

    assert growth(run, 8) < 1.1
