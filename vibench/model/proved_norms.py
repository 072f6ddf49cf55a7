"""Upper bounds of norms in A and A⁻¹ that hold in exact arithmetic, however large the condition number of A.

For any p and q = ℓ − A p, and T > 0 diagonal with A ≽ T²,

    ‖ℓ‖_{A⁻¹} ≤ ‖p‖_A + ‖q‖_{A⁻¹} ≤ ‖p‖_A + |T⁻¹q|,

so that p ≈ A⁻¹ℓ may come from any factorisation. With a proved α and ξ, A ≽ αX_V and X_V ≽ ξ diag(X_V), T² is
αξ diag(X_V). It may be rough: q is round-off. pᵀA p and q = f − A(u + p) − Bᵀλ are summed with a unit round-off v, that
of double precision being u. With k terms in a row of A and Bᵀ, n unknowns, S² = diag(A) and the largest row sum ν of
S⁻¹|A|S⁻¹, they are off by at most (Higham 2002, §3.1 and 3.5)

    γ_{n+k+4} |p|ᵀ|A||p| ≤ γ_{n+k+4} ν |S p|²,    γ_{k+8} (|f| + |A|(|u| + |p|) + |Bᵀ|λ) + u|q|,    γ_j = jv/(1 − jv).

In double precision the first one is as large as ‖p‖²_A for a condition number of 1e12 at the latest, and the second one
may be as large as small bounds: there v is that of extended precision, and p may be refined.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg import EPS, UNIT_ROUND_OFF
from vibench.linalg.inner_product import InnerProduct
from vibench.qp.verification import extended
from vibench.stability.coercivity import share_of_diagonal


class ProvedNorms:
    """Norms of one inequality, summed in extended precision if `precise`; `floor` is T² (n,) with A ≽ diag(T²).

    Vectors may be in either precision. `unit` is v, the unit round-off of the sums.
    """

    def __init__(self, vi: VariationalInequality, floor: Array, *, precise: bool) -> None:
        self._vi, self._magnitude, self._weights = vi, abs(vi.A), 1.0 / np.sqrt(floor)
        self._A, self._B = (extended(vi.A), extended(vi.B)) if precise else (vi.A, vi.B)
        # where the machine has no extended precision it is the double one
        self.unit = 0.5 * max(float(np.finfo(np.longdouble).eps), 2.0**-63) if precise else UNIT_ROUND_OFF
        rows, columns = (int(np.max(np.diff(sp.csr_array(one).indptr), initial=0)) for one in (vi.A, vi.B.T))
        self._of_squares, self._of_residual = self._gamma(len(vi.f) + rows + 4), self._gamma(rows + columns + 8)
        self._squares = vi.A.diagonal()
        lengths = np.sqrt(self._squares)
        self._largest_sum = float(np.max((self._magnitude @ (1.0 / lengths)) / lengths, initial=0.0))

    def _gamma(self, terms: int) -> float:
        """The bound γ of round-off in a sum of so many terms."""
        return terms * self.unit / (1.0 - terms * self.unit)

    def energies(self, vectors: Array) -> tuple[Array, float]:
        """Upper bounds of ‖v‖_A (k,) of vectors (n×k), and the largest share that round-off may have in the square."""
        found = np.maximum(np.sum(vectors * (self._A @ vectors), axis=0).astype(float), 0.0)
        lost = 1.01 * self._of_squares * self._largest_sum * (self._squares @ vectors.astype(float) ** 2)
        shares = np.divide(lost, found, out=np.full_like(lost, np.inf), where=found > 0.0)[lost > 0.0]
        # a little more than the round-off of what follows, and of the sums of these norms in bounds
        return np.asarray(np.sqrt(found + lost) * (1.0 + 16.0 * EPS)), float(np.max(shares, initial=0.0))

    def largest(self, vectors: Array) -> float:
        """An upper bound of ‖V y‖_A / |y| over y, for vectors V (n×k)."""
        lengths = np.sqrt(self._squares @ vectors.astype(float) ** 2)
        squares = np.abs(vectors.T @ (self._A @ vectors)).astype(float)
        squares += 1.01 * self._of_squares * self._largest_sum * np.outer(lengths, lengths)
        return sqrt(float(np.max(squares.sum(axis=0), initial=0.0))) * (1.0 + EPS * len(lengths))

    def missed(self, u: Array, p: Array, lam: Array) -> tuple[Array, float]:
        """The computed q = f − A(u + p) − Bᵀλ (n,), and an upper bound of its norm in A⁻¹, for λ ≥ 0 (m,)."""
        vi = self._vi
        q = np.asarray(vi.f - self._A @ (u + p) - self._B.T @ lam, float)
        size = np.abs(vi.f) + self._magnitude @ (np.abs(u) + np.abs(p).astype(float)) + abs(vi.B).T @ lam
        lost = 1.01 * (self._of_residual * size + EPS * np.abs(q))
        return q, float(np.linalg.norm(self._weights * (np.abs(q) + lost))) * (1.0 + 16.0 * EPS * sqrt(len(q)))


def dual_norm(X: InnerProduct, functional: Array, error: Array | float) -> float:
    """Upper bound of the norm in X⁻¹ of all functionals (n,) that differ from one by at most an error (n,)."""
    share, none = share_of_diagonal(X), np.zeros(0)
    if not share.proved:
        return inf
    floor, p = share.value * X.matrix.diagonal(), extended(X.riesz(functional))
    load = VariationalInequality(X.matrix, functional, sp.csr_array((0, X.dim)), none)
    norms, beside = ProvedNorms(load, floor, precise=True), float(np.linalg.norm(error / np.sqrt(floor)))
    return float(norms.energies(p[:, None])[0][0]) + norms.missed(np.zeros(X.dim), p, none)[1] + beside
