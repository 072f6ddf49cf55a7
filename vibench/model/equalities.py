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

import numpy as np
import scipy.linalg

from vibench.arrays import Array, Indices, SparseMatrix

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
