"""β_A for all constraints with one A: proved by liftings of the constraints and products with one matrix.

Where the round-off of a factorisation of A is known this is at contact size, by the Schur complement that it has.

With c the unknowns that B touches, and S² = diag(A), a factorisation of A has computed factors, and with them the Schur
complement Ŝ on c, which are the exact ones of a P with −δS² ≼ A − P ≼ δS² (`PartialCholesky.round_off`). Where
A ≽ σS² is proved, A ≼ P + δS² ≼ P / (1 − δ/σ), hence

    B A⁻¹Bᵀ ≽ (1 − δ/σ) B Ŝ⁻¹Bᵀ.

σ follows from α and a constant of the norm alone: A ≽ αX_V and X_V ≽ ξ diag(X_V) make it αξ min_i (X_V)_ii / A_ii. It
may be rough, since δ is round-off. For any matrix D (c×m), such as a computed Ŝ⁻¹Bᵀ, and R = Bᵀ − ŜD,

    B Ŝ⁻¹Bᵀ = BD + DᵀR + RᵀŜ⁻¹R ≽ BD + DᵀR,

where DᵀR is round-off: its entries are at most |S d_i||S⁻¹r_j|. So K − b²/(1 − δ/σ) X_W ≽ 0 proves b ≤ β_A, with the
symmetric part K of the computed BD, by a Cholesky factorisation of it that succeeds after a shift by all that was left
out (Rump 2006). Products of matrices have bounded round-off (Higham 2002, §3.5), and there is none with an inverse.

The same with A in place of Ŝ, all unknowns in place of c and δ = 0 takes nothing for granted of who computed D. Where A
is constant and B is not, R is not computed anew: for a computed Ĉ ≈ Ŝ⁻¹ and E = I − ŜĈ, D = ĈBᵀ has R = EBᵀ, and the
columns of S D and S⁻¹R are at most the sums of those of SĈ and S⁻¹E with weights |B|. Where B = θX_W, of one multiplier
for each unknown of c, D = τI, τ = b²/θ, is enough: τ(B + Bᵀ) − τ²Ŝ ≽ b² X_W just where θ² X_W ≽ b² Ŝ. Nothing is dense
there, where Ŝ is sparse, and the largest of these b is θ over the root of the largest eigenvalue of Ŝ against X_W.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpotrf

from vibench.arrays import Array, SparseMatrix
from vibench.linalg import UNIT_ROUND_OFF
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.factorisations import DEFAULT, implementation
from vibench.linalg.inner_product import InnerProduct
from vibench.linalg.lanczos import Lanczos
from vibench.linalg.proofs import is_proved_definite
from vibench.stability.coercivity import FEW, Constant, moved, smallest_root


def multiple_of(B: SparseMatrix, W: InnerProduct) -> float:
    """The factor θ where B (m×c) is θX_W, with more than a few rows; 0 elsewhere."""
    if B.shape[0] != B.shape[1] or B.shape[0] <= FEW:
        return 0.0
    theta = float(B.diagonal().sum() / W.matrix.diagonal().sum())
    # A larger difference than round-off is allowed, but makes the bound loose.
    return theta if abs(B - theta * W.matrix).max() <= 1e-12 * abs(B).max() else 0.0


# K (m×m), and bounds of the norms (m,) of the columns of S D and of S⁻¹R, with the round-off in what is computed.
Products = tuple[Array, Array, Array]


class ContactInfSup:
    """Lower bounds of β_A for constraints with one A.

    `schur` is the computed Ŝ (c×c), `squares` the diagonal of A there (c,), and `lost` is δ/σ; for constraints on all
    unknowns these are A, its diagonal, and 0. `extend` maps liftings (·, k) on the unknowns that constraints involve to
    columns (c, k) of D; for A these are more. `inverse` is Ĉ (c×c), symmetric, where `of_inverse` is used.
    """

    def __init__(
        self, schur: BlockDiagonal | SparseMatrix, squares: Array, lost: float,
        extend: Callable[[Array], Array] = np.asarray, inverse: Array | None = None,
    ) -> None:  # fmt: skip
        self._schur, self._scale, self._lost, self._extend = schur, np.sqrt(squares), lost, extend
        self.inverse = inverse
        # The largest row sum of S⁻¹|Ŝ|S⁻¹ bounds its norm; inner products with Ŝ have so many terms.
        parts = schur.blocks if isinstance(schur, BlockDiagonal) else ((np.arange(len(squares)), schur),)
        sums = [np.max((abs(part) @ (1.0 / self._scale[c])) / self._scale[c], initial=0.0) for c, part in parts]
        self._norm = float(max(sums, default=0.0))
        self._terms = max((int(np.max(np.sum(part != 0.0, axis=0), initial=0)) for _, part in parts), default=0)

    def energy_inf_sup(self, B: SparseMatrix, liftings: Array, W: InnerProduct) -> Constant:
        """Lower bound of β_A for B (m×c), from liftings (m×·) that `extend` makes Dᵀ; 0 where no other is proved."""
        return self._proved(B, W, lambda: self._products(sp.csr_array(B), liftings))

    def of_inverse(self, B: SparseMatrix, compliance: Array, W: InnerProduct) -> Constant:
        """Lower bound of β_A from the compliance (m×m) that is computed as B(BĈ)ᵀ, the products row by row."""

        def products() -> Products:
            (lifted, residuals), weights = self._of_inverse, abs(sp.csr_array(B))
            lifted, residuals = weights @ lifted, weights @ residuals
            return compliance, lifted, residuals + _gamma(_most_entries(B) + 4) * self._norm * lifted

        return self._proved(B, W, products)

    @cached_property
    def _of_inverse(self) -> tuple[Array, Array]:
        """The norms (c,) of the columns of SĈ and of S⁻¹E."""
        assert self.inverse is not None
        return self._products(sp.eye_array(len(self.inverse), format="csr"), self.inverse)[1:]

    def _proved(self, B: SparseMatrix, W: InnerProduct, products: Callable[[], Products]) -> Constant:
        if not B.shape[0]:
            return Constant(float("inf"), True)
        # Beyond a half of σ the factorisation of A is too inaccurate to say anything.
        if not self._lost <= 0.5:
            return Constant(0.0, True)
        compliance, lifted, residuals = products()
        if not np.all(np.diag(compliance) > 0.0):
            return Constant(0.0, True)
        sizes = np.sqrt(np.diag(compliance))
        scaled, mass = compliance + compliance.T, _scaled(W.matrix, sizes)
        scaled *= 0.5 / sizes
        scaled /= sizes[:, None]
        lost, of_mass = self._left_out(B, lifted, residuals, sizes), float(np.max(abs(mass).sum(axis=0), initial=0.0))

        def stable(beta: float) -> bool:
            weight = beta**2 / (1.0 - 1.01 * self._lost)
            shifted = (-weight * mass).toarray()
            shifted += scaled
            return _proved_positive(shifted, lost + 8.0 * UNIT_ROUND_OFF * weight * of_mass)

        constant = moved(smallest_root(scaled, mass), -1.0, stable)
        return constant if constant.proved else Constant(0.0, True)

    def of_multiple(self, theta: float, B: SparseMatrix, W: InnerProduct) -> Constant | None:
        """Lower bound of β_A for B = θX_W and a sparse Ŝ, without liftings; `None` where none is proved so."""
        S = self._schur
        if isinstance(S, BlockDiagonal) or not self._lost <= 0.5:
            return None
        iterations, softness = Lanczos(lambda v: W.riesz(S @ v), W.matrix), 1.0 - 1.01 * self._lost

        def estimate(accuracy: float) -> float:
            return float(abs(theta) * np.sqrt(softness / iterations.largest(accuracy)))

        def stable(beta: float) -> bool:
            square = beta**2 / softness
            tau = square / theta
            return is_proved_definite([2.0 * tau * B, -(tau**2) * S, -square * W.matrix], implementation(DEFAULT))

        constant = moved(estimate, -1.0, stable)
        return constant if constant.proved else None

    def _products(self, B: SparseMatrix, liftings: Array) -> Products:
        """The K, ‖S d_i‖ and ‖S⁻¹r_i‖ of liftings (m×·)."""
        m, scale = B.shape[0], self._scale[:, None]
        compliance, lifted, residuals = np.empty((m, m)), np.empty(m), np.empty(m)
        # All columns of D at once may not fit in memory.
        for columns in (slice(first, first + 128) for first in range(0, m, 128)):
            D = self._extend(liftings[columns].T)
            compliance[:, columns], lifted[columns] = B @ D, np.linalg.norm(scale * D, axis=0)
            left = np.asarray(B[columns].T.toarray() - self._schur @ D)
            residuals[columns] = np.linalg.norm(left / scale, axis=0)
        return compliance, lifted, residuals + _gamma(self._terms + 4) * (self._forces(B) + self._norm * lifted)

    def _forces(self, B: SparseMatrix) -> Array:
        return np.asarray(sp.linalg.norm(sp.csr_array(B / self._scale), axis=1))

    def _left_out(self, B: SparseMatrix, lifted: Array, residuals: Array, sizes: Array) -> float:
        """A bound of the norm of DᵀR and of the round-off in K, both in units of t (m,), the roots of diag(K)."""
        # Each entry is bounded by the mean of |x_i y_j| and its transpose, which have at most the norm |x||y|.
        forces = residuals + _gamma(_most_entries(B) + 4) * self._forces(B)
        of_products = np.linalg.norm(lifted / sizes) * np.linalg.norm(forces / sizes)
        return 1.01 * float(of_products + 8.0 * UNIT_ROUND_OFF * len(sizes))


def _most_entries(B: SparseMatrix) -> int:
    return int(np.max(np.diff(sp.csr_array(B).indptr)))


def _scaled(matrix: SparseMatrix, sizes: Array) -> SparseMatrix:
    unit = sp.diags_array(1.0 / sizes)
    return sp.csr_array(unit @ matrix @ unit)


def _proved_positive(scaled: Array, lost: float) -> bool:
    """Prove that a symmetric matrix (m×m), to be overwritten, is definite whatever its round-off of norm `lost`."""
    m = len(scaled)
    # Entries of a definite matrix are then at most 2, which bounds the round-off of a Cholesky factorisation.
    if not np.all(np.diag(scaled) <= 2.0):
        return False
    scaled[np.diag_indices(m)] -= lost + 4.0 * m * _gamma(m + 8)
    factor, failed = dpotrf(scaled.T, lower=True, overwrite_a=True)
    return not failed and bool(np.all(np.diag(factor) > 0.0))  # OpenBLAS accepts pivots that are not numbers


def _gamma(terms: int) -> float:
    """The bound γ_k = ku/(1 − ku) of the relative round-off in sums of k products (Higham 2002, §3.1)."""
    return terms * UNIT_ROUND_OFF / (1.0 - terms * UNIT_ROUND_OFF)
