"""A linear space of multipliers: for contact a negative control, for friction the section of K with it."""

from __future__ import annotations

import numpy as np

from vibench import Array, BlockKind, DualStrategy, InnerProduct, ReducedSet, Stop
from vibench.linalg import RANK_RTOL, svd


class PODDual(DualStrategy):
    """POD of the multipliers, as for variational equations. All generators are free in sign.

    With the formulation "mixed" it is a negative control: reduced inequalities become equalities, and reduced contact
    pressures may be negative. The formulation "dual-program" keeps multipliers in K: its set is the section of K. Of
    all linear spaces of its size this one has the smallest mean square projection error (equations (10), (11) of Niakh
    et al. 2022, in W).
    """

    blocks = (BlockKind.INTERVAL,)

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Leading modes, until the largest relative distance of a snapshot from their span is small enough."""
        modes, sigma, right = svd(W.whiten(snapshots))
        rank = int(np.count_nonzero(sigma > RANK_RTOL * np.max(sigma, initial=0.0)))
        squares = (sigma[:rank, None] * right[:rank]) ** 2
        tails = np.vstack([np.cumsum(squares[::-1], axis=0)[::-1], np.zeros(snapshots.shape[1])])
        distances = np.sqrt(np.max(tails, axis=1, initial=0.0))
        errors = distances / (distances[0] or 1.0)
        reached = stop.first_reached(errors)
        size = rank if reached is None else reached
        return ReducedSet(W.unwhiten(modes[:, :size]), errors[: size + 1], np.ones(size, dtype=bool))
