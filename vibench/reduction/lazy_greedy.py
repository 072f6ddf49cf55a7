"""Lazy maximisation for greedy algorithms whose indicators never increase."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vibench.arrays import Array

TIE = 1e-9
"""Values within this fraction of the largest first value count as equal; the smallest index wins."""


class LazyMaximum:
    """Argmax over indicators that are non-increasing from one greedy step to the next.

    A value computed at an earlier step bounds the present one from above, so only indices whose bound reaches the
    maximum have to be evaluated again (Minoux 1978). The choice, ties included, is the one that evaluating
    everything would make.

    Parameters
    ----------
    first
        Indicators (P,) at the first step.

    Attributes
    ----------
    evaluations
        How often an indicator was evaluated again.
    """

    def __init__(self, first: Array) -> None:
        self._bounds = np.array(first, dtype=float)
        self._tie = TIE * float(np.max(self._bounds, initial=0.0))
        self.evaluations = 0

    def next(self, evaluate: Callable[[int], float]) -> tuple[int, float]:
        """Index of the largest indicator now, the smallest within `TIE`, and the largest value.

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
            self._bounds[p] = min(self._bounds[p], evaluate(p))
            fresh[p] = True
            self.evaluations += 1

    def bound(self, bounds: Array) -> None:
        """Take upper bounds (P,) of the indicators now into account, wherever they are below what is known."""
        self._bounds = np.minimum(self._bounds, bounds)

    def exclude(self, index: int) -> None:
        """Never choose this index again."""
        self._bounds[index] = -np.inf
