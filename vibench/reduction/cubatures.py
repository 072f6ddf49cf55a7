"""Cubatures with nonnegative weights: few columns that have about the sum of all."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import scipy.linalg

from vibench.arrays import Array, Indices
from vibench.signatures import Count, NotNegative, bordered


@bordered
class Cubature:
    """The conditions of a cubature, each with a random sign in one of few sums, which keep its residual.

    `size` conditions, N', are added at a time; the cubature chooses from `count` columns, e.
    """

    _sums: Annotated[Any, "sums", "e"]

    def __init__(self, size: Count, count: Count) -> None:
        # Far more sums than a cubature has columns represent all conditions.
        self._sums, self._rng = np.zeros((max(800, 8 * size), count)), np.random.default_rng(0)

    def add(self, conditions: Annotated[Array, "N'", "e"], weight: float) -> None:
        """Add conditions (N'×e), relative to their sum over all columns."""
        if size := float(np.linalg.norm(conditions.sum(axis=1))):
            signs = self._rng.choice([-1.0, 1.0], len(conditions))
            where = self._rng.choice(len(self._sums), len(conditions), replace=False)
            self._sums[where] += (weight / size * signs)[:, None] * conditions

    def columns(self, tolerance: NotNegative) -> tuple[Indices, Array]:
        """Few columns (j,) and weights (j,) > 0 with which all conditions are met to a tolerance; see `cubature`."""
        return cubature(self._sums, tolerance)


def cubature(conditions: Annotated[Array, "k", "e"], tolerance: NotNegative) -> tuple[Indices, Array]:
    """Few columns (j,) of conditions (k×e) and weights (j,) > 0 with which they have about the sum of all.

    Nonnegative least squares after Lawson and Hanson (1974), ended at a relative residual as by Farhat et al. (2015);
    all columns with the weight 1 for the tolerance 0. Where the tolerance cannot be reached it is the least residual.
    """
    if not tolerance:
        return np.arange(conditions.shape[1]), np.ones(conditions.shape[1])
    total, chosen, weights = conditions.sum(axis=1), list[int](), np.zeros(conditions.shape[1])
    Q, R, residual = np.zeros((len(total), 0)), np.zeros((0, 0)), total
    while np.linalg.norm(residual) > tolerance * np.linalg.norm(total):
        slopes = conditions.T @ residual
        slopes[chosen] = -np.inf
        best = int(np.argmax(slopes))
        if not slopes[best] > 0.0:
            break  # the least residual there is
        column = conditions[:, best]
        if chosen:
            Q, R = scipy.linalg.qr_insert(Q, R, column, len(chosen), which="col")
        else:  # LAPACK inserts nothing into an empty factorisation
            Q, R = column[:, None] / np.linalg.norm(column), np.array([[np.linalg.norm(column)]])
        chosen.append(best)
        while (solved := scipy.linalg.solve_triangular(R, Q.T @ total)).min() <= 0.0:
            present, falling = weights[chosen], np.flatnonzero(solved <= 0.0)
            ratios = present[falling] / (present[falling] - solved[falling])
            first = int(falling[np.argmin(ratios)])
            weights[chosen] = present + ratios.min() * (solved - present)
            weights[chosen.pop(first)] = 0.0
            Q, R = scipy.linalg.qr_delete(Q, R, first, which="col")
        weights[chosen] = solved
        residual = total - conditions[:, chosen] @ solved
    columns = np.sort(np.array(chosen, int))
    return columns, weights[columns]
