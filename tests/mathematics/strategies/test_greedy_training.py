"""Greedy training: it solves where the bound is worst until the candidates meet the tolerance, as the rows say."""

from pathlib import Path

import numpy as np
import pytest
from samples import SampleStore, carry_out

from vibench import AdaptiveSampling, Array, HighFidelitySolver, ParameterBox, Stop, Trainer, create
from vibench.plugins.plugin import Plugin
from vibench.stages.base import value_of
from vibench.stages.formulation import AffineDecomposition
from vibench.stages.offline import ConstraintMatrices, PODStage
from vibench.stages.snapshots import gather, parameters_in, solution_stages
from vibench.study.parameter_sets import ParameterSet
from vibench_strategies.samplings.candidates import Candidates

BOX = ParameterBox(("x", "y"), np.zeros(2), np.array([2.0, 1.0]), ("1", "1"))


class Distance(Trainer):
    """A trainer whose bound is the distance to the nearest solution: greedy training covers the box."""

    def __init__(self) -> None:
        self.solved: list[Array] = []
        self.reasons: list[float] = []
        self.asked: list[tuple[Array, float]] = []

    def solve(self, mu: Array, bound: float = float("nan")) -> None:
        self.solved.append(mu)
        self.reasons.append(bound)

    def bound(self, mu: Array) -> float:
        self.asked.append((mu, float(apart(mu[None], self.solved)[0])))
        return self.asked[-1][1]


def apart(mus: Array, solved: list[Array]) -> Array:
    return np.linalg.norm(np.asarray(mus)[:, None] - np.array(solved), axis=2).min(axis=1)


def trained(**options: object) -> tuple[AdaptiveSampling, Distance]:
    strategy, trainer = create("sampling strategy", "greedy", options), Distance()
    strategy.train(BOX, trainer)
    return strategy, trainer


def test_all_candidates_meet_the_tolerance_where_all_are_checked() -> None:
    strategy, trainer = trained(candidates=400, tolerance=0.2, checked=400)
    candidates = strategy.parameters(BOX)
    assert {tuple(mu) for mu in trainer.solved} <= {tuple(mu) for mu in candidates}
    assert apart(candidates, trainer.solved).max() <= 0.2
    assert trainer.solved[0].tolist() == [1.0, 0.5]  # the middle of the box
    assert {(x, y) for x in (0.0, 2.0) for y in (0.0, 1.0)} <= {tuple(mu) for mu in candidates}
    assert {(x, y) for x in 0.5 * np.arange(5) for y in 0.25 * np.arange(5)} <= {tuple(mu) for mu in candidates}
    assert len(candidates) == 400
    assert len(trainer.solved) <= 40  # 2 / (0.2² · π / 2) discs cannot do with fewer than 16
    assert len(trainer.asked) < 400 + 10 * len(trainer.solved)  # lazy: not all candidates in all steps


def test_estimates_rank_and_bounds_decide() -> None:
    """Estimates a third of the bounds: no candidate that they alone call good enough is left out."""

    class Optimist(Distance):
        def estimate(self, mu: Array) -> float:
            return float(apart(mu[None], self.solved)[0]) / 3.0

    strategy, trainer = create("sampling strategy", "greedy", {"candidates": 200, "tolerance": 0.2}), Optimist()
    strategy.train(BOX, trainer)
    candidates = strategy.parameters(BOX)
    assert apart(candidates, trainer.solved).max() <= 0.2
    assert set(trainer.reasons[1:]) <= {bound for _, bound in trainer.asked}


def test_reasons_are_above_the_tolerance_and_nearly_the_worst_of_the_pool() -> None:
    _, trainer = trained(candidates=300, tolerance=0.25, drawn=300, checked=300)
    reasons = np.array(trainer.reasons[1:])
    assert np.isnan(trainer.reasons[0])
    assert reasons.min() > 0.25
    candidates = create("sampling strategy", "greedy", {"candidates": 300, "tolerance": 0.5}).parameters(BOX)
    for k, reason in enumerate(reasons, 1):
        assert reason >= 0.5 * apart(candidates, trainer.solved[:k]).max() - 1e-12


def test_it_ends_after_so_many_candidates_in_a_row_or_solutions() -> None:
    _, trainer = trained(candidates=10_000, tolerance=0.3, checked=50)
    assert all(bound <= 0.3 for _, bound in trainer.asked[-50:])
    assert len(trainer.asked) < 1000
    _, bounded = trained(candidates=500, tolerance=1e-6, most=7)
    assert len(bounded.solved) == 7
    again = trained(candidates=500, tolerance=1e-6, most=7)[1]
    assert np.array_equal(bounded.solved, again.solved)
    other = trained(candidates=500, tolerance=1e-6, most=7, seed=1)[1]
    assert not np.array_equal(bounded.solved, other.solved)


def test_the_coarse_grid_comes_first_and_the_finer_one_before_random_candidates() -> None:
    _, trainer = trained(candidates=1000, tolerance=0.01, drawn=4, most=12)
    new, seen = [], {tuple(trainer.solved[0])}
    for mu, _ in trainer.asked:
        if tuple(mu) not in seen:
            seen.add(tuple(mu))
            new.append(mu)
    fine = np.array([np.all(mu * [2.0, 4.0] % 1.0 == 0.0) for mu in new])
    coarse = np.array([np.all(mu * [1.0, 2.0] % 1.0 == 0.0) for mu in new])
    assert coarse[:8].all()  # with the middle, which is solved without a bound, the 3×3 grid
    assert fine[:24].all()
    assert not fine[24:].any()
    assert len(new) > 24
    _, loose = trained(candidates=1000, tolerance=0.9, checked=30)
    asked = np.unique([mu for mu, _ in loose.asked], axis=0)
    assert np.sum(np.any(asked * [2.0, 4.0] % 1.0 != 0.0, axis=1)) >= 30  # those of the grids are not random


@pytest.mark.parametrize("candidates", [2, 3, 8])
def test_it_ends_where_every_candidate_is_solved(candidates: int) -> None:
    _, trainer = trained(candidates=candidates, tolerance=1e-9)
    assert len(np.unique(trainer.solved, axis=0)) == len(trainer.solved) == candidates


def test_candidates_are_drawn_once_and_are_the_farthest_of_their_turn() -> None:
    candidates = Candidates(BOX, 90, 3)
    places, known, seen = BOX.to_unit(candidates.mus), [0], list[int]()
    assert candidates.coarse == 8
    while candidates:
        before = [list(part) for part in candidates._unseen]
        if len(seen) % 3 == 2:
            drawn, random = candidates.draw(2)
            assert random == (not any(before[:-1]))
        else:
            drawn = candidates.draw_far(3, 16, known)
            for n, k in enumerate(drawn):
                part = next(filter(None, before))
                away = [min(np.linalg.norm(places[j] - places[i]) for i in [*known, *drawn[:n]]) for j in part[-16:]]
                assert k == part[-16:][int(np.argmax(away))]
                part.remove(k)
        seen += drawn
        known.append(drawn[-1])
    assert sorted(seen) == list(range(1, 90))
    assert candidates.draw_far(3, 16, known) == []


def test_what_ends_the_training_is_random() -> None:
    """Candidates far from solutions are not counted: those that are drawn at random say how many others miss it."""
    _, trainer = trained(candidates=2000, tolerance=0.35, checked=60)
    places = [tuple(mu) for mu, _ in trainer.asked]
    random = [place for place in dict.fromkeys(places) if places.count(place) == 1][-60:]
    assert len(random) == 60
    strategy = create("sampling strategy", "greedy", {"candidates": 2000, "tolerance": 0.35})
    mean, asked = (apart(mus, trainer.solved) for mus in (strategy.parameters(BOX), random))
    assert abs(asked.mean() - mean.mean()) < 4.0 * mean.std() / np.sqrt(60)


PROBLEM = Plugin("problem", "obstacle", '{"resolution": 160}', "test")
SAMPLING = Plugin("sampling strategy", "greedy", '{"candidates": 200, "tolerance": 0.1, "checked": 20}', "test")
GREEDY = ParameterSet("training", 0, 0, SAMPLING)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SampleStore:
    store = SampleStore(tmp_path_factory.mktemp("greedy"))
    carry_out(PODStage(PROBLEM, Stop(tolerance=1e-6), GREEDY), store)
    carry_out(ConstraintMatrices(PROBLEM, GREEDY), store)
    return store


def test_the_solutions_of_the_training_are_the_snapshots(store: SampleStore) -> None:
    (stage,) = solution_stages(PROBLEM, GREEDY)
    found = gather(store, (stage,))
    solver = HighFidelitySolver(create("problem", "obstacle", {"resolution": 160}))
    for k, mu in enumerate(found.mu):
        exact = solver.solve(mu)
        np.testing.assert_allclose(found.u[:, k], exact.u, atol=1e-9 * np.abs(exact.u).max())
        np.testing.assert_allclose(found.lam[:, k], exact.lam, atol=1e-8 * np.abs(exact.lam).max())
    assert 3 <= len(found.mu) < 60
    assert np.array_equal(parameters_in(store, PROBLEM, GREEDY), found.mu)
    assert len(value_of(store, ConstraintMatrices(PROBLEM, GREEDY)).members) == len(found.mu)


def test_history_and_seconds_are_recorded(store: SampleStore) -> None:
    (stage,) = solution_stages(PROBLEM, GREEDY)
    artefact = store.get(stage.key)
    histories = {history.quantity: history for history in artefact.histories}
    assert set(histories) == {"bound", "bounds evaluated", "scale", "centre_x", "centre_y"}
    assert {history.stage for history in histories.values()} == {"selection"}
    bounds, evaluated = histories["bound"].values, histories["bounds evaluated"].values
    assert min(bounds[1:]) > 0.1
    assert list(evaluated) == sorted(evaluated)
    assert evaluated[0] == 0
    found = gather(store, (stage,))
    assert np.array_equal(histories["scale"].values, found.mu[:, 0])
    solving = sum(seconds.cpu for seconds in found.seconds)
    assert artefact.seconds.cpu == pytest.approx(solving + found.selecting.cpu)
    assert found.selecting.cpu > 0.0


def test_terms_are_interpolated_over_the_set_of_the_problem_which_takes_no_solutions(tmp_path: Path) -> None:
    stage = AffineDecomposition(PROBLEM, 1e-3, GREEDY)
    assert stage.inputs() == ()
    store = SampleStore(tmp_path)
    carry_out(stage, store)
    own = AffineDecomposition(PROBLEM, 1e-3)
    carry_out(own, store)
    assert len(value_of(store, stage)["A"].rows) == len(value_of(store, own)["A"].rows)
