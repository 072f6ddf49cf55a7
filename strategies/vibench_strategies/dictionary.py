"""The full dictionary: every snapshot is a generator."""

from __future__ import annotations

from vibench import Array, Cone, DualStrategy, InnerProduct, Stop, no_free, normalised, projection_errors


class Dictionary(DualStrategy):
    """All multiplier snapshots, as in the reduced cones of Haasdonk, Salomon and Wohlmuth (2012), not compressed.

    Every tolerance is met, by all of them; a size asks for the first so many in the order of the training set.
    """

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> Cone:
        """Normalise the snapshots; those that are zero are no generators."""
        generators = normalised(snapshots, W)[:, : stop.size]
        return Cone(generators, projection_errors(generators, snapshots, W), no_free(generators.shape[1]))
