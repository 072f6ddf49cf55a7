"""Inf-sup greedy: supremizers of the least stable multipliers, until a share of what online ones reach is kept."""

from __future__ import annotations

import numpy as np

from vibench import Array, LazyMaximum, NestedStrategy, Offline
from vibench.reduction.supremizer_spaces import Shares, SupremizerGrowth


class InfSupGreedy(NestedStrategy):
    """After the double greedy algorithm of Dahmen, Plesken and Welper (2014), with a fixed cone and a fixed V_N.

    The tolerance is ρ: β_S(mu) ≥ ρ·β_on(mu) over the training set, both over span χ (§3.1 of Niakh et al. 2022), β_on
    what the whole of V gives. The larger it is the more vectors it takes.
    """

    larger_is_tighter = True

    def begin(self, offline: Offline) -> LeastStable:
        """Represent the supremizers of the training set in coordinates."""
        return LeastStable(offline)


class LeastStable(SupremizerGrowth):
    """Adds T(mu)η* at the mu of the smallest β_S(mu)/β_on(mu), η* its minimiser; shares only rise, so lazily."""

    def __init__(self, offline: Offline) -> None:
        super().__init__(offline)
        self._shares = [Shares(found) for found in self.supremizers]
        self._maximum = LazyMaximum(np.ones(len(self._shares)))
        self._missing: list[float] = []
        self._assess()

    def reached(self, tolerance: float) -> bool:
        """Whether β_S ≥ ρ·β_on everywhere."""
        return 1.0 - self._missing[-1] >= tolerance

    def grow(self) -> None:
        """Add the supremizer of the least stable multiplier."""
        self.add(self._shares[self._worst].worst_supremizer(self.grown), f"{1.0 - self._missing[-1]:.3g} of β_on")
        self._assess()

    def history(self) -> dict[str, Array]:
        """The smallest share of β_on over the training set."""
        return {"beta_share": 1.0 - np.array(self._missing)}

    def _assess(self) -> None:
        self._worst, missing = self._maximum.next(lambda p: self._shares[p].missing(self.grown))
        self._missing.append(missing)
