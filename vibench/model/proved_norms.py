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

from functools import cached_property
from math import inf, sqrt

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, SparseMatrix
from vibench.linalg import EPS, UNIT_ROUND_OFF
from vibench.linalg.inner_product import InnerProduct
from vibench.qp.verification import extended
from vibench.stability.coercivity import share_of_diagonal


class ProvedNorms:
    """Norms in one A and its inverse, summed in extended precision if `precise`, of vectors in either precision.

    `unit` is v, the unit round-off of the sums, `A` is in their precision, and `magnitude` is |A|.
    """

    def __init__(self, A: SparseMatrix, *, precise: bool) -> None:
        self.A, self.magnitude, self._squares = extended(A) if precise else A, abs(A), A.diagonal()
        # where the machine has no extended precision it is the double one
        self.unit = 0.5 * max(float(np.finfo(np.longdouble).eps), 2.0**-63) if precise else UNIT_ROUND_OFF
        lengths, self._row = np.sqrt(self._squares), int(np.max(np.diff(sp.csr_array(A).indptr), initial=0))
        largest_sum = float(np.max((self.magnitude @ (1.0 / lengths)) / lengths, initial=0.0))
        self._of_squares = 1.01 * self._gamma(A.shape[0] + self._row + 4) * largest_sum

    @cached_property
    def precise(self) -> ProvedNorms:
        """Those in extended precision."""
        return ProvedNorms(self.A, precise=True)

    def _gamma(self, terms: int) -> float:
        return terms * self.unit / (1.0 - terms * self.unit)

    def energies(self, vectors: Array, products: Array) -> tuple[Array, Array]:
        """Upper bounds of ‖v‖_A (k,) of vectors (n×k) from A v, and shares (k,) that round-off may have in squares."""
        found = np.maximum(np.einsum("ik,ik->k", vectors, products).astype(float), 0.0)
        lost = self._of_squares * (self._squares @ vectors.astype(float, copy=False) ** 2)
        shares = np.divide(lost, found, out=np.where(lost > 0.0, np.inf, 0.0), where=found > 0.0)
        # a little more than the round-off of what follows, and of the sums of these norms in bounds
        return np.asarray(np.sqrt(found + lost) * (1.0 + 16.0 * EPS)), shares

    def largest(self, vectors: Array) -> float:
        """An upper bound of ‖V y‖_A / |y| over y, for vectors V (n×k)."""
        lengths = np.sqrt(self._squares @ vectors.astype(float) ** 2)
        squares = np.abs(vectors.T @ (self.A @ vectors)).astype(float)
        squares += self._of_squares * np.outer(lengths, lengths)
        return sqrt(float(np.max(squares.sum(axis=0), initial=0.0))) * (1.0 + EPS * len(lengths))

    def dual_norms(self, q: Array, sizes: Array, others: int, floor: Array) -> Array:
        """Upper bounds (k,) in A⁻¹ of computed q (n×k), sums of products with rows of A and of `others` further terms.

        `sizes` (n×k) bound the sums of the absolute values of all terms.
        """
        lost = 1.01 * (self._gamma(self._row + others + 8) * sizes + EPS * np.abs(q))
        return np.asarray(np.sqrt((1.0 / floor) @ (np.abs(q) + lost) ** 2) * (1.0 + (len(q) + 16.0) * EPS))


def dual_norm(X: InnerProduct, functional: Array, error: Array | float) -> float:
    """Upper bound of the norm in X⁻¹ of all functionals (n,) that differ from one by at most an error (n,)."""
    share = share_of_diagonal(X)
    if not share.proved:
        return inf
    norms, floor = ProvedNorms(X.matrix, precise=True), share.value * X.matrix.diagonal()
    p = extended(X.riesz(functional))[:, None]
    product = norms.A @ p
    q, sizes = (functional[:, None] - product).astype(float), norms.magnitude @ np.abs(p).astype(float)
    sizes += np.abs(functional)[:, None]
    found = norms.energies(p, product)[0] + norms.dual_norms(q, sizes, 0, floor)
    return float(found[0]) + float(np.linalg.norm(error / np.sqrt(floor)))
