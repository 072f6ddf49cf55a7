"""What the plain and the modified greedy promise for every family of snapshots, degenerate ones included."""

import numpy as np
import pytest
from families import W, families
from hypothesis import given
from hypothesis import strategies as st

from vibench.arrays import Array
from vibench.interfaces.strategies import Stop
from vibench.reduction.cones import project_on_cone
from vibench_strategies.cpg import CPG
from vibench_strategies.mcpg import ModifiedCPG

GREEDIES = pytest.mark.parametrize("strategy", [CPG(), ModifiedCPG()], ids=["cpg", "mcpg"])


@GREEDIES
@given(families())
def test_cones_are_nested_errors_fall_and_generators_are_unit_vectors_of_w_plus(strategy, theta: Array) -> None:
    cone = strategy.reduce(theta, W, Stop(size=theta.shape[1]))
    chi, errors = cone.generators, cone.errors
    assert np.all(chi >= 0.0)
    assert np.allclose(W.norm(chi), 1.0, atol=1e-12)
    assert np.all(np.diff(errors) <= 1e-12)
    for r in range(cone.size):
        shorter = strategy.reduce(theta, W, Stop(size=r)).generators
        assert np.array_equal(shorter, chi[:, :r])


@GREEDIES
@given(families())
def test_without_a_limit_every_snapshot_is_reproduced(strategy, theta: Array) -> None:
    cone = strategy.reduce(theta, W, Stop(size=theta.shape[1]))
    largest = max(float(W.norm(theta).max()), 1e-300)
    for snapshot in theta.T:
        assert project_on_cone(cone.generators, snapshot, W).distance <= 1e-7 * largest


@GREEDIES
@given(families(), st.floats(1e-6, 0.9))
def test_the_tolerance_is_met_and_not_before_its_time(strategy, theta: Array, tolerance: float) -> None:
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
