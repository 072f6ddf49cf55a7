"""Cone projected greedy: the multiplier snapshots themselves as generators."""

from __future__ import annotations

from vibench.arrays import Array
from vibench.cone import greedy_cone
from vibench.space import InnerProduct
from vibench.strategy import Cone, DualStrategy, Stop


class CPG(DualStrategy):
    """Cone projected greedy algorithm of Benaceur, Ern and Ehrlacher (2020); Remark 4.3 of Niakh et al. (2022)."""

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> Cone:
        """Add the snapshot farthest from the cone, normalised, until the largest relative distance is small enough."""
        return greedy_cone(snapshots, W, stop)
