"""Terms of the error bounds (ii), and what their corrections have in common at any cost.

`vibench.model.error_bounds` states the bounds. A *correction* is any w with B w ≥ s, s = B u_N − g. In floating-point
arithmetic margins show that: s is raised above its round-off, and w is accepted if it satisfies the rows by more than
the round-off of B w and s. Equalities leave no room for a margin. There w misses B_E w = s_E by δ, and w' = w + d holds
it, with the smallest d such that B_E d = δ. With K = F⁻ᵀB_Eᵀ = Q R for the inner product X = FᵀF, d = M R⁻ᵀδ, M = F⁻¹Q,
‖d‖_X ≤ η = ‖δ‖ / σ_min(R) and |b d| ≤ ‖b M‖ η for any row b, so that w' satisfies all rows if w satisfies the others by
‖b M‖ η, and the bounds hold for it with ω + η.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from math import sqrt

import numpy as np
import scipy.linalg

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.interfaces.dual_sets import DualSet


class BoundNote(StrEnum):
    """Reason why a bound is missing, estimated or not from prepared data, and which bound of β_A is used."""

    NOT_IN_CONE = "λ_N has negative coefficients"
    NOT_IN_SET = "λ_N is outside the set K of the multipliers"
    ON_ABSENT_ROW = "λ_N is not zero on a row whose g is infinite"
    NO_CORRECTION = "no w with B w ≥ s was found"
    UNCORRECTED = "the bound is that of w = 0: no better w was found"
    ESTIMATED = "α is estimated"
    ROUND_OFF = "no lower bound of A is known from which round-off in the norm of its inverse could be bounded"
    NOT_UNIQUE = "λ has no bound in W: no β_A > 0 is proved, as where rows are dependent or equalities"
    NOT_PREPARED = "no prepared correction satisfies B w ≥ s: the best w was computed at the parameter"
    NOT_COERCIVE = "no positive lower bound of the coercivity of A was found at this parameter"
    OUTSIDE = "mu is outside the parameter box: interpolation errors are known inside it"
    SCALED = "beta_A from B(mu) = theta(mu) B_0"
    ON_BODIES = "beta_A from the bodies on which B is constant"
    NO_BODY = "no beta_A: B is declared to be no multiple of one matrix, and constant on no body"
    NOT_PROVED = "no beta_A: no positive lower bound of the inf-sup constant of the constant part of B is proved"
    NOT_CONSTANT = "no beta_A: B is not at this parameter what it is at the training parameters on any body"


def outside_note(K: DualSet) -> BoundNote:
    """Why a λ_N outside of K has no bound."""
    return BoundNote.NOT_IN_SET if K.blocks else BoundNote.NOT_IN_CONE


class CorrectionMode(StrEnum):
    """Choice of the solutions to correct: none, all, or those whose violation dominates the bound, ω > ρ."""

    NONE = "none"
    FEASIBLE = "feasible"
    AUTO = "auto"

    def applies(self, omega: float, rho: float) -> bool:
        """Tell whether a solution with these ω and ρ is corrected."""
        return self is CorrectionMode.FEASIBLE or (self is CorrectionMode.AUTO and omega > rho)


# not frozen: an object of a frozen class takes four times as long to make, in every certified query
@dataclass(slots=True)
class BoundTerms:
    """Terms of the bounds (ii) of one pair u_N and λ_N with one correction w, or upper bounds of these terms.

    ρ = ‖r‖_{A⁻¹}, ω = ‖w‖_A, κ (see `DualSet.gap`) and the `gap` ‖r + A w‖²_{A⁻¹} + 2κ, twice the duality gap of λ_N
    and the feasible u_N − w.
    """

    rho: float
    omega: float
    kappa: float
    gap: float

    @classmethod
    def from_work(cls, rho: float, omega: float, kappa: float, work: float) -> BoundTerms:
        """Terms from rᵀw: the gap is Δ_A² + 2 rᵀw, which cancellation leaves with half of its digits."""
        return cls(rho, omega, kappa, rho**2 + omega**2 + 2.0 * kappa + 2.0 * work)

    @property
    def primal(self) -> float:
        """The bound Δ_A of ‖u − u_N‖_A."""
        return sqrt(self.rho**2 + self.omega**2 + 2.0 * self.kappa)

    @property
    def dual(self) -> float:
        """The bound of ‖Bᵀ(λ − λ_N)‖_{A⁻¹}."""
        return min(sqrt(max(0.0, self.gap)), self.omega + self.primal)


def first_margin(round_off: Array) -> Array:
    """Margin by which s is raised first, from the round-off (m,) in s."""
    # B w has about the round-off of s, and the bounds of both are summed: four times leaves room for twice the sum
    return 4.0 * round_off


@dataclass(frozen=True)
class Equalities:
    """Rows that hold as equalities."""

    # Positions (r,) among them of independent ones, and the norms (r,) of these in X⁻¹.
    chosen: Indices
    lengths: Array
    # R (r×r) in units of these norms, in which no scaling of rows changes σ_min, and σ_min.
    factor: Array
    smallest: float
    # M (·×r), and ‖b M‖ (m,) of all rows b.
    liftings: Array
    reach: Array

    @classmethod
    def from_rows(cls, K: Array, unwhiten: Callable[[Array], Array], B: SparseMatrix) -> Equalities:
        """Factorise K (n×e); `unwhiten` applies F⁻¹, and B (m×·) has all rows."""
        lengths = np.linalg.norm(K, axis=0)
        lengths[lengths == 0.0] = 1.0
        Q, R, order = scipy.linalg.qr(K / lengths, mode="economic", pivoting=True)
        # rows of length 1 are dependent where a pivot is below 1e-12; dependent ones hold with the others
        rank = int(np.sum(np.abs(np.diag(R)) > 1e-12))
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
        """Bound η of ‖w' − w‖ for a bound (e,) of |δ|."""
        # twice the quotient, for the round-off in σ_min
        return 2.0 * float(np.linalg.norm(missing[self.chosen] / self.lengths)) / self.smallest
