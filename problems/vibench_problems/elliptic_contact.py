"""Hertz's theory of elliptic contact between an elastic half-space and a rigid paraboloid, frictionless."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import elliprd, elliprf

from vibench import Array

FLATTEST = 1e6
"""Ratio of semi-axes up to which the ratio of two radii is inverted."""


@dataclass(frozen=True)
class EllipticContact:
    """The pressure p₀ √(1 − x²/a² − y²/b²) on an ellipse.

    Attributes
    ----------
    a, b
        Semi-axes along x and y [m].
    peak
        p₀ [Pa].
    """

    a: float
    b: float
    peak: float

    @property
    def force(self) -> float:
        """F = ⅔ π a b p₀ [N]."""
        return 2.0 / 3.0 * np.pi * self.a * self.b * self.peak

    def pressure(self, x: Array, y: Array) -> Array:
        """The pressure [Pa] at points of the surface, any shape."""
        return np.asarray(self.peak * np.sqrt(np.maximum(1.0 - (x / self.a) ** 2 - (y / self.b) ** 2, 0.0)))


def elliptic_contact(radius_x: float, radius_y: float, approach: float, modulus: float) -> EllipticContact:
    """The contact under z = x²/(2 R_x) + y²/(2 R_y) − δ (Hertz 1882; Johnson, Contact Mechanics, 1985, §4.2).

    Inside the ellipse the pressure moves the surface by
    ½ P ∫₀^∞ (1 − x²/(a² + w) − y²/(b² + w)) / √((a² + w)(b² + w) w) dw with P = p₀ a b / E*. This is the depth of the
    paraboloid, δ − x²/(2 R_x) − y²/(2 R_y), for

        δ = P R_F(0, a², b²),    1/R_x = ⅔ P R_D(0, b², a²),    1/R_y = ⅔ P R_D(0, a², b²)

    in Carlson's symmetric integrals. R_x/R_y determines a/b, and δ R_x the size.

    Parameters
    ----------
    radius_x, radius_y
        R_x and R_y [m].
    approach
        δ [m].
    modulus
        E* = E/(1 − ν²) [Pa].
    """
    ratio = radius_x / radius_y

    def excess(log: float) -> float:
        kappa = np.exp(2.0 * log)  # (a/b)²
        return float(np.log(elliprd(0.0, kappa, 1.0) / elliprd(0.0, 1.0, kappa)) - np.log(ratio))

    end = np.log(FLATTEST)
    kappa = np.exp(2.0 * brentq(excess, -end, end, xtol=1e-15))
    b = float(np.sqrt(2.0 / 3.0 * radius_x * approach * elliprd(0.0, 1.0, kappa) / elliprf(0.0, kappa, 1.0)))
    a = float(b * np.sqrt(kappa))
    return EllipticContact(a, b, modulus * approach / (a * b * float(elliprf(0.0, a**2, b**2))))
