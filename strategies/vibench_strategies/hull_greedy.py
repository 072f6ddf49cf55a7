"""Greedy convex hulls of multipliers, for dual sets that are bounded."""

from __future__ import annotations

import numpy as np

from vibench import Array, BlockKind, DualStrategy, InnerProduct, ReducedSet, Stop, no_free
from vibench.reduction import REPRODUCED, TIE, hull_distances


class HullGreedy(DualStrategy):
    """Greedy hull: of all snapshots the one that is farthest from the convex hull of zero and those chosen so far.

    Where K is bounded, as for friction, a cone of snapshots leaves it, and their convex hull does not. Each step adds a
    whole snapshot, normalised (CPG with a hull in place of a cone); its gauge is the inverse of its norm.
    """

    blocks = (BlockKind.INTERVAL,)
    is_default = True

    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        """Chosen snapshots of unit norm, and their largest relative distances from the hull."""
        whitened = W.whiten(snapshots)
        norms = np.linalg.norm(whitened, axis=0)
        largest = float(norms.max(initial=0.0))
        chosen, distances, errors = list[int](), norms.copy(), [1.0 if largest else 0.0]
        while largest and not stop.reached(len(chosen), errors[-1]) and errors[-1] > REPRODUCED:
            # Of equal distances the smallest index wins.
            chosen.append(int(np.argmax(distances >= distances.max() - TIE * largest)))
            distances = hull_distances(whitened[:, chosen], whitened)
            distances[chosen] = 0.0
            errors.append(float(distances.max()) / largest)
        gauges = 1.0 / norms[chosen]
        return ReducedSet(snapshots[:, chosen] * gauges, np.array(errors), no_free(len(chosen)), gauges=gauges)
