"""The projected greedy algorithm: one enrichment for all parameters, built offline."""

from __future__ import annotations

from typing import Literal

import numpy as np

from vibench import Array, LazyMaximum, NestedStrategy, Offline
from vibench.reduction.supremizer_spaces import Angles, Shares, SupremizerGrowth


class OfflinePGA(NestedStrategy):
    """PGA, Algorithm 1 of Niakh, Drouet, Ehrlacher and Ern (2022).

    With `stop = "sigma"` the tolerance δ bounds σ_S(mu), (21), over the training set: β_S(mu) ≥ √(1 − δ²)·β_on(mu).
    With "beta" the same vectors are added until β_S(mu) ≥ ρ·β_on(mu) itself: the tolerance is ρ, and larger is tighter.
    """

    def __init__(self, stop: Literal["sigma", "beta"] = "sigma") -> None:
        self.stop, self.larger_is_tighter = stop, stop == "beta"

    def begin(self, offline: Offline) -> ProjectedGreedy:
        """Represent the supremizers of the training set in coordinates."""
        return ProjectedGreedy(offline, self.stop)


class ProjectedGreedy(SupremizerGrowth):
    """Adds the worst represented supremizer of the worst parameter; σ only falls (Lemma 3.2), so lazily."""

    def __init__(self, offline: Offline, stop: str) -> None:
        super().__init__(offline)
        self._angles = [Angles(found, self.plain) for found in self.supremizers]
        self._shares = [Shares(found) for found in self.supremizers] if stop == "beta" else []
        self._maxima = LazyMaximum(np.ones(len(self._angles))), LazyMaximum(np.ones(len(self._shares)))
        self._sigma, self._share = list[float](), list[float]()
        self._assess()

    def reached(self, tolerance: float) -> bool:
        """Whether σ ≤ δ, or β_S ≥ ρ·β_on, everywhere."""
        return self._share[-1] >= tolerance if self._share else self._sigma[-1] <= tolerance

    def grow(self) -> None:
        """Add a vector, lines 5 to 7."""
        self.add(self._angles[self._worst].worst_direction(self.grown), f"σ = {self._sigma[-1]:.0e}")
        self._assess()

    def history(self) -> dict[str, Array]:
        """σ, the largest over the training set, and the smallest share of β_on where that is what counts."""
        return {name: np.array(v) for name, v in (("sigma", self._sigma), ("beta_share", self._share)) if v}

    def _assess(self) -> None:
        self._worst, sigma = self._maxima[0].next(lambda p: self._angles[p].sigma(self.grown))
        self._sigma.append(sigma)
        if self._shares:
            self._share.append(1.0 - self._maxima[1].next(lambda p: self._shares[p].missing(self.grown))[1])
