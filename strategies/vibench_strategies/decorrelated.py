"""No enrichment: the primal and the dual basis are chosen independently."""

from __future__ import annotations

from vibench import Enrichment, Kind, Offline, PrimalStrategy


class Decorrelated(PrimalStrategy):
    """V_N alone (Balajewicz, Amsallem and Farhat 2016; §2.2 of Niakh et al. 2022); no inf-sup stability."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:  # noqa: ARG002
        """Add nothing."""
        return Enrichment(Kind.NONE)
