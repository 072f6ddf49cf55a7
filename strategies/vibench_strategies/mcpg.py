"""Modified cone projected greedy: generators widened by subtracting what the cone already has."""

from __future__ import annotations

from vibench.arrays import Array
from vibench.cone import greedy_cone
from vibench.removal import removable_part
from vibench.space import InnerProduct
from vibench.strategy import Cone, DualStrategy, Stop


class ModifiedCPG(DualStrategy):
    """mCPG, Algorithm 2 of Niakh, Drouet, Ehrlacher and Ern (2022)."""

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> Cone:
        """Like CPG, but each new snapshot θ leaves its best part Υ in the cone, with θ − Υ ≥ 0, behind (line 9)."""
        return greedy_cone(snapshots, W, stop, subtract=lambda theta, chi: removable_part(theta, chi, W))
