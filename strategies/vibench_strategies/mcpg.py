"""Modified cone projected greedy: generators widened by subtracting what the cone already has."""

from __future__ import annotations

from vibench import Array, Cone, DualStrategy, InnerProduct, Stop, greedy_cone
from vibench.reduction.removal import removable_part


class ModifiedCPG(DualStrategy):
    """mCPG, Algorithm 2 of Niakh, Drouet, Ehrlacher and Ern (2022)."""

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> Cone:
        """Like CPG, but each new snapshot θ leaves its best part Υ in the cone, with θ − Υ ≥ 0, behind (line 9)."""
        return greedy_cone(snapshots, W, stop, subtract=lambda theta, chi: removable_part(theta, chi, W))
