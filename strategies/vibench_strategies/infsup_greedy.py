"""Inf-sup greedy: supremizers of the least stable multipliers, until a given share of β_on is reached."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vibench import NestedStrategy, Offline, Step
from vibench.reduction import LazyMaximum
from vibench_strategies.supremizer_greedy import Shares, SupremizerSpace


class InfSupGreedy(NestedStrategy):
    """After the double greedy algorithm of Dahmen, Plesken and Welper (2014), with a fixed cone and a fixed V_N.

    The tolerance ρ demands β_S(mu) ≥ ρ·β_on(mu) on the training set. Both are inf-sup constants over span χ (§3.1 of
    Niakh et al. 2022); online supremizers attain β_on, the constant of the whole of V. A larger ρ takes more vectors.
    """

    larger_is_tighter = True

    def steps(self, offline: Offline) -> Iterator[Step]:
        """Add T(mu)η* at the mu of the smallest β_S(mu)/β_on(mu), η* its minimiser."""
        space = SupremizerSpace(offline)
        shares = [Shares(images) for images in space.supremizers]
        largest = LazyMaximum(np.ones(len(shares)))  # shares only rise as S grows
        history: list[float] = []
        while True:
            p, missing = largest.next(lambda p: shares[p].missing(space.basis))
            history.append(1.0 - missing)
            yield space.step(history[-1], {"beta_share": history})
            space.add(shares[p].worst_supremizer(space.basis), f"β_S/β_on = {history[-1]:.3g}")
