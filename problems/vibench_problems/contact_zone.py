"""Integrals of the pressure, shared by problems with a square contact zone in one quarter of space."""

from __future__ import annotations

import numpy as np

from vibench import Array, Output, Problem
from vibench_problems.elliptic_contact import EllipticContact


class ContactZone(Problem):
    """A problem whose multipliers are pressures, constant on m facets of a zone 0 ≤ x, y, symmetric in both planes."""

    young: float
    """E [Pa]."""
    areas: Array
    """Areas (m,) of the facets, seen from above."""
    squares: Array
    """∫ x² and ∫ y² over the facets (2×m)."""
    middles: Array
    """Their centres of area (2×m)."""

    def refuse(self, mu: Array, u: Array, lam: Array) -> str:  # noqa: ARG002
        """Refuse contact that reaches the end of the zone: it may extend beyond it."""
        outermost = self.middles.max(axis=0) > self.middles.max() * (1.0 - 1e-9)
        if not lam[outermost].any():
            return ""
        return "the contact reaches the end of the potential contact zone: a smaller approach keeps it inside"

    def force(self, lam: Array) -> float:
        """Contact force [N] of λ (m,), on all four quarters."""
        return float(4.0 * self.areas @ lam)

    def measured(self, lam: Array) -> EllipticContact:
        """Semi-axes and peak of a pressure λ (m,): √5 times its radii of inertia, as for an ellipse, and its maximum.

        `EllipticContact.force` of it is not its force, which is `force`.
        """
        a, b = np.sqrt(5.0 * self.squares @ lam / (self.areas @ lam))
        return EllipticContact(float(a), float(b), float(lam.max()))

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Contact force and area of all four quarters, and the largest pressure."""
        return (
            Output("contact force", "N", lam=4.0 * self.areas),
            Output("contact area", "m²", function=lambda _mu, _u, lam: float(4.0 * self.areas @ (lam > 0.0))),
            Output("largest pressure", "Pa", function=lambda _mu, _u, lam: float(np.max(lam))),
        )
