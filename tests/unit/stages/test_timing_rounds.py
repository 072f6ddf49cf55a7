"""Rounds of timing: what is timed in which order, and what becomes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import SampleStore, carry_out

from vibench.interfaces.strategies import Stop
from vibench.qp.status import Status
from vibench.stages import timing_rounds
from vibench.stages.assembly import AssemblyStage
from vibench.stages.base import Failed
from vibench.stages.cell_queries import CellQueries
from vibench.stages.enrichment import SingleEnrichment
from vibench.stages.offline import ConeStage, PODStage
from vibench.stages.timing_rounds import TimedRound, TimingRounds, round_rows, seconds_of_cell, seconds_of_queries
from vibench.study.parameter_sets import ParameterSet
from vibench.study.plugin import Plugin
from vibench.timing import Seconds

PROBLEM = Plugin("problem", "obstacle", '{"resolution": 200}', "test")
VALIDATION = 6


def cell(primal: str = "decorrelated", solver: str = "piqp", interpolation: float | None = None) -> CellQueries:
    cone = ConeStage(PROBLEM, Plugin("dual strategy", "cpg", "{}", "test"), Stop(size=4))
    strategy = Plugin("primal strategy", primal, "{}", "test")
    enrichment = SingleEnrichment(PODStage(PROBLEM, Stop(size=4)), cone, strategy, None)
    return CellQueries(
        AssemblyStage(enrichment, interpolation, ParameterSet("validation", VALIDATION, 1)), solver, 1e-7, 20.0
    )


CELLS = (cell(), cell(solver="osqp"), cell("online-supremizers"), cell(interpolation=1e-6))
EVERY = tuple(range(VALIDATION))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    store = SampleStore(tmp_path_factory.mktemp("artefacts"))
    for stage in TimingRounds(CELLS, (EVERY,) * len(CELLS), 1).inputs():
        if store.get(stage.key) is None:
            carry_out(stage, store)
    return store


def steady(seconds: float, queries: tuple[int, ...] = (0, 1), slowdown: float = 1.0) -> TimedRound:
    return TimedRound({0: Seconds(seconds, seconds)}, dict.fromkeys(queries, Seconds(seconds, seconds)), slowdown)


@given(st.integers(1, 9), st.integers(1, 9))
def test_every_round_has_every_cell_once_before_the_next_one_begins(rounds: int, count: int) -> None:
    stage = TimingRounds((CELLS[0],) * count, (EVERY,) * count, rounds)
    places = [stage.place(item) for item in range(stage.items)]
    assert [number for number, _ in places] == sorted(number for number, _ in places)
    assert sorted(places) == [(number, k) for number in range(rounds) for k in range(count)]


def test_the_order_of_the_cells_changes_from_round_to_round() -> None:
    """Whoever comes after a large model finds its own arrays out of the cache: not always the same one."""
    stage = TimingRounds((CELLS[0],) * 6, (EVERY,) * 6, 12)
    first = {stage.place(number * 6)[1] for number in range(12)}
    assert len(first) > 3


def test_a_machine_that_slows_down_halfway_meets_all_cells_alike() -> None:
    """Cell after cell, the second of two equal ones would seem thrice as slow."""
    stage = TimingRounds((CELLS[0],) * 2, (EVERY,) * 2, 12)
    items = [steady(1.0 if item < stage.items / 2 else 3.0) for item in range(stage.items)]
    timed = timing_rounds._Rounds.finish(_in(stage), items)
    one, other = (seconds_of_cell(round_rows(each.rounds), 1.0) for each in timed)
    assert one == other
    assert one["online_q1_s"] < one["online_s"] < one["online_q3_s"]


def _in(stage: TimingRounds) -> timing_rounds._Rounds:
    """Rounds in progress, without the models."""
    rounds = object.__new__(timing_rounds._Rounds)
    rounds._stage = stage
    return rounds


def test_every_ok_query_is_timed_and_no_other(store: SampleStore) -> None:
    fine = (EVERY, (0, 2, 5), EVERY, (3,))
    timed = TimingRounds(CELLS, fine, 8).run(store).value
    for one, numbers in zip(timed, fine, strict=True):
        assert len(one.rounds) == 8
        assert {k for each in one.rounds for k in each.solve} == set(numbers)
        assert all(s.cpu > 0.0 for each in one.rounds for part in (each.assemble, each.solve) for s in part.values())
        assert one.reason == ""
        rows = seconds_of_queries(one.rounds)
        assert set(rows) == set(numbers)
        assert all(row["total_s"] == row["assemble_s"] + row["solve_s"] for row in rows.values())


def test_reduced_assembly_is_timed_at_every_query_and_full_assembly_once_a_round(store: SampleStore) -> None:
    timed = TimingRounds(CELLS, (EVERY,) * len(CELLS), 2).run(store).value
    assert [[len(each.assemble) for each in one.rounds] for one in timed[:3]] == [[1, 1]] * 3
    assert all(each.assemble.keys() == each.solve.keys() for each in timed[3].rounds)


def test_matrices_in_full_are_assembled_once_in_a_round_for_all_cells(
    store: SampleStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[float] = []
    plain = timing_rounds.checked_assembly
    monkeypatch.setattr(
        timing_rounds, "checked_assembly", lambda problem, mu: (calls.append(float(mu[0])), plain(problem, mu))[1]
    )
    TimingRounds(CELLS[:3], (EVERY,) * 3, 4).run(store)
    assert len(calls) == 1 + 4  # a warm-up, then once per round, at another parameter each time
    assert len({round(mu, 6) for mu in calls}) == 4
    assert len(set(calls)) == 5


def test_a_round_that_takes_long_ends_early(store: SampleStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing_rounds, "ROUND_SECONDS", 0.0)
    (timed,) = TimingRounds(CELLS[:1], (EVERY,), 4).run(store).value
    assert [len(each.solve) for each in timed.rounds] == [1] * 4


def test_a_lost_round_is_told_and_the_others_count() -> None:
    stage = TimingRounds((CELLS[0],) * 2, (EVERY,) * 2, 3)
    items: list[TimedRound | Failed] = [steady(2.0) for _ in range(stage.items)]
    items[stage.items - 1] = Failed(Status.CRASHED, "the worker died")
    unlucky = stage.place(stage.items - 1)[1]
    timed = _in(stage).finish(items)
    assert [len(one.rounds) for one in timed] == [2 if k == unlucky else 3 for k in range(2)]
    assert timed[unlucky].reason == "1 of 3 rounds: the worker died"
    assert timed[1 - unlucky].reason == ""


def test_a_certificate_is_a_part_of_its_query() -> None:
    rounds = [replace(steady(1.0), certify=dict.fromkeys((0, 1), Seconds(spent, 2.0))) for spent in (0.25, 0.5, 4.0)]
    rows = round_rows(rounds)
    assert [(row["certify_s"], row["total_s"], row["total_wall_s"]) for row in rows] == [
        (0.25, 2.25, 4.0), (0.5, 2.5, 4.0), (4.0, 6.0, 4.0),
    ]  # fmt: skip
    assert (seconds_of_cell(rows, 1.0)["online_certify_s"], seconds_of_cell(rows, 1.0)["online_s"]) == (0.5, 2.5)
    assert seconds_of_queries(rounds)[1]["certify_s"] == 0.5


def test_columns_are_medians_and_quartiles_over_the_rounds() -> None:
    rounds = [
        TimedRound({k: Seconds(0.5, 1.0)}, {k: Seconds(spent, spent), k + 4: Seconds(spent, spent)}, slow)
        for k, (spent, slow) in enumerate([(1.0, 1.0), (3.0, 1.2), (2.0, 1.4), (8.0, 3.0)])
    ]
    rows = round_rows(rounds)
    assert [row["total_s"] for row in rows] == [1.5, 3.5, 2.5, 8.5]
    assert [(row["round"], row["queries"]) for row in rows] == [(k, 2) for k in range(4)]
    own = seconds_of_cell(rows, 10.0)
    assert (own["online_s"], own["online_solve_s"], own["online_assemble_s"]) == (3.0, 2.5, 0.5)
    assert (own["online_q1_s"], own["online_q3_s"]) == tuple(np.quantile([1.5, 3.5, 2.5, 8.5], (0.25, 0.75)))
    assert own["online_wall_s"] == 3.5
    assert own["slowdown"] == pytest.approx(1.3)
    slowdowns = np.array([1.0, 1.2, 1.4, 3.0]) / 1.3
    ends = 10.0 * np.quantile(slowdowns, (0.025, 0.975))
    assert (own["offline_low_s"], own["offline_high_s"]) == pytest.approx(tuple(ends))
    queries = seconds_of_queries([replace(one, assemble={k: one.assemble[k]}) for k, one in enumerate(rounds)])
    assert queries[2] == {"assemble_s": 0.5, "solve_s": 2.0, "certify_s": None, "total_s": 2.5, "total_wall_s": 3.0}
    assert own["online_certify_s"] is None
    assert set(seconds_of_cell([], 10.0)) == set(own)
    assert set(seconds_of_cell([], 10.0).values()) == {None}


@pytest.mark.parametrize(("wall", "slow", "disturbed"), [(1.0, 1.0, 0), (1.6, 1.0, 1), (1.0, 1.4, 1)])
def test_a_machine_that_waits_or_is_slow_marks_the_row(wall: float, slow: float, disturbed: int) -> None:
    once = TimedRound({0: Seconds(1.0, wall)}, {0: Seconds(1.0, wall)}, slow)
    assert seconds_of_cell(round_rows([once] * 3), 1.0)["disturbed"] == disturbed


def test_the_limit_of_the_stage_is_that_of_all_its_cells(tmp_path: Path) -> None:
    assert TimingRounds(CELLS, (EVERY,) * 4, 12).weight == 4
    assert CELLS[0].weight == 1
