"""Angle greedy: snapshots as generators, chosen by their direction alone."""

from __future__ import annotations

from dataclasses import replace

from vibench import Array, DualStrategy, InnerProduct, ReducedSet, Stop, greedy_cone
from vibench_strategies.snapshot_cones import normalised, projection_errors


class AngleGreedy(DualStrategy):
    """Angle greedy algorithm of Haasdonk, Salomon and Wohlmuth (2012) and Burkovska et al. (2015).

    The tolerance bounds the sine of the angle between each snapshot and the cone, which is its distance relative to its
    own norm. The reported errors are relative to the largest norm, as for every dual strategy.
    """

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Add the snapshot that makes the largest angle with the cone until all angles are small enough."""
        cone = greedy_cone(normalised(snapshots, W), W, stop)
        return replace(cone, errors=projection_errors(cone.generators, snapshots, W))
