"""POD of all supremizers of the training set."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vibench import NestedStrategy, Offline, Step
from vibench.linalg import RANK_RTOL, orthonormal_range, project_out, svd
from vibench_strategies.supremizer_greedy import SupremizerSpace


class PODSupremizers(NestedStrategy):
    """Leading modes of all supremizers, as Ballarin, Manzoni, Quarteroni and Rozza (2015) enrich for the pressure.

    The supremizers of every training parameter are orthonormalised first and V_N is projected out. The tolerance bounds
    the POD tail, equation (11) of Niakh et al. (2022). It is then the root of the sum of the squared sines of all
    principal angles between S_R(mu) and V_N + S, relative to its value with V_N alone.
    """

    def steps(self, offline: Offline) -> Iterator[Step]:
        """Add one mode per step."""
        space = SupremizerSpace(offline)
        weights = np.sqrt(space.shared_by)  # a class counts once for each of its training parameters
        bases = [c * orthonormal_range(images) for c, images in zip(weights, space.supremizers, strict=True)]
        modes, sigma, _ = svd(project_out(space.plain, np.hstack(bases)))
        squares = np.where(sigma > RANK_RTOL * weights.max(), sigma, 0.0) ** 2
        tails = np.sqrt(np.append(np.cumsum(squares[::-1])[::-1], 0.0))
        tails = tails / (tails[0] or 1.0)
        while True:
            count, tail = space.count, float(tails[space.count])
            yield space.step(tail, {"tail": list(tails[: count + 1])})
            space.add(modes[:, count] if tail else np.zeros(len(modes)), f"the relative tail is {tail:.0e}")
