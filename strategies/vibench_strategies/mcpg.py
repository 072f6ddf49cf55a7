"""Modified cone projected greedy algorithm: each generator is a snapshot without its part in the present cone."""

from __future__ import annotations

from vibench import Array, DualStrategy, InnerProduct, ReducedSet, Stop
from vibench.reduction import GrowingCone, subtract_cone_component


class ModifiedCPG(DualStrategy):
    """mCPG, Algorithm 2 of Niakh, Drouet, Ehrlacher and Ern (2022)."""

    is_default = True

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Like CPG, but of each new snapshot θ only θ − Υ ≥ 0 becomes a generator, Υ the part already in the cone."""
        cone = GrowingCone(snapshots, W)
        while not cone.reached(stop):
            theta = snapshots[:, cone.farthest]  # lines 5 to 8: the snapshot with the largest projection error
            rest, note = subtract_cone_component(theta, cone.generators, W)  # line 9
            # Lines 10 and 11. Where θ − Υ vanishes the algorithm ends (Remark 4.2).
            if not cone.add(rest, note):
                break
        return cone.result()
