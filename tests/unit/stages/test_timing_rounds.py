from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import SampleStore, mixed_cell, store_of

from vibench import MEMBERS, NumericalError, QPSolution, Status, Stop, VariationalInequality, solve_qp
from vibench.highfidelity import active_set
from vibench.model.galerkin import ReducedModel
from vibench.model.hyperreduced import HyperReducedModel
from vibench.plugins import registry
from vibench.plugins.plugin import Plugin
from vibench.stages import marginal_solutions, timing_rounds
from vibench.stages.base import Failed
from vibench.stages.cell_queries import CellQueries
from vibench.stages.marginal_solutions import MarginalSolution, MarginalSolutions, SolutionsBeside, parts_alike
from vibench.stages.query import ProgramQuery
from vibench.stages.snapshots import gather
from vibench.stages.timing_rounds import TimedCell, TimedRound, TimingRounds
from vibench.study.parameter_sets import ParameterSet
from vibench.timing import NO_TIME, Seconds

PROBLEM = Plugin("problem", "obstacle", '{"resolution": 200}', "test")
VALIDATION = 6


def cell(
    primal: str = "decorrelated", solver: str = "piqp", interpolation: float | None = None, count: int = VALIDATION,
    accuracy: float = 1e-7,
) -> CellQueries:  # fmt: skip
    kinds = Stop(size=4), "cpg", Stop(size=4), primal, ParameterSet("validation", count, 1)
    return mixed_cell(PROBLEM, *kinds, interpolation=interpolation, solver=solver, accuracy=accuracy)


CELLS = (cell(), cell(solver="osqp"), cell("online-supremizers"), cell(interpolation=1e-6))
EVERY = tuple(range(VALIDATION))
OF_THREE = tuple(
    cell(solver=solver, interpolation=interpolation, count=3, accuracy=1e-8)
    for interpolation in (None, 1e-6) for solver in ("remembers", "other")
)  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    rounds = (TimingRounds(cells, (EVERY,) * 4, 1, 0) for cells in (CELLS, OF_THREE))
    return store_of(tmp_path_factory.mktemp("artefacts"), (stage for one in rounds for stage in one.inputs()))


def as_rows(*rounds: TimedRound, hf: float | None = 4.0, pace: float = 1.0, per_block: int = 4) -> list[dict[str, Any]]:
    return [
        {"block": str(k // per_block), "round": k, "queries": len(one.solve), "slowdown": one.slowdown}
        | {"hf_s": hf, "pace": pace}
        | timing_rounds.round_columns(one)
        for k, one in enumerate(rounds)
    ]


def steady(seconds: float, queries: tuple[int, ...] = (0, 1), slowdown: float = 1.0) -> TimedRound:
    return TimedRound({0: Seconds(seconds, seconds)}, dict.fromkeys(queries, Seconds(seconds, seconds)), slowdown)


@given(st.integers(1, 9), st.integers(1, 9))
def test_every_round_has_every_cell_once_before_the_next_one_begins(rounds: int, count: int) -> None:
    stage = TimingRounds((CELLS[0],) * count, (EVERY,) * count, rounds, 0)
    places = [stage.place(item) for item in range(stage.items)]
    assert [number for number, _ in places] == sorted(number for number, _ in places)
    assert sorted(places) == [(number, k) for number in range(rounds) for k in range(count)]


def test_rounds_visit_cells_in_other_orders_and_a_slow_machine_meets_all_alike() -> None:
    """Whoever comes after a large model finds its own arrays out of the cache: not always the same one."""
    stage = TimingRounds((CELLS[0],) * 6, (EVERY,) * 6, 12, 0)
    first = [stage.place(number * 6)[1] for number in range(12)]
    assert len(set(first)) > 3
    later = TimingRounds((CELLS[0],) * 6, (EVERY,) * 6, 4, 8)
    assert [later.place(number * 6)[1] for number in range(4)] == first[8:]
    assert (TimingRounds(CELLS, (EVERY,) * 4, 12, 0).weight, CELLS[0].weight) == (4, 1)
    # Cell after cell, the second of two equal ones would seem thrice as slow.
    stage = TimingRounds((CELLS[0],) * 2, (EVERY,) * 2, 12, 0)
    spent = [1.0 if item < stage.items / 2 else 3.0 for item in range(stage.items)]
    items = [replace(steady(one), beside=Seconds(2.0 * one, 2.0 * one)) for one in spent]
    timed = timing_rounds._Rounds.collect(_in(stage), items)
    one, other = map(timing_rounds.seconds_of_cell, timing_rounds.block_rows(stage, timed))
    assert one == other
    assert one["online_q1_s"] < one["online_s"] < one["online_q3_s"]
    assert one["online_s"] == pytest.approx(one["hf_s"])


def _in(stage: TimingRounds) -> timing_rounds._Rounds:
    rounds = object.__new__(timing_rounds._Rounds)
    rounds._stage = stage
    return rounds


def test_every_ok_query_is_timed_and_long_rounds_end_early(store: SampleStore, monkeypatch: pytest.MonkeyPatch) -> None:
    fine = (EVERY, (0, 2, 5), EVERY, (3,))
    timed = TimingRounds(CELLS, fine, 8, 0).run(store).value
    for one, numbers in zip(timed, fine, strict=True):
        rounds = list(one.rounds.values())
        assert list(one.rounds) == list(range(8))
        assert {k for each in rounds for k in each.solve} == set(numbers)
        assert all(s.cpu > 0.0 for each in rounds for part in (each.assemble, each.solve) for s in part.values())
        assert all(each.beside_cpu > 0.0 for each in rounds)
        assert not one.failures
        rows = timing_rounds.seconds_of_queries(list(one.rounds.values()))
        assert set(rows) == set(numbers)
        assert all(row["total_s"] == row["assemble_s"] + row["solve_s"] for row in rows.values())
    prepare = ProgramQuery.prepare
    monkeypatch.setattr(ProgramQuery, "prepare", lambda *of: lambda: (prepare(*of)()[0], Seconds(0.1, 6.0)))
    timed = TimingRounds(CELLS[:1], (EVERY,), 4, 0).run(store).value[0]
    assert [len(each.solve) for each in timed.rounds.values()] == [1] * 4


@pytest.mark.parametrize(("enough", "in_full"), [(0.0, 1), (np.inf, VALIDATION)])
def test_reduced_assembly_is_timed_at_every_query_and_full_assembly_at_as_many_as_are_enough(
    store: SampleStore, monkeypatch: pytest.MonkeyPatch, enough: float, in_full: int
) -> None:
    monkeypatch.setattr(timing_rounds, "ASSEMBLY_SECONDS", enough)
    monkeypatch.setattr(timing_rounds, "QUERY_SUBSETS", 1)
    timed = TimingRounds(CELLS, (EVERY,) * len(CELLS), 2, 0).run(store).value
    assert [[len(each.assemble) for each in one.rounds.values()] for one in timed[:3]] == [[in_full] * 2] * 3
    assert all(each.assemble.keys() == each.solve.keys() for each in timed[3].rounds.values())


def test_high_fidelity_solutions_start_as_in_the_sweep(store: SampleStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the contact set of the nearest parameter before; the first one of a part from that of the nearest after."""
    stage = TimingRounds(CELLS, (EVERY,) * len(CELLS), 1, 0)
    reference = gather(store, stage.cells[0].validation)
    starts: list[Any] = []
    solve = active_set.solve_unverified
    monkeypatch.setattr(active_set, "solve_unverified", lambda *a: (starts.append(a[2]), solve(*a))[1])
    marginal = MarginalSolutions(PROBLEM.create(), reference, 1)
    assert all(one.seconds and one.seconds.cpu > one.assembly.cpu for one in (marginal.solve(k, 0) for k in EVERY))
    sources = [[1], [0], [2], [3], [5], [4]]  # in parts of two, one, one and two
    for start, numbers in zip(starts, sources, strict=True):
        assert any(np.array_equal(start, reference.lam[:, number] > 0.0) for number in numbers)
    # A problem may derive another start, as the American put does.
    own = np.zeros(len(reference.lam), bool)
    monkeypatch.setattr(type(marginal._problem), "start", lambda *_: own)
    assert marginal.solve(0, 1).seconds
    assert starts[-1] is own
    wrong = replace(reference, u=reference.u[:, ::-1].copy())
    assert MarginalSolutions(PROBLEM.create(), wrong, 1).solve(0, 0).seconds is None


class Given(MarginalSolutions):
    """Solutions that take the given seconds, `None` of those that fail; what was asked for is kept."""

    def __init__(self, *taken: float | None) -> None:
        self._taken = list(taken)
        self.asked: list[tuple[int, ...]] = []

    def solve(self, number: int, *seed: int) -> MarginalSolution:
        self.asked.append((number, *seed))
        taken = self._taken[(len(self.asked) - 1) % len(self._taken)]
        vi = PROBLEM.create().assemble(PROBLEM.create().parameters.lower)
        return MarginalSolution(number, vi, NO_TIME, None if taken is None else Seconds(taken, taken))


@pytest.mark.parametrize(("taken", "numbers"), [(0.01, [7, 5]), (0.06, [7])])
def test_solutions_come_amid_queries_until_enough_or_serve_all_cells(taken: float, numbers: list[int]) -> None:
    marginal, done = Given(taken), list[MarginalSolution]()
    beside = SolutionsBeside(marginal, [1.0] * 9)
    steps = list(beside.alternated([7, 3, 5, 8], done, 4, 1))
    assert [k for k, _ in steps] == [7, 3, 5, 8]
    assert [k for k, solution in steps if solution is not None] == numbers
    assert [number for number, *_ in marginal.asked] == numbers == [one.number for one in done]
    assert len(set(marginal.asked)) == len(marginal.asked)  # each is next to another parameter
    marginal = Given(2.0)
    beside, done = SolutionsBeside(marginal, [1.0] * 9), [list[MarginalSolution]() for _ in range(3)]
    for solutions, (at, cell) in zip(done, [(0, 0), (0, 1), (1, 1)], strict=True):
        ((_, first), *_) = beside.alternated([2 * cell, 5], solutions, at, cell)
        assert first is not None
    assert [number for number, *_ in marginal.asked] == [0, 2]
    assert [[one.number for one in solutions] for solutions in done] == [[0], [0], [2]]
    assert done[0][0].vi.A is not done[1][0].vi.A  # kept in arrays of its own
    marginal = Given(0.01, None, 0.03)
    beside, done = SolutionsBeside(marginal, [1.0, 2.0, 3.0, 6.0]), list[MarginalSolution]()
    for queries in ([1, 2], [3]):
        list(beside.alternated(queries, done, 0, 0))
    assert [one.seconds is None for one in done] == [False, True, False]
    mean = beside.seconds(done, (1, 2, 3))
    assert mean.cpu == pytest.approx(0.02 * (11.0 / 3.0) / 4.0)  # the right ones are at parameters 1 and 3
    assert beside.seconds([done[1]], (1, 2, 3)) is None


def test_rounds_begin_at_other_queries_with_their_matrices(store: SampleStore, monkeypatch: pytest.MonkeyPatch) -> None:
    work = TimingRounds(CELLS[:2], (EVERY,) * 2, 1, 0).begin(store)
    assert isinstance(work, timing_rounds._Rounds)
    numbers = range(2 * timing_rounds.QUERY_SUBSETS)
    parts = parts_alike(work._beside.sweep, timing_rounds.QUERY_SUBSETS)
    assert {work._order(0, at, parts[at % timing_rounds.QUERY_SUBSETS])[0] for at in numbers} == set(EVERY)
    assert work._order(0, 0, (1, 4, 5)) != work._order(1, 0, (1, 4, 5))
    calls: list[float] = []
    reduced: list[Any] = []
    plain, reduce = marginal_solutions.checked_assembly, ReducedModel.reduce
    noted = lambda problem, mu: (calls.append(float(mu[0])), plain(problem, mu))[1]  # noqa: E731
    monkeypatch.setattr(marginal_solutions, "checked_assembly", noted)
    monkeypatch.setattr(ReducedModel, "reduce", lambda model, vi: (reduced.append(vi), reduce(model, vi))[1])
    monkeypatch.setattr(timing_rounds, "QUERY_SUBSETS", 1)
    monkeypatch.setattr(timing_rounds, "ASSEMBLY_SECONDS", np.inf)
    TimingRounds(CELLS[:3], (EVERY,) * 3, 4, 0).run(store)
    assert len(calls) == 3 * (1 + 4 * VALIDATION)  # a warm-up, then every query of a round
    assert len(set(calls)) == len(calls)
    assert len(reduced) == 3 * (1 + 4 * VALIDATION)  # none after the last query


@given(st.lists(st.floats(0.1, 10.0), min_size=1, max_size=40))
def test_parts_of_a_pass_have_all_queries_once_and_take_about_as_long(seconds: list[float]) -> None:
    parts = parts_alike(np.array(seconds), 4)
    assert sorted(k for part in parts for k in part) == list(range(len(seconds)))
    sums = [sum(seconds[k] for k in part) for part in parts]
    assert max(sums) - min(sums) <= 2.0 * max(seconds)


def test_lost_rounds_are_told_and_rows_have_the_pace_of_their_block() -> None:
    stage = TimingRounds((CELLS[0],) * 2, (EVERY,) * 2, 3, 6)
    items: list[TimedRound | Failed] = [steady(2.0) for _ in range(stage.items)]
    gone = next(item for item in range(stage.items) if stage.place(item) == (1, 0))
    items[gone] = Failed(Status.CRASHED, "the worker died")
    timed = _in(stage).collect(items)
    assert [list(one.rounds) for one in timed] == [[6, 8], [6, 7, 8]]
    assert [one.failures for one in timed] == [(items[gone],), ()]
    assert [[row["round"] for row in rows] for rows in timing_rounds.block_rows(stage, timed)] == [[6, 8], [6, 7, 8]]
    stage = TimingRounds((CELLS[0],) * 2, (EVERY,) * 2, 3, 0)
    paced = {k: replace(steady(pace), beside=Seconds(4.0 * pace, 4.0 * pace)) for k, pace in enumerate((1.0, 2.0, 1.0))}
    other = {k: replace(steady(3.0 * pace), beside=Seconds(9.0 * pace, 9.0)) for k, pace in enumerate((1.0, 2.0, 1.0))}
    rows, others = timing_rounds.block_rows(stage, [TimedCell(paced, "here"), TimedCell(other, "here")])
    for own in (rows, others):  # neighbours of both count
        assert [row["hf_s"] for row in own] == pytest.approx([6.0, 12.0, 6.0])
        assert [row["pace"] for row in own] == pytest.approx([1.0, 2.0, 1.0])
    assert len({row["block"] for row in (*rows, *others)}) == 1
    later = TimingRounds((CELLS[0],), (EVERY,), 2, 2)
    ((row,),) = timing_rounds.block_rows(later, [TimedCell({2: steady(1.0)}, "here")])
    assert row["block"] != rows[0]["block"]
    assert row["hf_s"] is None


def test_certificates_are_a_part_of_queries_and_columns_are_means_medians_and_quartiles() -> None:
    rounds = [replace(steady(1.0), certify=dict.fromkeys((0, 1), Seconds(spent, 2.0))) for spent in (0.25, 0.5, 4.0)]
    rows = as_rows(*rounds)
    assert [(row["certify_s"], row["total_s"], row["total_wall_s"]) for row in rows] == [
        (0.25, 2.25, 4.0), (0.5, 2.5, 4.0), (4.0, 6.0, 4.0),
    ]  # fmt: skip
    assert timing_rounds.seconds_of_cell(rows)["online_certify_s"] == 0.5
    assert timing_rounds.seconds_of_cell(rows)["online_s"] == pytest.approx(2.5)
    assert timing_rounds.seconds_of_queries(rounds)[1]["certify_s"] == 0.5
    rounds = [
        TimedRound({k: Seconds(0.5, 1.0)}, {k: Seconds(spent, spent), k + 4: Seconds(spent, spent)}, slow)
        for k, (spent, slow) in enumerate([(1.0, 1.0), (3.0, 1.2), (2.0, 1.4), (8.0, 3.0)])
    ]
    rows = as_rows(*rounds, per_block=2, pace=2.0)
    assert [row["total_s"] for row in rows] == [1.5, 3.5, 2.5, 8.5]
    own = timing_rounds.seconds_of_cell(rows)
    # the median of two is the geometric mean, and so is the mean over blocks
    assert own["online_s"] == pytest.approx((1.5 * 3.5 * 2.5 * 8.5) ** 0.25 / 2.0)
    assert own["hf_s"] == pytest.approx(2.0)
    assert "hf_s" not in timing_rounds.seconds_of_cell(as_rows(*rounds, hf=None))
    assert (own["online_solve_s"], own["online_assemble_s"]) == (2.5, 0.5)
    assert (own["online_q1_s"], own["online_q3_s"]) == tuple(np.quantile([1.5, 3.5, 2.5, 8.5], (0.25, 0.75)))
    assert (own["online_wall_s"], own["slowdown"]) == (3.5, pytest.approx(1.3))
    apart = [replace(one, assemble={k: one.assemble[k]}) for k, one in enumerate(rounds)]
    queries = timing_rounds.seconds_of_queries(apart)
    without = dict.fromkeys(("certify_s", "reconstruct_s"))
    assert queries[2] == {"assemble_s": 0.5, "solve_s": 2.0, **without, "total_s": 2.5, "total_wall_s": 3.0}
    assert own["online_certify_s"] is None
    assert set(timing_rounds.seconds_of_cell([])) == set(own) - {"hf_s"}
    assert set(timing_rounds.seconds_of_cell([]).values()) == {None}
    # CPU seconds stop while a process waits; what others do to the caches, the calibration shows.
    for wall, slow, disturbed in ((1.0, 1.0, 0), (9.0, 1.0, 0), (1.0, 1.4, 1)):
        once = TimedRound({0: Seconds(1.0, wall)}, {0: Seconds(1.0, wall)}, slow)
        assert timing_rounds.seconds_of_cell(as_rows(*[once] * 3))["disturbed"] == disturbed


class Remembers:
    """A solver that returns an earlier answer to a program that is the same to so many digits, or to the last bit."""

    def __init__(self, digits: int | None = None) -> None:
        self.known: dict[bytes, QPSolution] = {}
        self.digits, self.solved, self.remembered = digits, 0, 0

    def __call__(self, program: VariationalInequality, accuracy: float) -> QPSolution:
        data = (np.asarray(getattr(program, name)) for name in MEMBERS)
        key = b"".join((one if self.digits is None else one.round(self.digits) + 0.0).tobytes() for one in data)
        if key in self.known:
            self.remembered += 1
        else:
            self.solved += 1
            self.known[key] = solve_qp(program, "piqp", accuracy)
        return self.known[key]


def test_no_program_is_met_again_or_assembled_twice(store: SampleStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two cells of one problem and solver are in the rounds, whose programs are the same; a problem may cache, too."""
    solver, visited, plain = Remembers(), list[tuple[float, ...]](), HyperReducedModel.assemble
    monkeypatch.setattr(registry, "qp_solver", lambda name: {name: solver})
    monkeypatch.setattr(HyperReducedModel, "assemble", lambda one, mu: (visited.append(tuple(mu)), plain(one, mu))[1])
    timed = TimingRounds(OF_THREE, (EVERY[:3],) * 4, 12, 0).run(store).value
    assert [len(one.rounds) for one in timed] == [12] * 4
    assert solver.solved == 4 * (12 + 1)  # a query in every round, and the warm-up
    assert solver.remembered == 0
    assert len(visited) == len(set(visited)) == 2 * (12 + 1)
    assert len({tuple(np.round(mu, 6)) for mu in visited}) == 3


@pytest.mark.parametrize("which", [0, 2])
def test_answers_to_similar_programs_fail(which: int, store: SampleStore, monkeypatch: pytest.MonkeyPatch) -> None:
    solver = Remembers(digits=1)
    monkeypatch.setattr(registry, "qp_solver", lambda name: {name: solver})
    # which queries a round begins with depends on measured seconds; units of some let the first answer pass
    monkeypatch.setattr(timing_rounds, "parts_alike", lambda _, parts: (EVERY[:3],) * parts)
    with pytest.raises(NumericalError, match=r"residual .* above 3e-07.*does the solver remember answers"):
        TimingRounds(OF_THREE[which : which + 1], (EVERY[:3],), 12, 0).run(store)
    assert solver.remembered == 1


@pytest.mark.parametrize("reduced", [False, True], ids=["primal", "dual"])
def test_a_warm_start_is_in_the_units_of_its_program(reduced: bool, store: SampleStore) -> None:
    """Started from its own solution, a query is solved at once; from the one in other units it would not be."""
    queries = CELLS[3 if reduced else 0].queries(store)
    plain = queries.query(1, "osqp", 1e-8, warm_start=False)
    started = ProgramQuery(plain.program, plain.factor, "osqp", 1e-8, (1, plain.program)).repeated(1, 2)
    assert np.array_equal(started.start[1].A, started.program.A)
    answer, _ = started.prepare(nullcontext)()
    cold, _ = plain.repeated(1, 2).prepare(nullcontext)()
    assert answer.iterations <= cold.iterations
