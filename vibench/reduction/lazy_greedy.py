"""Lazy maximisation for greedy algorithms whose indicators never increase."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vibench.arrays import Array

TIE = 1e-9
"""Values within this fraction of the largest first value count as equal, and the smallest index wins: duplicated or
mirrored snapshots must not let round-off choose."""


class LazyMaximum:
    """Argmax over indicators that are non-increasing from one greedy step to the next.

    A value computed at an earlier step bounds the present one from above, so only indices whose bound reaches the
    maximum are evaluated again (Minoux 1978). The choice, ties included, is that of evaluating all indicators.

    Parameters
    ----------
    first
        Indicators (P,) at the first step.

    Attributes
    ----------
    evaluations
        Number of evaluations of an indicator.
    """

    def __init__(self, first: Array) -> None:
        self._bounds = np.array(first, dtype=float)
        self._tie = TIE * float(np.max(self._bounds, initial=0.0))
        self.evaluations = 0

    def next(self, evaluate: Callable[[int], float]) -> tuple[int, float]:
        """Index of the largest current indicator, the smallest index within `TIE`, and the largest value.

        `evaluate(p)` computes the indicator of index p.
        """
        fresh = np.zeros(len(self._bounds), dtype=bool)
        while True:
            largest = float(self._bounds.max())
            candidates = np.flatnonzero(self._bounds >= largest - self._tie)
            stale = candidates[~fresh[candidates]]
            if not len(stale):
                return int(candidates[0]), largest
            p = int(stale[0])
            self._bounds[p] = min(self._bounds[p], evaluate(p))  # round-off must not make an indicator grow
            fresh[p] = True
            self.evaluations += 1

    def bound(self, bounds: Array) -> None:
        """Apply upper bounds (P,) of the current indicators where they are below the stored ones."""
        self._bounds = np.minimum(self._bounds, bounds)

    def exclude(self, index: int) -> None:
        """Exclude an index from all later choices."""
        self._bounds[index] = -np.inf
