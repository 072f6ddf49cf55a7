from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from counting import growth
from samples import SampleStore, carry_out, cell_row, query_rows

from vibench import Status
from vibench.execution.recording import ResultWriter, labels_of
from vibench.execution.timing_plan import OfflinePlan, TimingPlan, block_sizes
from vibench.results.break_even import scatter
from vibench.results.database import ResultsDatabase
from vibench.stages import timing_rounds
from vibench.stages.assembly import ExactSolutions
from vibench.stages.base import Failed, Stage
from vibench.stages.cell_queries import CellQueries, cell_queries
from vibench.stages.timing_rounds import OfflineRepeat, TimedCell, TimedRound, TimingRounds
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
    return TimingPlan({cell: cell_queries(cell, 20.0) for cell in CELLS}, rounds, writer, 0, 0.25)


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
    stages = []
    while stage is not None:
        stages.append(stage)
        stage = plan.record(stage, timed(stage, unsteady)) or next(iter(plan.further(1)), None)
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
    assert all(set(later.cells) <= set(one.cells) for one, later in pairwise(stages))
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
    plan = TimingPlan({cell: cell_queries(cell, 20.0) for cell in CELLS}, 60, writer, 15, 0.25)
    (stage,) = plan.start([])
    assert [len(one.cells) for one in record(plan, stage)] == [len(GROUP)] * 5


def test_further_rounds_wait_for_all_else_and_take_a_share_of_its_seconds(writer: ResultWriter) -> None:
    """A group is nearer to a decision where a round takes fewer seconds."""
    for cell in CELLS:
        if cell.problem.name == "hertz":
            write(writer, cell)
    plan, others = plan_of(writer, 18), 0.0
    for first, seconds in zip(plan.start([]), (5.0, 1.0), strict=True):
        stage: TimingRounds | None = first
        while stage is not None:
            others += seconds * stage.items
            plan.note(stage, spent(seconds * stage.items))
            stage = plan.record(stage, timed(stage, 0.14))
    affordable = plan.further(2)
    assert sum(one.items for one in affordable) <= 0.25 * others
    assert all(set(one.cells) <= {cell_queries(cell, 20.0) for cell in GROUP} for one in affordable)
    assert [one.session for one in affordable] == [2]
    plan.note(affordable[0], spent(0.25 * others))
    plan.record(affordable[0], timed(affordable[0], 0.14))
    assert plan.further(2) == []
    plan.note(ExactSolutions(GOAL.assembly), spent(1e6))
    # A cold process serves two groups, and none twice.
    last = plan.further(2)
    assert [one.session for one in last] == [2, 3]
    assert [set(one.cells).isdisjoint(affordable[0].cells) for one in last] == [True, False]
    assert plan.further(2) == []


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
        tolerances = [0.1 / (groups + k) for k in range(groups)]  # keys of equal cells are kept
        asked = {"problem": ["obstacle"], "dual": ["mcpg"], "primal": ["decorrelated"], "pod": tolerances}
        cells = expand(read_study("quick", asked))
        goals = {cell: cell_queries(cell, 20.0) for cell in cells}
        assert all(goal.key for goal in goals.values())  # hashed before the count
        rows = {"queries_ok": 4, "timing_rounds": None}
        reading = {"cell": lambda _: rows, "fine_queries": lambda _: (0, 1)}
        database = SimpleNamespace(**reading, write_columns=lambda *_: None)
        writer: Any = SimpleNamespace(database=database, seconds=lambda *_: None)

        def work() -> None:
            plan = TimingPlan(goals, 1, writer, 0, 0.25)
            plan.start(cells)
            for cell in cells:
                if (stage := plan.ended(cell)) is not None:
                    plan.record(stage, Failed(Status.ERROR, "not here"))

        return work

    assert growth(run, 8) < 1.1


ASKED = {"problem": ["hertz"], "dual": ["mcpg"], "primal": ["offline-pga"], "solvers": ["piqp"]}
(CELL,) = expand(read_study("quick", ASKED))
GOAL = cell_queries(CELL, 20.0)
STAGES = list({stage.key: stage for stage in timing_rounds.sources(GOAL)}.values())


def spent(seconds: float) -> Seconds:
    return Seconds(seconds, seconds)


def offline_plan_of(seconds: Mapping[str, float], requested: int = 0) -> tuple[OfflinePlan, list[OfflineRepeat]]:
    plan = OfflinePlan(None, SimpleNamespace(), requested)  # type: ignore[arg-type]
    for key, cpu in seconds.items():
        plan.note(next(stage for stage in STAGES if stage.key == key), spent(cpu), 1.5 * cpu)
    return plan, plan.repeats([(CELL, GOAL)])


def test_short_stages_are_repeated_within_the_budget_and_offline_alone() -> None:
    costs = dict(zip((stage.key for stage in STAGES), (0.5, 0.1, 2.0, 0.2, 0.3, 9.0, 0.1), strict=False))
    plan, repeats = offline_plan_of(costs)
    paid = [costs[one.stage.key] for one in repeats]
    assert sum(paid) <= 0.3 * sum(costs.values())
    assert max(paid) <= 3.0
    firsts = [costs[one.stage.key] for one in repeats if one.number == 1]
    assert firsts == sorted(cost for cost in costs.values() if cost <= 3.0)
    assert plan.repeats([(CELL, GOAL)]) == []  # once is enough
    costs = {stage.key: 1.0 for stage in STAGES}
    _, repeats = offline_plan_of(costs)
    plan = OfflinePlan(None, SimpleNamespace(), 0)  # type: ignore[arg-type]
    plan.note(ExactSolutions(GOAL.assembly), spent(100.0), 100.0)
    for stage in STAGES:
        plan.note(stage, spent(1.0), 1.0)
    assert plan.repeats([(CELL, GOAL)]) == repeats
    assert 0 < len(repeats) < 2 * len(STAGES)
    costs = dict.fromkeys((stage.key for stage in STAGES), 100.0)
    _, repeats = offline_plan_of(costs, requested=3)
    assert sorted(one.number for one in repeats) == sorted([1, 2, 3] * len(STAGES))


def test_the_seconds_of_a_nested_enrichment_are_those_of_its_growth(tmp_path_factory: pytest.TempPathFactory) -> None:
    store = SampleStore(tmp_path_factory.mktemp("artefacts"))
    enrichment = GOAL.built.enrichment
    carry_out(enrichment, store)
    source, name = enrichment.measured_by
    repeat = OfflineRepeat(source, 1)
    store.put(repeat.key, (result := repeat.run(store)).value, result.seconds, ())
    first, again = store.get(enrichment.key), repeat.seconds(store, name)
    assert first is not None
    assert again.cpu == result.value[name][0] > 0.0
    assert repeat.seconds(store, name) == again
    assert OfflineRepeat(source, 2).seconds(store, name) is None


def test_medians_count_scatter_is_pooled_and_repeats_narrow_intervals() -> None:
    rng = np.random.default_rng(0)
    runs = [[spent(base * float(np.exp(0.3 * rng.standard_normal()))) for _ in range(3)] for base in [0.1, 1.0] * 300]
    assert (scatter(runs), scatter([[spent(1.0)]])) == (pytest.approx(0.3, rel=0.05), 0.2)
    assert scatter([*runs, [spent(1e-5), spent(1e-3)]]) == scatter(runs)  # too short to say anything
    found = columns({"high-fidelity solutions": [1.0, 2.0, 9.0], "cone": [3.0, 5.0]})
    assert (found["offline_snapshots_s"], found["offline_cone_s"]) == (4 * 2.0 + 0.5, 4.0)
    assert (found["offline_s"], found["offline_repeats"]) == (12.5, 5)

    def width(**runs: list[float]) -> float:
        found = columns({name.replace("_", " "): values for name, values in runs.items()})
        return float(np.log(found["offline_high_s"] / found["offline_low_s"]))

    once = width(cone=[1.0])
    assert (once, width(cone=[1.0] * 4)) == (pytest.approx(2.0 * 1.96 * 0.1), pytest.approx(once / 2.0))
    assert width(cone=[1.0], POD=[1e-6] * 4) == pytest.approx(once, rel=1e-3)


def columns(runs_of: Mapping[str, list[float]], deviation: float = 0.1) -> dict[str, Any]:
    stages: dict[str, Stage] = {one.key: one for some in GOAL.offline_stages.values() for one in some}
    runs = {key: [spent(cpu) for cpu in runs_of.get(stage.label, [0.0])] for key, stage in stages.items()}
    return timing_rounds.offline_columns(GOAL, 0.5, runs, deviation)


def test_seconds_of_cells_whose_artefacts_are_gone_stay_as_they_are() -> None:
    written: list[str] = []
    database = SimpleNamespace(cell=lambda _: {"hf_setup_s": 1.0}, write_columns=lambda key, _: written.append(key))
    writer = SimpleNamespace(database=database)
    for there in (False, True):
        artefact = SimpleNamespace(seconds=spent(1.0), value={"": [1.0, 1.0]}) if there else None
        plan = OfflinePlan(SimpleNamespace(get=lambda _, found=artefact: found), writer, 0)  # type: ignore[arg-type]
        plan.repeats([(CELL, GOAL)])
        plan._seconds = {}
        if there:
            plan._runs = lambda stage: [spent(1.0)]  # type: ignore[method-assign]
        plan.finish()
    assert written == [CELL.key]
    assert isinstance(GOAL, CellQueries)
