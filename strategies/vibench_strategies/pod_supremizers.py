"""POD of all supremizers of the training set."""

from __future__ import annotations

import numpy as np

from vibench import RANK_RTOL, Array, NestedStrategy, Offline, orthonormal_range, project_out, svd
from vibench.reduction.supremizer_spaces import SupremizerGrowth


class PODSupremizers(NestedStrategy):
    """Leading modes of all supremizers, as Ballarin, Manzoni, Quarteroni and Rozza (2015) enrich for the pressure.

    The supremizers of every training parameter are orthonormalised first and V_N is projected out. What k modes leave,
    equation (11) of Niakh et al. (2022), is then the root of the sum of the squared sines of all angles between S_R(mu)
    and V_N + S, relative to that with V_N alone, and it is what the tolerance bounds.
    """

    def begin(self, offline: Offline) -> SupremizerModes:
        """Compute the modes."""
        return SupremizerModes(offline)


class SupremizerModes(SupremizerGrowth):
    """Hands out mode by mode."""

    def __init__(self, offline: Offline) -> None:
        super().__init__(offline)
        weights = np.sqrt(self.shared_by)
        bases = [c * orthonormal_range(found) for c, found in zip(weights, self.supremizers, strict=True)]
        self._modes, sigma, _ = svd(project_out(self.plain, np.hstack(bases)))
        squares = np.where(sigma > RANK_RTOL * weights.max(), sigma, 0.0) ** 2
        tails = np.sqrt(np.append(np.cumsum(squares[::-1])[::-1], 0.0))
        self._tails = tails / (tails[0] or 1.0)

    def reached(self, tolerance: float) -> bool:
        """Whether the relative tail is small enough."""
        return bool(self._tails[self.count] <= tolerance)

    def grow(self) -> None:
        """Add the next mode."""
        left = float(self._tails[self.count])
        self.add(self._modes[:, self.count] if left else np.zeros(len(self._modes)), f"{left:.0e} of themselves")

    def history(self) -> dict[str, Array]:
        """The relative tail."""
        return {"tail": self._tails[: self.count + 1]}
