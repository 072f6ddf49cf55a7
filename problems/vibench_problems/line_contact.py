"""Hertz's theory of line contact, and the same quantities measured on a solution of the Hertz problem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench import Array
from vibench_problems.hertz import Hertz


@dataclass(frozen=True)
class LineContact:
    """Half-width a [m] of the contact and peak pressure p₀ [Pa]."""

    half_width: float
    peak: float

    def differences(self, other: LineContact) -> tuple[float, float]:
        """Relative differences of half-width and peak pressure from another's."""
        return self.half_width / other.half_width - 1.0, self.peak / other.peak - 1.0


def theory(problem: Hertz, mu: Array, u: Array) -> LineContact:
    """Half-width a = √(4PR*/(πE*)) and peak p₀ = 2P/(πa) for the computed load P [N/m] (Johnson 1985, §4.2).

    E* = E/(2(1 − ν²)) for two bodies of the same material and 1/R* = 1 + 1/mu. The theory assumes a ≪ R.

    Parameters
    ----------
    problem
        The problem.
    mu
        The parameter, the radius of disc 2 first (d,).
    u
        Displacement (n,), for the load.
    """
    load = sum(problem.resultants(mu, u))  # of each disc only one half is meshed, and the two forces are equal
    modulus = problem.young / (2.0 * (1.0 - problem.poisson**2))
    radius = 1.0 / (1.0 + 1.0 / float(mu[0]))
    half_width = float(np.sqrt(4.0 * load * radius / (np.pi * modulus)))
    return LineContact(half_width, 2.0 * load / (np.pi * half_width))


def measured(problem: Hertz, mu: Array, lam: Array) -> LineContact:
    """Half-width and peak of the elliptic pressure fitted to λ (m,) by a linear fit of p² over x².

    The last active macro-edge is excluded, because the contact ends inside it.
    """
    x = problem.points(mu)[0][0, problem.slave.zone[1::2]]
    active = np.flatnonzero(lam)[:-1]
    slope, square = np.polyfit(x[active] ** 2, lam[active] ** 2, 1)
    return LineContact(float(np.sqrt(-square / slope)), float(np.sqrt(square)))
