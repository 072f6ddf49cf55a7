"""Which cells are timed together, when, and when again."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from counting import growth
from samples import cell_row, query_rows

from vibench.execution.recording import ResultWriter, labels_of
from vibench.execution.timing_plan import TimingPlan, block_sizes
from vibench.qp.status import Status
from vibench.results.database import ResultsDatabase
from vibench.stages.base import Failed
from vibench.stages.cell_queries import CellQueries, cell_queries
from vibench.stages.timing_rounds import TimedCell, TimedRound, TimingRounds
from vibench.study.cells import Cell
from vibench.study.matrix import expand, read_study
from vibench.timing import Seconds

STUDY = read_study("quick")
CELLS = expand(STUDY)
FIXED = "offline-pga"
GROUP = [cell for cell in CELLS if cell.problem.name == "hertz" and cell.dual.name == "mcpg"]


@pytest.fixture
def writer(tmp_path: Path) -> ResultWriter:
    return ResultWriter(STUDY, ResultsDatabase(tmp_path, {"name": "quick"}), labels_of(CELLS))


def plan_of(writer: ResultWriter, rounds: int = 12) -> TimingPlan:
    return TimingPlan({cell: cell_queries(cell, 20.0) for cell in CELLS}, rounds, writer, 0)


def write(writer: ResultWriter, cell: Cell, *failed: int, **columns: object) -> None:
    """A row with four queries, of which some failed; it was never timed."""
    queries = query_rows(cell.key, 4)
    for number in failed:
        queries[number]["status"] = "inaccurate"
    own = {"queries_ok": 4 - len(failed), "timing_rounds": None, "online_s": None, "machine": "this one"} | columns
    own |= {"offline_s": 10.0, "offline_low_s": None, "hf_setup_s": 1.0, "primal": cell.primal.name}
    kinds = {"decorrelated": "none", "online-supremizers": "per-parameter", FIXED: "fixed"}
    own |= {"enrichment_kind": kinds[cell.primal.name], "solver": cell.solver, "assembly": "full"}
    writer.database.write_cell(cell_row(cell.key, **own), queries)


def timed(stage: TimingRounds, unsteady: float = 0.0) -> tuple[TimedCell, ...]:
    """A block in which a query takes two seconds to solve, one to assemble, and a high-fidelity solution thirty.

    Those of fixed enrichments deviate by the factor `unsteady`, in even blocks above and in others below.
    """
    numbers = range(stage.first, stage.first + stage.rounds)
    even = stage.first // stage.rounds % 2 == 0

    def once(cell: CellQueries) -> TimedRound:
        factor = np.exp(unsteady * (1.2 if even else -1.0)) if cell.built.enrichment.primal.name == FIXED else 1.0
        own = Seconds(factor, factor), Seconds(2.0 * factor, 2.0 * factor)
        return TimedRound({0: own[0]}, {0: own[1]}, 1.0, beside=Seconds(30.0, 30.0))

    return tuple(TimedCell(dict.fromkeys(numbers, once(cell)), "this one") for cell in stage.cells)


def record(plan: TimingPlan, stage: TimingRounds | None, unsteady: float = 0.0) -> list[TimingRounds]:
    """Record a stage and those that follow it; returns all of them."""
    stages = []
    while stage is not None:
        stages.append(stage)
        stage = plan.record(stage, timed(stage, unsteady))
    return stages


def first_row(writer: ResultWriter) -> dict[str, Any]:
    row = writer.database.cell(GROUP[0].key)
    assert row is not None
    return row


def begun(writer: ResultWriter, rounds: int = 12) -> tuple[TimingPlan, TimingRounds]:
    """A plan, and the first stage of the group, whose cells all have their rows."""
    for cell in GROUP:
        write(writer, cell)
    plan = plan_of(writer, rounds)
    (stage,) = plan.start([])
    return plan, stage


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


def test_seconds_are_written_once_and_asked_again_for_another_number_of_rounds(writer: ResultWriter) -> None:
    plan, stage = begun(writer)
    record(plan, stage)
    row = first_row(writer)
    assert (row["online_s"], row["hf_s"]) == pytest.approx((3.0, 30.0))
    assert (row["timing_rounds"], row["timed_rounds"], row["timing_reason"]) == (12, 6, "")
    assert row["machine"] == "this one"
    timings = [row for row in writer.database.rows("timings") if row["cell"] == GROUP[0].key]
    assert [(row["total_s"], row["round"]) for row in timings] == [(3.0, k) for k in range(6)]
    assert [row["hf_s"] for row in timings] == pytest.approx([30.0] * 6)
    (query,) = [row for row in writer.database.rows("queries") if row["cell"] == GROUP[0].key and row["query"] == 0]
    assert (query["assemble_s"], query["solve_s"]) == (1.0, 2.0)
    assert plan_of(writer).start([]) == []
    (again,) = plan_of(writer, rounds=20).start([])
    assert (again.rounds, again.first) == (4, 0)  # twenty are six blocks of three or four


def test_rounds_come_in_passes_and_at_least_two_blocks_where_they_decide() -> None:
    sizes = {1: [1], 5: [5], 6: [3, 3], 7: [4, 3], 8: [4, 4], 10: [4, 3, 3], 12: [3] * 4}
    assert {rounds: block_sizes(rounds) for rounds in sizes} == sizes


def test_rounds_end_for_the_cells_whose_comparisons_are_decided(writer: ResultWriter) -> None:
    """Thirty seconds against three are decided in two blocks, enrichments that differ by less than they scatter not."""
    plan, stage = begun(writer)
    stages = record(plan, stage, unsteady=0.1)
    assert [(one.first, one.rounds) for one in stages] == [(3 * k, 3) for k in range(len(stages))]
    assert [one.session for one in stages] == list(range(len(stages)))
    assert len(stages) > 2
    assert [len(one.cells) for one in stages[:2]] == [len(GROUP)] * 2
    compared = {cell_queries(cell, 20.0) for cell in GROUP if cell.primal.name != "decorrelated"}
    assert all(set(one.cells) <= compared for one in stages[2:])
    counts = {(cell.primal.name, (writer.database.cell(cell.key) or {})["timed_rounds"]) for cell in GROUP}
    assert {count for name, count in counts if name == "decorrelated"} == {6}
    assert max(count for _, count in counts) == 3 * len(stages)


def test_rounds_end_where_a_decision_would_take_far_too_many(writer: ResultWriter) -> None:
    """Two equal enrichments are never told apart."""
    plan, stage = begun(writer, rounds=60)
    assert len(record(plan, stage)) == 2


def test_as_many_rounds_as_are_asked_for_at_least(writer: ResultWriter) -> None:
    for cell in GROUP:
        write(writer, cell)
    plan = TimingPlan({cell: cell_queries(cell, 20.0) for cell in CELLS}, 60, writer, 15)
    (stage,) = plan.start([])
    assert [len(one.cells) for one in record(plan, stage)] == [len(GROUP)] * 5


def test_a_group_that_was_not_timed_to_the_end_is_timed_again(writer: ResultWriter) -> None:
    """As after an interruption between two blocks; what was measured can be shown until then."""
    plan, stage = begun(writer)
    plan.record(stage, timed(stage))
    row = first_row(writer)
    assert (row["online_s"], row["timing_rounds"], row["timed_rounds"]) == (pytest.approx(3.0), None, 3)
    (again,) = plan_of(writer).start([])
    assert len(again.cells) == len(GROUP)


def test_a_cell_that_is_done_again_is_timed_together_with_the_others(writer: ResultWriter) -> None:
    plan, stage = begun(writer)
    record(plan, stage)
    plan = plan_of(writer)
    assert plan.start(GROUP[:1]) == []
    write(writer, GROUP[0])
    stage = plan.ended(GROUP[0])
    assert stage is not None
    assert len(stage.cells) == len(GROUP)


def test_a_failed_timing_leaves_a_reason_and_is_not_tried_for_ever(writer: ResultWriter) -> None:
    plan, stage = begun(writer)
    assert plan.record(stage, Failed(Status.CRASHED, "the worker died")) is None
    row = first_row(writer)
    assert (row["online_s"], row["timing_reason"]) == (None, "all rounds: the worker died")
    assert plan_of(writer).start([]) == []


def test_the_machine_that_timed_a_cell_is_named(writer: ResultWriter) -> None:
    """Break-even compares seconds of one machine alone."""
    plan, stage = begun(writer)
    plan.record(stage, tuple(TimedCell(one.rounds, "another") for one in timed(stage)))
    row = first_row(writer)
    assert row["machine"] == "another; this one"


def test_groups_of_failures_and_what_is_not_timing_are_not_timed(writer: ResultWriter) -> None:
    plan_of(writer).record(cell_queries(GROUP[0], 20.0), Failed(Status.ERROR, "anything"))
    assert list(writer.database.rows("cells")) == []
    plan = plan_of(writer)
    plan.start(GROUP)
    for cell in GROUP:
        write(writer, cell, 0, 1, 2, 3, status="failed")
        assert plan.ended(cell) is None


def test_a_group_costs_the_same_however_many_there_are() -> None:
    def run(groups: int) -> Callable[[], object]:
        tolerances = [0.1 / (k + 1) for k in range(groups)]
        asked = {"problem": ["obstacle"], "dual": ["mcpg"], "primal": ["decorrelated"], "pod": tolerances}
        cells = expand(read_study("quick", asked))
        goals = {cell: cell_queries(cell, 20.0) for cell in cells}
        assert all(goal.key for goal in goals.values())  # hashed before the count
        rows = {"queries_ok": 4, "timing_rounds": None}
        reading = {"cell": lambda _: rows, "fine_queries": lambda _: (0, 1)}
        database = SimpleNamespace(**reading, write_columns=lambda *_: None)
        writer: Any = SimpleNamespace(database=database, seconds=lambda *_: None)

        def work() -> None:
            plan = TimingPlan(goals, 1, writer, 0)
            plan.start(cells)
            for cell in cells:
                if (stage := plan.ended(cell)) is not None:
                    plan.record(stage, Failed(Status.ERROR, "not here"))

        return work

    assert growth(run, 8) < 1.1
