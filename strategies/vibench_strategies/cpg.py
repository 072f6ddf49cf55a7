"""Cone projected greedy algorithm: the multiplier snapshots themselves as generators."""

from __future__ import annotations

from vibench import Array, DualStrategy, InnerProduct, ReducedSet, Stop, greedy_cone


class CPG(DualStrategy):
    """Cone projected greedy algorithm of Benaceur, Ern and Ehrlacher (2020); Remark 4.3 of Niakh et al. (2022)."""

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Add the snapshot farthest from the cone, normalised, until the largest relative distance is small enough."""
        return greedy_cone(snapshots, W, stop)
