import pickle
from collections.abc import Callable

import numpy as np
import pytest
from enriching import Plain, offline
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import Varying

from vibench.errors import NumericalError
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.strategies import Kind, Offline, Stop
from vibench.linalg.inner_product import orthonormal_range, project_out, singular_values
from vibench.reduction.cones import LazyMaximum
from vibench.reduction.pod import pod
from vibench.reduction.supremizers import supremizers
from vibench.stability.infsup import cone_basis, inf_sup_full, inf_sup_on
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle
from vibench_strategies import offline_pga
from vibench_strategies.decorrelated import Decorrelated
from vibench_strategies.mcpg import ModifiedCPG
from vibench_strategies.offline_pga import OfflinePGA
from vibench_strategies.online_supremizers import OnlineSupremizers


@pytest.fixture(scope="module")
def varying() -> Offline:
    return offline(Varying(count=9), 9, 3, 4)


@pytest.fixture(scope="module")
def obstacle() -> Offline:
    return offline(Obstacle("coarse"), 12, 5, 9)


def test_decorrelated_adds_nothing(varying: Offline) -> None:
    assert Decorrelated().build(varying, None).kind is Kind.NONE


def test_online_supremizers_reach_the_whole_space_at_every_parameter(varying: Offline) -> None:
    enrichment = pickle.loads(pickle.dumps(OnlineSupremizers().build(varying, None)))
    assert enrichment.kind is Kind.PER_PARAMETER
    problem, cone = varying.problem, cone_basis(varying.cone.generators, varying.problem.W)
    for mu in (np.array([0.05]), np.array([0.61])):
        vi = problem.assemble(mu)
        added = supremizers(problem.V, vi.B, enrichment.eta)
        Z = np.hstack([varying.basis, problem.V.orthonormalise(added, varying.basis)])
        assert np.isclose(inf_sup_on(Z, vi.B, cone).span, inf_sup_full(problem.V, vi.B, cone).span, rtol=1e-10)


@pytest.mark.parametrize("delta", [0.95, 0.5, 1e-3])
@pytest.mark.parametrize("setting", ["varying", "obstacle"])
def test_pga_keeps_its_promise_at_every_training_parameter(request, setting: str, delta: float) -> None:
    data: Offline = request.getfixturevalue(setting)
    problem, V = data.problem, data.problem.V
    enrichment = OfflinePGA().build(data, delta)
    sigma = enrichment.history["sigma"]
    assert np.all(np.diff(sigma) <= 1e-9)
    assert sigma[-1] <= delta < (sigma[-2] if len(sigma) > 1 else 1.0)
    Z = np.hstack([data.basis, enrichment.vectors])
    assert np.allclose(V.gram(Z, Z), np.eye(Z.shape[1]), atol=1e-11)
    cone = cone_basis(data.cone.generators, problem.W)
    for mu in data.training[:: max(1, len(data.training) // 9)]:
        B = problem.assemble(mu).B
        target = V.whiten(V.orthonormalise(supremizers(V, B, data.span)))
        reached = float(singular_values(project_out(V.whiten(Z), target)).max())
        assert reached <= delta + 1e-9
        own, online = inf_sup_on(Z, B, cone), inf_sup_full(V, B, cone)
        for what in ("span", "cone_upper"):
            assert getattr(own, what) >= np.sqrt(1.0 - delta**2) * getattr(online, what) * (1.0 - 1e-9)


@given(
    st.integers(12, 40),
    st.integers(3, 9),
    st.integers(1, 6),
    st.integers(1, 5),
    st.integers(1, 4),
    st.floats(1e-6, 0.99),
)
@settings(max_examples=40)
def test_pga_on_any_small_problem(n: int, m: int, count: int, modes: int, generators: int, delta: float) -> None:
    """σ falls, σ ≤ δ and β_S ≥ √(1 − δ²) β_on over the whole training set, for dimensions of every kind."""
    data = offline(Varying(n, m, count), count, modes, min(generators, count))
    problem, V = data.problem, data.problem.V
    enrichment = OfflinePGA().build(data, delta)
    sigma = enrichment.history["sigma"]
    assert np.all(np.diff(sigma) <= 1e-9)
    assert len(sigma) == enrichment.vectors.shape[1] + 1
    Z = np.hstack([data.basis, enrichment.vectors])
    cone = cone_basis(data.cone.generators, problem.W)
    worst = 0.0
    for mu in data.training:
        B = problem.assemble(mu).B
        target = orthonormal_range(V.whiten(supremizers(V, B, data.span)))
        sine = float(singular_values(project_out(V.whiten(Z), target)).max(initial=0.0))
        worst = max(worst, sine)
        own, online = inf_sup_on(Z, B, cone), inf_sup_full(V, B, cone)
        for what in ("span", "cone_upper"):
            assert getattr(own, what) >= np.sqrt(1.0 - sine**2) * getattr(online, what) * (1.0 - 1e-9) - 1e-12
    assert worst <= delta + 1e-9
    assert np.isclose(worst, sigma[-1], atol=1e-8)


def test_pga_adds_vectors_from_the_training_supremizers(varying: Offline) -> None:
    problem, V = varying.problem, varying.problem.V
    enrichment = OfflinePGA().build(varying, 0.1)
    everything = [supremizers(V, problem.assemble(mu).B, varying.span) for mu in varying.training]
    space = orthonormal_range(V.whiten(np.hstack([varying.basis, *everything])))
    assert np.abs(project_out(space, V.whiten(enrichment.vectors))).max() < 1e-9
    assert enrichment.vectors.shape[1] > varying.span.shape[1]  # B(mu) varies: one parameter's are not enough


def test_with_one_supremizer_space_sigma_is_the_sines_of_the_principal_angles(obstacle: Offline) -> None:
    V = obstacle.problem.V
    B = obstacle.problem.assemble(obstacle.training[40]).B
    target = orthonormal_range(V.whiten(supremizers(V, B, obstacle.span)))
    sines = singular_values(project_out(V.whiten(obstacle.basis), target))
    sigma = OfflinePGA().build(obstacle, 1e-10).history["sigma"]
    steps = min(len(sigma), len(sines))
    assert np.allclose(sigma[:steps], sines[:steps], atol=1e-9)
    assert len(sigma) - 1 == np.count_nonzero(sines > 1e-10) <= obstacle.span.shape[1]


def test_with_a_tiny_tolerance_offline_and_online_spaces_coincide(obstacle: Offline) -> None:
    V = obstacle.problem.V
    B = obstacle.problem.assemble(obstacle.training[7]).B
    added = OfflinePGA().build(obstacle, 1e-10).vectors
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


def test_lazy_and_plain_pga_choose_the_same_vectors(monkeypatch: pytest.MonkeyPatch, varying: Offline) -> None:
    lazy = OfflinePGA().build(varying, 0.05)
    monkeypatch.setattr(offline_pga, "LazyMaximum", Plain)
    plain = OfflinePGA().build(varying, 0.05)
    assert np.allclose(lazy.vectors, plain.vectors, atol=1e-8)


def test_less_than_half_of_the_evaluations_of_sigma_are_enough_where_b_varies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten modes, twelve generators, two discs: 81 parameters with a supremizer space each."""
    problem, made, evaluated = Hertz("coarse"), [], []
    training, solver = problem.training_set(), HighFidelitySolver(problem)
    solved = [solver.solve(mu) for mu in training]
    basis = pod(np.column_stack([s.u for s in solved]), problem.V, Stop(size=10)).basis
    cone = ModifiedCPG().reduce(np.column_stack([s.lam for s in solved]), problem.W, Stop(size=12))
    data = Offline(problem, basis, cone, cone_basis(cone.generators, problem.W).span, training)

    class Kept(LazyMaximum):
        def __init__(self, first: np.ndarray) -> None:
            super().__init__(first)
            made.append(self)

    class Counted(Plain):
        def next(self, evaluate: Callable[[int], float]) -> tuple[int, float]:
            return super().next(lambda p: (evaluated.append(p), evaluate(p))[1])

    monkeypatch.setattr(offline_pga, "LazyMaximum", Kept)
    lazy = OfflinePGA().build(data, 0.3)
    monkeypatch.setattr(offline_pga, "LazyMaximum", Counted)
    plain = OfflinePGA().build(data, 0.3)
    assert np.allclose(lazy.vectors, plain.vectors, atol=1e-8)
    assert np.allclose(lazy.history["sigma"], plain.history["sigma"], atol=1e-9)
    assert len(evaluated) == 81 * len(plain.history["sigma"])
    assert made[0].evaluations <= 0.45 * len(evaluated)


def test_pga_without_a_tolerance_is_refused(varying: Offline) -> None:
    with pytest.raises(ValueError, match="needs a tolerance"):
        OfflinePGA().build(varying, None)


def test_a_tolerance_nobody_can_reach_ends_with_a_reason(varying: Offline) -> None:
    with pytest.raises(NumericalError, match=r"tolerance 0 is not reached: with all supremizers added, σ = "):
        OfflinePGA().build(varying, 0.0)
