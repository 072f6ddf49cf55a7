from itertools import combinations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import space

from vibench import DualStrategy, HighFidelitySolver, InnerProduct, NumericalError, Stop
from vibench.reduction import cones as cone_module
from vibench.reduction import subtract_cone_component
from vibench.reduction.cones import TIE, LazyMaximum, greedy_cone, orthogonality, project_on_cone, project_on_orthant
from vibench_problems.obstacle import Obstacle
from vibench_strategies.cpg import CPG
from vibench_strategies.mcpg import ModifiedCPG

seeds = st.integers(0, 10_000)


def test_projection_on_the_orthant_meets_its_optimality_conditions() -> None:
    # diagonal, dense blocks, sparse blocks, no array of all
    for off, m, load in ((0.0, 200, 0.0), (1.0, 200, 0.0), (1.0, 600, 0.0), (1.0, 1100, -1.5)):
        rng, beside = np.random.default_rng(3), np.full(m - 1, off)
        X = InnerProduct(sp.diags_array([beside, 4.0 + rng.random(m), beside], offsets=[-1, 0, 1]))
        assert X.is_diagonal is (off == 0.0)
        functional = rng.standard_normal(m) + load
        found = project_on_orthant(functional, X)
        slope = X.apply(found) - functional
        assert 0 < np.count_nonzero(found) < m
        assert np.all(found >= 0.0)
        assert np.all(slope >= -1e-13)
        assert np.all(np.abs(found * slope) <= 1e-13)


def snapshots(seed: int, m: int = 8, count: int = 7) -> np.ndarray:
    """Nonnegative vectors with exact zeros."""
    rng = np.random.default_rng(seed)
    return rng.random((m, count)) * (rng.random((m, count)) < 0.6)


def distance_by_faces(generators: np.ndarray, theta: np.ndarray, X) -> float:
    """Distance from a cone by trying every face."""
    best = float(X.norm(theta))
    for size in range(1, generators.shape[1] + 1):
        for face in combinations(range(generators.shape[1]), size):
            chosen = X.whiten(generators[:, face])
            alpha, *_ = np.linalg.lstsq(chosen, X.whiten(theta), rcond=None)
            if np.all(alpha >= -1e-12):
                best = min(best, float(np.linalg.norm(chosen @ alpha - X.whiten(theta))))
    return best


@given(seeds, st.floats(1e-6, 1e6))
def test_projection_meets_its_optimality_conditions(seed: int, factor: float) -> None:
    X, rng = space(8, seed), np.random.default_rng(seed)
    chi, theta = rng.random((8, 4)), rng.standard_normal(8)
    found = project_on_cone(chi, theta, X)
    image = chi @ found.coefficients
    assert np.all(found.coefficients >= 0.0)
    assert np.isclose(found.distance, X.norm(theta - image))
    assert np.all(X.gram(chi, theta - image) <= 1e-9)
    assert abs(found.coefficients @ X.gram(chi, theta - image)) <= 1e-9
    # the nearest point over all faces, idempotent, and homogeneous
    assert np.isclose(found.distance, distance_by_faces(chi, theta, X), atol=1e-9)
    unit = chi / X.norm(chi)
    distances = [distance_by_faces(unit[:, :r], unit[:, r], X) for r in range(4)]
    assert np.allclose(orthogonality(unit, X), distances, atol=1e-9)  # the distances to the cones before
    assert project_on_cone(chi, image, X).distance <= 1e-10 * max(1.0, float(X.norm(theta)))
    assert np.isclose(project_on_cone(chi, factor * theta, X).distance, factor * found.distance, rtol=1e-8)
    assert np.isclose(project_on_cone(chi[:, :0], theta, X).distance, X.norm(theta))


@given(seeds)
def test_greedy_errors_fall_and_are_the_largest_distances(seed: int) -> None:
    X, theta = space(8, seed), snapshots(seed)
    largest = float(X.norm(theta).max())
    if largest == 0.0:
        return
    cone = greedy_cone(theta, X, Stop(size=5))
    assert np.all(np.diff(cone.errors) <= 1e-12)
    assert np.allclose(X.norm(cone.generators), 1.0)
    for r in range(cone.size + 1):
        distances = [project_on_cone(cone.generators[:, :r], q, X).distance for q in theta.T]
        assert np.isclose(max(distances) / largest, cone.errors[r], atol=1e-8)
    # generators are those that a plain greedy picks
    cone = greedy_cone(theta, X, Stop(tolerance=1e-6))
    chosen, left = np.zeros((8, 0)), list(range(theta.shape[1]))
    for r in range(cone.size):
        distances = np.array([project_on_cone(chosen, theta[:, q], X).distance for q in left])
        pick = left.pop(int(np.argmax(distances >= distances.max() - 1e-9 * largest)))
        chosen = np.column_stack([chosen, theta[:, pick] / X.norm(theta[:, pick])])
        assert np.allclose(chosen[:, r], cone.generators[:, r], atol=1e-12)


@pytest.fixture(scope="module")
def solved() -> tuple[np.ndarray, InnerProduct]:
    """Multipliers of the membrane at all training parameters, and their space."""
    problem = Obstacle(500)
    solver = HighFidelitySolver(problem)
    return np.column_stack([solver.solve(mu).lam for mu in problem.training_set()]), problem.W


@pytest.mark.parametrize("strategy", [CPG(), ModifiedCPG()], ids=["cpg", "mcpg"])
def test_few_projections_find_the_generators_of_a_plain_greedy(
    monkeypatch: pytest.MonkeyPatch, solved: tuple[np.ndarray, InnerProduct], strategy: DualStrategy
) -> None:
    """A plain greedy projects every snapshot not yet taken, at every step."""
    theta, W = solved
    largest, left = float(W.norm(theta).max()), list(range(theta.shape[1]))
    plain, projected, distances = np.zeros((W.dim, 0)), 0, W.norm(theta)
    for _ in range(20):
        pick = left.pop(int(np.argmax(distances >= distances.max() - 1e-9 * largest)))
        is_plain = isinstance(strategy, CPG)
        direction = theta[:, pick] if is_plain else subtract_cone_component(theta[:, pick], plain, W)[0]
        plain = np.column_stack([plain, direction / W.norm(direction)])
        distances = np.array([project_on_cone(plain, theta[:, q], W).distance for q in left])
        projected += len(left)
    calls, whole = [], cone_module._project_whitened
    monkeypatch.setattr(cone_module, "_project_whitened", lambda *data: calls.append(1) or whole(*data))
    cone = strategy.reduce(theta, W, Stop(size=20))
    assert np.allclose(cone.generators, plain, atol=1e-8 * plain.max())
    assert np.isclose(cone.errors[-1], distances.max() / largest, rtol=1e-6)
    assert 20 <= len(calls) <= 0.15 * projected


def test_stops_at_the_tolerance_the_size_or_where_everything_is_reproduced() -> None:
    X = space(5)
    theta = np.eye(5)[:, :4] * np.array([1.0, 0.5, 0.1, 0.001])
    loose = greedy_cone(theta, X, Stop(tolerance=0.3))
    assert loose.errors[-1] <= 0.3 < loose.errors[-2]
    assert greedy_cone(theta, X, Stop(size=3)).size == 3
    X, one = space(4), np.array([1.0, 2.0, 0.0, 1.0])
    for stop in (Stop(tolerance=1e-9), Stop(size=3)):
        assert greedy_cone(np.column_stack([one, 2.0 * one, one]), X, stop).size == 1
    everything = greedy_cone(np.eye(4)[:, :2], X, Stop(size=9))
    assert (everything.size, everything.errors[-1]) == (2, 0.0)
    a, b = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 1.0, 1.0, 0.0])  # of duplicates each is taken once
    cone = greedy_cone(np.column_stack([a, b, b, a]), X, Stop(size=2))
    assert {tuple(column > 0.0) for column in cone.generators.T} == {tuple(a > 0.0), tuple(b > 0.0)}
    for nothing in (np.zeros((4, 0)), np.zeros((4, 3))):
        assert greedy_cone(nothing, X, Stop(tolerance=0.1)).size == 0
    with pytest.raises(NumericalError, match=r"negative coefficient -1\.0e-03"):
        greedy_cone(np.array([[1.0], [-1e-3]]), space(2), Stop(tolerance=0.1))


@pytest.mark.parametrize("repeated", [False, True])
def test_errors_are_those_of_the_cone_whatever_directions_it_is_given(repeated: bool) -> None:
    theta, X, rng = snapshots(3, count=5), space(8, 3), np.random.default_rng(3)
    cone, largest = cone_module.GrowingCone(theta, X), float(X.norm(theta).max())
    while cone.add(np.ones(8) if repeated else rng.random(8)):  # no snapshot, nor a part of one
        pass
    for r, error in enumerate(cone.result().errors):
        distances = [distance_by_faces(cone.generators[:, :r], one, X) for one in theta.T]
        assert error * largest == pytest.approx(max(distances), rel=1e-9)
    # It ends where it has as many generators as there are snapshots.
    assert r == theta.shape[1]


@given(st.integers(0, 10_000), st.integers(2, 12), st.booleans())
def test_lazy_choices_are_those_of_the_plain_maximum(seed: int, count: int, exclude: bool) -> None:
    rng = np.random.default_rng(seed)
    values = np.round(rng.random(count), 1)  # many ties
    values /= max(values.max(), 0.1)
    lazy, excluded = LazyMaximum(values), set()
    for _ in range(count - 1):
        values = values * np.where(rng.random(count) < 0.5, 1.0, np.round(rng.random(count), 1))
        best, value = lazy.next(lambda p: float(values[p]))  # noqa: B023  called at once
        kept = np.where(np.isin(np.arange(count), list(excluded)), -np.inf, values)
        assert (best, value) == (np.flatnonzero(kept >= kept.max() - TIE)[0], kept.max())
        if exclude:
            lazy.exclude(best)
            excluded.add(best)
    # only bounds that reach the maximum are evaluated
    lazy, asked = LazyMaximum(np.array([1.0, 0.9, 0.1, 0.05])), list[int]()
    assert lazy.next(lambda p: asked.append(p) or [0.5, 0.6, 0.1, 0.05][p]) == (1, 0.6)
    assert (sorted(asked), lazy.evaluations) == ([0, 1], 2)
    ties = np.array([0.5, 1.0 - 1e-10, 1.0])  # within round-off the smallest index is taken
    assert LazyMaximum(ties).next(lambda p: float(ties[p])) == (1, 1.0)
