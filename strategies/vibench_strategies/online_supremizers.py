"""Supremizers computed at every query."""

from __future__ import annotations

from vibench.arrays import Array
from vibench.problem import VariationalInequality
from vibench.space import InnerProduct
from vibench.strategy import Enrichment, Kind, Offline, PrimalStrategy
from vibench.supremizer import supremizers


class OnlineSupremizers(PrimalStrategy):
    """V_N + S_R(mu), equation (17) of Niakh et al. (2022), after Haasdonk, Salomon and Wohlmuth (2012)."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:  # noqa: ARG002
        """Nothing offline; the supremizers of span χ at every parameter."""
        return Enrichment(Kind.PER_PARAMETER, supply=_supply)


def _supply(V: InnerProduct, vi: VariationalInequality, span: Array) -> Array:
    return supremizers(V, vi.B, span)
