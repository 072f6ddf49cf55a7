"""The full dictionary: every snapshot is a generator."""

from __future__ import annotations

from vibench import Array, DualStrategy, InnerProduct, ReducedSet, Stop, no_free
from vibench_strategies.snapshot_cones import normalised, projection_errors


class Dictionary(DualStrategy):
    """All multiplier snapshots, as in the reduced cones of Haasdonk, Salomon and Wohlmuth (2012), not compressed.

    All snapshots together meet every tolerance; a size keeps that many, in the order of the training set.
    """

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Normalise the snapshots and drop those that are zero."""
        generators = normalised(snapshots, W)[:, : stop.size]
        return ReducedSet(generators, projection_errors(generators, snapshots, W), no_free(generators.shape[1]))
