"""Corrections that hold equalities up to round-off, which no margin covers, and how far the exact ones are from them.

A row and its opposite ask for B_E w = s_E. In floating-point arithmetic w misses that by δ = s_E − B_E w. As s_E is in
the range of B_E where the problem has a solution, w' = w + d holds it, with the smallest d such that B_E d = δ: with
K = F⁻ᵀB_Eᵀ = Q R for the inner product X = FᵀF,

    d = M R⁻ᵀδ,    M = F⁻¹Q,    ‖d‖_X ≤ η = ‖δ‖ / σ_min(R),    |b d| ≤ ‖b M‖ η    for any row b.

So w' satisfies all rows where w satisfies the others by a margin of ‖b M‖ η, and the bounds hold for it, with ω + η.
Rows are taken in units of their norms in X⁻¹, in which no scaling of them changes σ_min. Those that depend on others
are left out of Q and R. w itself is moved by its computed d, so that η is of round-off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import scipy.linalg

from vibench.arrays import Array, Indices, SparseMatrix

NO_ROOM = 1e-12
"""Opposite rows are an equality where there is less room between them than this share of the terms of B u_N − g."""

IMPLIED = 1e4
"""Equalities that depend on others hold with them up to this multiple of round-off, or the problem has no solution."""

REFERENCE = 1e-6
"""Largest error bound of a high-fidelity solution, relative to it in the energy norms."""

MARGIN = 4.0
"""The first margin of s, as a multiple of the round-off in s."""

IMPLAUSIBLE = 1e8
"""Multipliers this many times those that rows alone would have are of dependent constraints, solved in round-off."""

ATTEMPTS = 4
"""Margins that are tried, each at least ten times the one before."""


class BoundNote(StrEnum):
    """Reason why a bound is missing, estimated or not from prepared data, and which bound of β_A is used."""

    NOT_IN_CONE = "λ_N has negative coefficients"
    ON_ABSENT_ROW = "λ_N is not zero on a row whose g is infinite"
    NO_CORRECTION = "no w with B w ≥ s was found"
    ESTIMATED = "α is estimated"
    NOT_UNIQUE = "λ has no bound in W: no β_A > 0 is proved, as where rows are dependent or equalities"
    NOT_PREPARED = "no prepared correction satisfies B w ≥ s: the best w was computed at the parameter"
    NOT_COERCIVE = "no positive lower bound of the coercivity of A was found at this parameter"
    OUTSIDE = "mu is outside the parameter box: interpolation errors are known inside it"
    SCALED = "beta_A from B(mu) = theta(mu) B_0"
    ON_BODIES = "beta_A from the bodies on which B is constant"
    NO_BODY = "no beta_A: B is declared to be no multiple of one matrix, and constant on no body"
    NOT_PROVED = "no beta_A: no positive lower bound of the inf-sup constant of the constant part of B is proved"
    NOT_CONSTANT = "no beta_A: B is not at this parameter what it is at the training parameters on any body"


class CorrectionMode(StrEnum):
    """Which solutions are corrected: none, all, or those whose violation dominates the bound, ω > ρ."""

    NONE = "none"
    FEASIBLE = "feasible"
    AUTO = "auto"

    def applies(self, omega: float, rho: float) -> bool:
        """Whether a solution with these ω and ρ is corrected."""
        return self is CorrectionMode.FEASIBLE or (self is CorrectionMode.AUTO and omega > rho)


@dataclass(frozen=True)
class BoundTerms:
    """The terms of (ii), and ‖r + A w‖_{A⁻¹}, that need no constants."""

    rho: float
    omega: float
    kappa: float
    feasible_rho: float

    @property
    def primal(self) -> float:
        """Δ_A."""
        return float(np.sqrt(self.rho**2 + self.omega**2 + 2.0 * self.kappa))

    @property
    def dual(self) -> float:
        """The bound of ‖Bᵀε‖ in the norm of A⁻¹."""
        gap = self.feasible_rho**2 + 2.0 * self.kappa  # twice the duality gap
        return min(float(np.sqrt(gap)), self.omega + self.primal)


DEPENDENT = 1e-12
"""Equalities are dependent where a pivot of R is below this."""

SAFETY = 2.0
"""Factor on η for the round-off in σ_min."""


@dataclass(frozen=True)
class Equalities:
    """Rows that hold as equalities.

    Attributes
    ----------
    chosen
        Positions (r,) among them of independent ones.
    lengths
        Norms (r,) of these in X⁻¹.
    factor, smallest
        R (r×r) in units of these, and σ_min.
    liftings
        M (·×r).
    reach
        ‖b M‖ (m,) of all rows b.
    """

    chosen: Indices
    lengths: Array
    factor: Array
    smallest: float
    liftings: Array
    reach: Array

    @classmethod
    def of(cls, K: Array, unwhiten: Callable[[Array], Array], B: SparseMatrix) -> Equalities:
        """From K (n×e), F⁻¹ and all rows B (m×·)."""
        lengths = np.linalg.norm(K, axis=0)
        lengths[lengths == 0.0] = 1.0
        Q, R, order = scipy.linalg.qr(K / lengths, mode="economic", pivoting=True)
        pivots = np.abs(np.diag(R))
        rank = int(np.sum(pivots > DEPENDENT))
        R, chosen = R[:rank, :rank], order[:rank]
        smallest = float(np.min(np.linalg.svd(R, compute_uv=False), initial=1.0))
        M = unwhiten(np.ascontiguousarray(Q[:, :rank]))
        return cls(chosen, lengths[chosen], R, smallest, M, np.linalg.norm(B @ M, axis=1))

    def step(self, missing: Array) -> Array:
        """The computed d for δ (e,)."""
        scaled = missing[self.chosen] / self.lengths
        return np.asarray(self.liftings @ scipy.linalg.solve_triangular(self.factor, scaled, trans="T"))

    def forces(self, missing: Array) -> Array:
        """The forces (r,) on the chosen rows that displace them by d: X d = B_Eᵀ times these."""
        scaled = scipy.linalg.solve_triangular(self.factor, missing[self.chosen] / self.lengths, trans="T")
        return np.asarray(scipy.linalg.solve_triangular(self.factor, scaled) / self.lengths)

    def distance(self, missing: Array) -> float:
        """η for a bound (e,) of |δ|."""
        return SAFETY * float(np.linalg.norm(missing[self.chosen] / self.lengths)) / self.smallest
