"""Primal strategies: none, supremizers at every query, PGA, greedy and POD choices, and what each of them promises."""

import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from enriching import Plain, offline
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numerics import Varying

from vibench import HighFidelitySolver, Kind, NumericalError, Offline, ReducedSet, Stop, check_enrichment, no_free
from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.linalg import orthonormal_range, project_out, singular_values
from vibench.reduction import LazyMaximum
from vibench.reduction.nested import NestedStrategy, grow_through
from vibench.reduction.pod import pod
from vibench.reduction.supremizers import supremizers
from vibench.stability import cone_basis, inf_sup_full, inf_sup_on
from vibench.testing import check
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle
from vibench_strategies import infsup_greedy, offline_pga
from vibench_strategies.decorrelated import Decorrelated
from vibench_strategies.infsup_greedy import InfSupGreedy
from vibench_strategies.mcpg import ModifiedCPG
from vibench_strategies.offline_pga import OfflinePGA
from vibench_strategies.online_supremizers import OnlineSupremizers
from vibench_strategies.pod_supremizers import PODSupremizers


@pytest.fixture(scope="module")
def varying() -> Offline:
    return offline(Varying(count=9), 9, 3, 4)


@pytest.fixture(scope="module")
def obstacle() -> Offline:
    data = offline(Obstacle("coarse"), 12, 5, 9)
    return replace(data, training=data.training[::12])  # all of them share one supremizer space


@pytest.fixture(scope="module")
def hertz() -> Offline:
    """Ten modes, twelve generators, two discs: 81 parameters with a supremizer space each."""
    problem = Hertz("coarse")
    training, solver = problem.training_set(), HighFidelitySolver(problem)
    solved = [solver.solve(mu) for mu in training]
    basis = pod(np.column_stack([s.u for s in solved]), problem.V, Stop(size=10)).basis
    cone = ModifiedCPG().reduce(np.column_stack([s.lam for s in solved]), problem.W, Stop(size=12))
    return Offline(problem, basis, cone, cone_basis(cone.generators, problem.W).span, training)


def shares(data: Offline, added: Array) -> Array:
    """β_S/β_on over the span at every training parameter, from bases of mesh size; 1 where β_on is round-off."""
    V, cone = data.problem.V, cone_basis(data.cone.generators, data.problem.W)
    Z = np.hstack([data.basis, added])
    forms = [data.problem.assemble(mu).B for mu in data.training]
    online = np.array([inf_sup_full(V, B, cone).span for B in forms])
    own = np.array([inf_sup_on(Z, B, cone).span for B in forms])
    return np.where(online > 1e-12, own / online, 1.0)


def whitened_supremizers(data: Offline) -> list[Array]:
    """Whitened orthonormal bases of S_R(mu) at every training parameter."""
    V = data.problem.V
    forms = [data.problem.assemble(mu).B for mu in data.training]
    return [orthonormal_range(V.whiten(supremizers(V, B, data.span))) for B in forms]


BOTH = pytest.mark.parametrize("setting", ["varying", "obstacle"])
SIZES = st.integers(12, 40), st.integers(3, 9), st.integers(1, 6), st.integers(1, 5), st.integers(1, 4)


def drawn(n: int, m: int, count: int, modes: int, generators: int) -> Offline:
    return offline(Varying(n, m, count), count, modes, min(generators, count))


def test_online_supremizers_reach_the_whole_space_at_every_parameter(varying: Offline) -> None:
    enrichment = pickle.loads(pickle.dumps(OnlineSupremizers().build(varying, None)))
    assert enrichment.kind is Kind.PER_PARAMETER
    problem, cone = varying.problem, cone_basis(varying.cone.generators, varying.problem.W)
    for mu in (np.array([0.05]), np.array([0.61])):
        vi = problem.assemble(mu)
        added = supremizers(problem.V, vi.B, enrichment.eta)
        Z = np.hstack([varying.basis, problem.V.orthonormalise(added, varying.basis)])
        assert np.isclose(inf_sup_on(Z, vi.B, cone).span, inf_sup_full(problem.V, vi.B, cone).span, rtol=1e-10)


def assert_pga_keeps_its_promise(data: Offline, delta: float) -> None:
    """σ falls to δ, and no further, and β_S ≥ √(1 − σ²) β_on over the training set."""
    problem, V = data.problem, data.problem.V
    enrichment = OfflinePGA().build(data, delta)
    sigma = enrichment.history["sigma"]
    assert np.all(np.diff(sigma) <= 1e-9)
    assert len(sigma) == enrichment.vectors.shape[1] + 1
    assert sigma[-1] <= delta < (sigma[-2] if len(sigma) > 1 else 1.0)
    Z = np.hstack([data.basis, enrichment.vectors])
    assert np.allclose(V.gram(Z, Z), np.eye(Z.shape[1]), atol=1e-11)
    cone, worst = cone_basis(data.cone.generators, problem.W), 0.0
    for mu, target in zip(data.training, whitened_supremizers(data), strict=True):
        B = problem.assemble(mu).B
        sine = float(singular_values(project_out(V.whiten(Z), target)).max(initial=0.0))
        worst = max(worst, sine)
        own, online = inf_sup_on(Z, B, cone), inf_sup_full(V, B, cone)
        for what in ("span", "cone_upper"):
            assert getattr(own, what) >= np.sqrt(1.0 - sine**2) * getattr(online, what) * (1.0 - 1e-9) - 1e-12
    assert worst <= delta + 1e-9
    assert np.isclose(worst, sigma[-1], atol=1e-8)


@pytest.mark.parametrize(
    ("setting", "delta"),
    [
        ("varying", 0.95),
        ("varying", 0.5),
        ("varying", 1e-3),
        ("obstacle", 0.5),
        pytest.param("hertz", 0.95, marks=pytest.mark.long),
    ],
)
def test_pga_keeps_its_promise_at_every_training_parameter(request, setting: str, delta: float) -> None:
    assert_pga_keeps_its_promise(request.getfixturevalue(setting), delta)


@given(st.builds(drawn, *SIZES), st.floats(1e-6, 0.99))
@settings(max_examples=12)
def test_pga_on_any_small_problem(data: Offline, delta: float) -> None:
    assert_pga_keeps_its_promise(data, delta)


def test_pga_adds_vectors_from_the_training_supremizers(varying: Offline) -> None:
    problem, V = varying.problem, varying.problem.V
    enrichment = OfflinePGA().build(varying, 0.1)
    everything = [supremizers(V, problem.assemble(mu).B, varying.span) for mu in varying.training]
    space = orthonormal_range(V.whiten(np.hstack([varying.basis, *everything])))
    assert np.abs(project_out(space, V.whiten(enrichment.vectors))).max() < 1e-9
    assert enrichment.vectors.shape[1] > varying.span.shape[1]  # B(mu) varies: one parameter's are not enough


def test_with_one_supremizer_space_sigma_is_sines_and_offline_spaces_tend_to_online_ones(obstacle: Offline) -> None:
    V = obstacle.problem.V
    B = obstacle.problem.assemble(obstacle.training[4]).B
    target = orthonormal_range(V.whiten(supremizers(V, B, obstacle.span)))
    sines = singular_values(project_out(V.whiten(obstacle.basis), target))
    enrichment = OfflinePGA().build(obstacle, 1e-10)
    sigma, added = enrichment.history["sigma"], enrichment.vectors
    steps = min(len(sigma), len(sines))
    assert np.allclose(sigma[:steps], sines[:steps], atol=1e-9)
    assert len(sigma) - 1 == np.count_nonzero(sines > 1e-10) <= obstacle.span.shape[1]
    B = obstacle.problem.assemble(obstacle.training[7]).B
    online = V.orthonormalise(supremizers(V, B, obstacle.span), obstacle.basis)
    assert added.shape == online.shape
    assert np.allclose(singular_values(V.gram(added, online)), 1.0, atol=1e-9)


def test_the_tolerance_between_offline_and_online_constants(obstacle: Offline) -> None:
    """0 ≤ 1 − β_off/β_on ≤ 1 − √(1 − δ²) where all parameters share one supremizer space."""
    problem = obstacle.problem
    cone = cone_basis(obstacle.cone.generators, problem.W)
    for delta in (0.3, 0.9):
        Z = np.hstack([obstacle.basis, OfflinePGA().build(obstacle, delta).vectors])
        for mu in problem.validation_set(4, 1):
            B = problem.assemble(mu).B
            loss = 1.0 - inf_sup_on(Z, B, cone).span / inf_sup_full(problem.V, B, cone).span
            assert -1e-9 <= loss <= 1.0 - np.sqrt(1.0 - delta**2) + 1e-9


ON_BETA = pytest.mark.parametrize("strategy", [InfSupGreedy(), OfflinePGA(stop="beta")], ids=["inf-sup", "PGA"])


@ON_BETA
@pytest.mark.parametrize("rho", [0.2, 0.9])
@BOTH
def test_the_share_is_kept_at_every_parameter_by_no_fewer(
    request, setting: str, strategy: NestedStrategy, rho: float
) -> None:
    data: Offline = request.getfixturevalue(setting)
    found = check_enrichment(strategy.build(data, rho), data.problem.V, data.basis)
    own = found.history["beta_share"]
    assert np.all(np.diff(own) >= -1e-9)
    assert len(own) == found.vectors.shape[1] + 1 > 1
    kept = shares(data, found.vectors)
    assert kept.min() >= rho * (1.0 - 1e-9)
    assert np.isclose(kept.min(), own[-1], rtol=1e-8)
    assert shares(data, found.vectors[:, :-1]).min() < rho


@given(st.builds(drawn, *SIZES), st.floats(0.05, 0.99))
@example(drawn(n=12, m=9, count=4, modes=2, generators=4), 0.5)  # β_on vanishes at the last parameter
@settings(max_examples=6)
def test_the_share_is_kept_anywhere(data: Offline, rho: float) -> None:
    for strategy in (InfSupGreedy(), OfflinePGA(stop="beta")):
        found = check_enrichment(strategy.build(data, rho), data.problem.V, data.basis)
        assert shares(data, found.vectors).min() >= rho * (1.0 - 1e-8)


def test_the_stop_on_beta_adds_the_same_vectors_and_knows_when_less_would_do(varying: Offline) -> None:
    on_sigma, on_beta = OfflinePGA().build(varying, 0.6), OfflinePGA(stop="beta").build(varying, 0.8)
    count = on_beta.vectors.shape[1]
    assert count <= on_sigma.vectors.shape[1]  # σ ≤ 0.6 guarantees a share of 0.8
    assert np.array_equal(on_beta.vectors, on_sigma.vectors[:, :count])
    assert np.array_equal(on_beta.history["sigma"], on_sigma.history["sigma"][: count + 1])
    assert "beta_share" not in on_sigma.history


def test_every_vector_is_the_supremizer_of_the_least_stable_multiplier(hertz: Offline) -> None:
    """Brute force: all parameters at every step, the minimiser by an eigenproblem on vectors of mesh size."""
    V = hertz.problem.V
    forms = [hertz.problem.assemble(mu).B for mu in hertz.training]
    loads = [V.whiten(supremizers(V, B, hertz.span)) for B in forms]
    online = np.array([singular_values(T)[-1] for T in loads])
    found = InfSupGreedy().build(hertz, 0.7)
    everything = V.whiten(np.hstack([hertz.basis, found.vectors]))
    first = hertz.span.shape[1]  # with fewer vectors β_S is zero, on a whole space
    assert everything.shape[1] >= first + 5
    for size in range(first, everything.shape[1]):
        Z, vector = everything[:, :size], everything[:, size]
        values = [np.linalg.svd(Z.T @ T) for T in loads]
        kept = np.array([sines[-1] for _, sines, _ in values]) / online
        worst = int(np.argmin(kept))
        expected = project_out(Z, loads[worst] @ values[worst][2][-1])
        assert np.isclose(abs(vector @ expected), np.linalg.norm(expected), rtol=1e-6)
        assert np.isclose(kept[worst], found.history["beta_share"][size - hertz.basis.shape[1]], rtol=1e-8)


@pytest.mark.parametrize(
    ("module", "strategy", "tolerance", "measure"),
    [
        (infsup_greedy, InfSupGreedy(), 0.8, "beta_share"),
        (offline_pga, OfflinePGA(stop="beta"), 0.8, "beta_share"),
        (offline_pga, OfflinePGA(), 0.3, "sigma"),
    ],
    ids=["inf-sup", "PGA on beta", "PGA"],
)
def test_lazy_and_plain_choose_the_same_vectors_and_lazy_looks_less_often(
    monkeypatch: pytest.MonkeyPatch, hertz: Offline, module, strategy: NestedStrategy, tolerance: float, measure: str
) -> None:
    made = {LazyMaximum: 0, Plain: 0}

    def counting(kind: type[LazyMaximum]) -> type[LazyMaximum]:
        class Counted(kind):  # type: ignore[misc, valid-type]
            def next(self, evaluate: Callable[[int], float]) -> tuple[int, float]:
                return super().next(lambda p: (made.update({kind: made[kind] + 1}), evaluate(p))[1])

        return Counted

    found = []
    for kind in made:
        monkeypatch.setattr(module, "LazyMaximum", counting(kind))
        found.append(strategy.build(hertz, tolerance))
    assert np.allclose(found[0].vectors, found[1].vectors, atol=1e-8)
    assert np.allclose(found[0].history[measure], found[1].history[measure], atol=1e-9)
    assert found[0].vectors.shape[1] > hertz.span.shape[1]  # one parameter's supremizers are not enough
    if measure == "sigma":
        assert made[Plain] == 81 * len(found[1].history["sigma"])
    assert made[LazyMaximum] <= 0.45 * made[Plain]


@BOTH
def test_pod_supremizers_are_modes_of_all_supremizers_and_the_tail_sums_squared_sines(request, setting: str) -> None:
    data: Offline = request.getfixturevalue(setting)
    V, bases = data.problem.V, whitened_supremizers(request.getfixturevalue(setting))
    left = project_out(V.whiten(data.basis), np.hstack(bases))
    modes, sigma, _ = np.linalg.svd(left, full_matrices=False)
    found = check_enrichment(PODSupremizers().build(data, 0.05), V, data.basis)
    tail, count = found.history["tail"], found.vectors.shape[1]
    assert tail[-1] <= 0.05 < tail[-2]
    angles = singular_values(modes[:, :count].T @ V.whiten(found.vectors))
    assert np.allclose(angles, 1.0, atol=1e-8)
    for k in range(count + 1):
        Z = np.hstack([V.whiten(data.basis), V.whiten(found.vectors[:, :k])])
        sines = np.concatenate([singular_values(project_out(Z, basis)) for basis in bases])
        assert np.isclose(tail[k], np.linalg.norm(sines) / np.linalg.norm(sigma), atol=1e-9)


@pytest.mark.parametrize("strategy", [InfSupGreedy(), OfflinePGA(stop="beta"), PODSupremizers()])
def test_tolerances_in_any_order_cut_one_growth(varying: Offline, strategy: NestedStrategy) -> None:
    grown = grow_through(strategy, varying, [0.6, 0.9, 0.3])
    for tolerance in (0.3, 0.6, 0.9):
        alone, passed = strategy.build(varying, tolerance), grown.at(grown.milestone(tolerance))
        assert np.allclose(alone.vectors, passed.vectors, atol=1e-12)
    counts = [grown.at(grown.milestone(tolerance)).vectors.shape[1] for tolerance in (0.3, 0.6, 0.9)]
    assert counts == sorted(counts, reverse=isinstance(strategy, PODSupremizers))
    assert len(set(counts)) > 1


def test_they_conform_and_add_nothing_without_generators(varying: Offline) -> None:
    """Also with options: the registered ones are checked as all plugins are."""
    check(partial(OfflinePGA, stop="beta"))
    empty = np.zeros((varying.problem.W.dim, 0))
    data = Offline(varying.problem, varying.basis, ReducedSet(empty, np.zeros(1), no_free(0)), empty, varying.training)
    for strategy in (InfSupGreedy(), OfflinePGA(stop="beta"), OfflinePGA(), PODSupremizers()):
        assert strategy.build(data, 0.5).vectors.shape == (varying.problem.V.dim, 0)
    assert Decorrelated().build(varying, None).kind is Kind.NONE


def test_the_unreachable_has_a_reason_and_pga_needs_a_tolerance(varying: Offline) -> None:
    for strategy, tolerance, measure in (
        (InfSupGreedy(), 1.5, "β_S/β_on = 1"),
        (OfflinePGA(stop="beta"), 1.5, "σ = "),
        (OfflinePGA(), 0.0, "σ = "),
        (PODSupremizers(), -1.0, r"the relative tail is 0e\+00"),
    ):
        reason = rf"tolerance {tolerance:g} is not reached: with all supremizers added, {measure}"
        with pytest.raises(NumericalError, match=reason):
            strategy.build(varying, tolerance)
    with pytest.raises(RequestError, match="needs a tolerance"):
        OfflinePGA().build(varying, None)


def test_a_parameter_at_which_no_enrichment_can_be_stable_does_not_hold_up_the_others(varying: Offline) -> None:
    """One multiplier presses on nothing, so β_on = 0 there, and its share is none."""

    class Loose(Varying):
        def assemble(self, mu: Array):
            found = super().assemble(mu)
            if mu[0] == 0.0:
                B = found.B.tolil()
                B[3] = 0.0
                return type(found)(found.A, found.f, B.tocsr(), found.g)
            return found

    data = Offline(Loose(count=9), varying.basis, varying.cone, np.eye(8)[:, 2:5], varying.training)
    found = InfSupGreedy().build(data, 0.8)
    assert 0 < found.vectors.shape[1] < 27
