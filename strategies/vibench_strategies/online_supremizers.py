"""Supremizers computed at every query."""

from __future__ import annotations

from vibench import Enrichment, Kind, Offline, PrimalStrategy


class OnlineSupremizers(PrimalStrategy):
    """V_N + S_R(mu), equation (17) of Niakh et al. (2022), after Haasdonk, Salomon and Wohlmuth (2012)."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:  # noqa: ARG002
        """Compute nothing offline; request the supremizers of span χ at every parameter."""
        return Enrichment(Kind.PER_PARAMETER, eta=offline.span)
