"""What the plain and the modified greedy promise for every family of snapshots, and how the modified one subtracts."""

import numpy as np
import pytest
import scipy.sparse as sp
from families import W, bumps, families
from hypothesis import given
from hypothesis import strategies as st
from numerics import space

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.strategies import DualStrategy, Stop
from vibench.linalg.inner_product import InnerProduct
from vibench.qp.verification import QPSolution
from vibench.reduction import cone_subtraction, subtract_cone_component
from vibench.reduction.cones import project_on_cone
from vibench_strategies.cpg import CPG
from vibench_strategies.mcpg import ModifiedCPG

GREEDIES = pytest.mark.parametrize("strategy", [CPG(), ModifiedCPG()], ids=["cpg", "mcpg"])
EUCLID = InnerProduct(sp.eye_array(3))


@GREEDIES
@given(families())
def test_cones_are_nested_errors_fall_and_snapshots_are_reproduced(strategy: DualStrategy, theta: Array) -> None:
    cone = strategy.reduce(theta, W, Stop(size=theta.shape[1]))
    chi, errors = cone.generators, cone.errors
    assert np.all(chi >= 0.0)
    assert not np.any(cone.free)
    assert np.allclose(W.norm(chi), 1.0, atol=1e-12)
    assert np.all(np.diff(errors) <= 1e-12)
    for r in range(cone.size):
        shorter = strategy.reduce(theta, W, Stop(size=r)).generators
        assert np.array_equal(shorter, chi[:, :r])
    largest = max(float(W.norm(theta).max()), 1e-300)
    for snapshot in theta.T:
        assert project_on_cone(chi, snapshot, W).distance <= 1e-7 * largest


@GREEDIES
@given(families(), st.floats(1e-6, 0.9))
def test_the_tolerance_is_met_and_not_before_its_time(strategy: DualStrategy, theta: Array, tolerance: float) -> None:
    cone = strategy.reduce(theta, W, Stop(tolerance=tolerance))
    largest = float(W.norm(theta).max())
    if largest == 0.0:
        assert cone.size == 0
        return
    distances = [
        [project_on_cone(cone.generators[:, :r], q, W).distance for q in theta.T] for r in (cone.size, cone.size - 1)
    ]
    assert max(distances[0]) <= (tolerance + 1e-8) * largest
    assert max(distances[1]) > (tolerance - 1e-8) * largest


@given(families())
def test_the_modified_cone_contains_the_snapshots_it_was_made_from(theta: Array) -> None:
    """Remark 4.1: each step keeps the cone of the snapshots chosen so far inside."""
    cone = ModifiedCPG().reduce(theta, W, Stop(size=theta.shape[1]))
    for r in range(1, cone.size + 1):
        inside = sum(project_on_cone(cone.generators[:, :r], q, W).distance <= 1e-7 * W.norm(q) for q in theta.T)
        assert inside >= r


@given(st.integers(0, 10_000))
def test_generators_of_the_plain_greedy_are_normalised_snapshots_the_largest_first(seed: int) -> None:
    X, theta = space(7, seed), np.random.default_rng(seed).random((7, 5))
    cone, norms = CPG().reduce(theta, X, Stop(size=4)), X.norm(theta)
    apart = np.abs((theta / norms)[:, None] - cone.generators[:, :, None]).max(axis=0)
    assert apart.min(axis=1).max() < 1e-13
    assert np.argmin(apart[0]) == np.argmax(norms)
    assert cone.fallbacks == ()


def test_the_second_generator_of_the_example_that_corrects_remark_4_3() -> None:
    theta = np.array([[1.0, 1.0], [1.0, 2.0], [0.0, 1.0]])
    rest, note = subtract_cone_component(theta[:, 1], theta[:, :1], EUCLID)
    assert np.allclose(rest, [0.0, 1.0, 1.0], atol=1e-10)
    assert note == ""
    cone = ModifiedCPG().reduce(theta[:, ::-1], EUCLID, Stop(size=2))  # the larger snapshot comes first
    assert np.allclose(cone.generators[:, 0], np.array([1.0, 2.0, 1.0]) / np.sqrt(6.0))


def test_generators_positive_where_theta_is_zero_take_no_part() -> None:
    theta, wide = np.array([1.0, 1.0, 0.0]), np.ones((3, 1))
    assert np.array_equal(subtract_cone_component(theta, wide, EUCLID)[0], theta)
    rest, _ = subtract_cone_component(theta, np.hstack([wide, [[1.0], [0.0], [0.0]]]), EUCLID)
    assert np.allclose(rest, [0.0, 1.0, 0.0], atol=1e-6)


@given(st.integers(0, 10_000))
def test_the_removed_part_is_feasible_and_optimal(seed: int) -> None:
    rng, X = np.random.default_rng(seed), space(6, seed)
    chi, theta = rng.random((6, 3)), rng.random(6) + 0.1
    rest, note = subtract_cone_component(theta, chi, X)
    assert note == ""
    assert np.all(rest >= 0.0)
    assert project_on_cone(chi, theta - rest, X).distance < 1e-9
    best = float(X.norm(rest))
    for alpha in rng.random((300, 3)) * rng.choice([0.01, 0.1, 1.0], (300, 1)):
        if np.all(chi @ alpha <= theta):
            assert best <= float(X.norm(theta - chi @ alpha)) + 1e-9


def test_the_modified_greedy_needs_no_more_generators_and_they_are_better_conditioned() -> None:
    theta, X = bumps(25)
    plain, modified = (s.reduce(theta, X, Stop(tolerance=1e-2)) for s in (CPG(), ModifiedCPG()))
    assert modified.size <= plain.size
    conditions = [np.linalg.cond(X.whiten(cone.generators[:, : modified.size])) for cone in (plain, modified)]
    assert conditions[1] < conditions[0]


def test_entries_that_are_round_off_are_exact_zeros() -> None:
    theta, X = bumps()
    cone = ModifiedCPG().reduce(theta, X, Stop(size=12))
    assert cone.fallbacks == ()
    generators = cone.generators[:, :8]
    assert generators[generators > 0.0].min() > 1e-13 * generators.max()
    assert np.any(generators[theta.max(axis=1) > 0.0] == 0.0)


@pytest.mark.parametrize("broken", ["nothing", "nan", "infeasible"])
def test_a_solver_that_fails_leaves_a_feasible_generator_and_a_note(
    monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    def fails(program: VariationalInequality, solver: str, accuracy: float) -> QPSolution:
        if broken == "nothing":
            return QPSolution(None, None, "failed")
        (rows, count), value = program.B.shape, np.nan if broken == "nan" else 5.0
        return QPSolution(np.full(count, value), np.zeros(rows), "solved")

    theta, X = bumps()
    monkeypatch.setattr(cone_subtraction, "solve_qp", fails)
    rest, note = subtract_cone_component(theta[:, 3], theta[:, 2:3] * (theta[:, 3:4] > 0.0), X)
    assert "line 9" in note
    assert np.all(rest >= 0.0)
    cone = ModifiedCPG().reduce(theta, X, Stop(size=12))
    assert any(line.startswith("generator ") for line in cone.fallbacks)
    for snapshot in theta.T:
        assert project_on_cone(cone.generators, snapshot, X).distance <= (cone.errors[-1] + 1e-9) * X.norm(theta).max()
