"""POD of all supremizers of the training set."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vibench import RANK_RTOL, NestedStrategy, Offline, Step, orthonormal_range, project_out, svd
from vibench_strategies.supremizer_greedy import SupremizerSpace


class PODSupremizers(NestedStrategy):
    """Leading modes of all supremizers, as Ballarin, Manzoni, Quarteroni and Rozza (2015) enrich for the pressure.

    The supremizers of every training parameter are orthonormalised first and V_N is projected out. What k modes leave,
    equation (11) of Niakh et al. (2022), is then the root of the sum of the squared sines of all angles between S_R(mu)
    and V_N + S, relative to that with V_N alone, and it is what the tolerance bounds.
    """

    def steps(self, offline: Offline) -> Iterator[Step]:
        """Add mode by mode."""
        space = SupremizerSpace(offline)
        weights = np.sqrt(space.shared_by)
        bases = [c * orthonormal_range(found) for c, found in zip(weights, space.supremizers, strict=True)]
        modes, sigma, _ = svd(project_out(space.plain, np.hstack(bases)))
        squares = np.where(sigma > RANK_RTOL * weights.max(), sigma, 0.0) ** 2
        tails = np.sqrt(np.append(np.cumsum(squares[::-1])[::-1], 0.0))
        tails = tails / (tails[0] or 1.0)
        while True:
            count, left = space.count, float(tails[space.count])
            yield space.step(left, {"tail": list(tails[: count + 1])})
            space.add(modes[:, count] if left else np.zeros(len(modes)), f"{left:.0e} of themselves")
