"""Cubatures: few nonnegative weights, the tolerance that they keep, and what sums with random signs know of it."""

import numpy as np
from scipy.optimize import nnls

from vibench.arrays import Array
from vibench.reduction import Cubature, cubature


def test_cubatures_keep_their_tolerance_or_are_nonnegative_least_squares() -> None:
    rng = np.random.default_rng(0)
    conditions: Array = rng.standard_normal((12, 300)) + 1.0
    for tolerance in (1e-1, 1e-3, 1e-9):
        columns, weights = cubature(conditions, tolerance)
        assert len(columns) <= 12
        assert weights.min() > 0.0
        residual = conditions.sum(axis=1) - conditions[:, columns] @ weights
        assert np.linalg.norm(residual) <= tolerance * np.linalg.norm(conditions.sum(axis=1))
    assert np.array_equal(cubature(np.zeros((3, 4)), 0.1)[0], np.zeros(0))
    assert np.array_equal(cubature(conditions, 0.0)[1], np.ones(300))
    conditions = np.random.default_rng(1).standard_normal((40, 25))
    conditions[:, -1] = -3.0 * conditions[:, :5].sum(axis=1)  # weights of one are far from the least residual
    columns, weights = cubature(conditions, 1e-9)
    expected, _ = nnls(conditions, conditions.sum(axis=1))
    assert np.array_equal(columns, np.flatnonzero(expected > 1e-12))
    assert np.allclose(weights, expected[columns])


def test_few_sums_know_the_residual_of_many_conditions() -> None:
    rng, made = np.random.default_rng(2), Cubature(20, 200)
    # functions of 200 points that are sums of few, in 100 groups of 20 conditions: 2,000 in all
    few = rng.standard_normal((15, 200)) + 1.0
    groups: list[Array] = [rng.standard_normal((20, 15)) @ few for _ in range(100)]
    for conditions in groups:
        made.add(conditions, 1.0)
    made.add(np.zeros((20, 200)), 1.0)  # conditions of nothing are met by any columns
    columns, weights = made.columns(1e-2)
    assert len(columns) <= 15
    assert weights.min() > 0.0
    sums = [(conditions.sum(axis=1), conditions[:, columns] @ weights) for conditions in groups]
    left = [np.linalg.norm(whole - few) / np.linalg.norm(whole) for whole, few in sums]
    assert np.sqrt(np.mean(np.square(left))) <= 2e-2
