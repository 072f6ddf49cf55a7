"""β_A at contact size: proved from a Schur complement that is bounded from above, for all constraints with one A.

With c the unknowns that B touches, i the others and Ŝ the Schur complement of A on c, B A⁻¹Bᵀ = B Ŝ⁻¹Bᵀ, and for any
matrix D (c×m), such as a computed Ŝ⁻¹Bᵀ,

    0 ≼ (B − DᵀŜ) Ŝ⁻¹ (Bᵀ − Ŝ D),    hence    B A⁻¹Bᵀ ≽ B D + DᵀBᵀ − DᵀŜ D ≽ T := B D + DᵀBᵀ − (F D)ᵀ(F D)

where FᵀF ≽ Ŝ. Such an F comes from a factorisation P of A + τS², S² = diag(A), with the part of i in sparse factors and
FᵀF in the block of c: where the round-off in A + τS² − P is bounded by δS² with δ ≤ τ, A ≼ P, and Schur complements
keep the order. T takes products of matrices with bounded round-off (Higham 2002, §3.5) and none with an inverse:
T − b²X_W ≽ 0 proves b ≤ β_A, by a Cholesky factorisation of it that succeeds after a shift (Rump 2006). τ is far below
what a margin of b costs, for the smallest eigenvalues of B A⁻¹Bᵀ belong to forces that displace little.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.cholesky import UNIT, PartialCholesky
from vibench.linalg.inertia import ATTEMPTS, first_shift
from vibench.linalg.inner_product import InnerProduct
from vibench.stability.coercivity import Constant, moved, smallest_quotient


class SchurFromAbove:
    """An F with FᵀF ≽ Ŝ, proved.

    Parameters
    ----------
    A
        Sparse SPD (n×n).
    eliminated, retained
        The unknowns i in the order of their elimination, and the unknowns c (c,).

    Attributes
    ----------
    factor
        F (c×c), upper triangular.

    Raises
    ------
    NumericalError
        If nothing is proved, as where A is not positive definite.
    """

    def __init__(self, A: SparseMatrix, eliminated: Indices, retained: Indices) -> None:
        order, last = np.concatenate([eliminated, retained]), len(retained)
        A, squares = sp.csc_array(A), A.diagonal()
        if not np.all(squares > 0.0):
            raise NumericalError("A is not positive definite")
        inverse = 1.0 / np.sqrt(squares[order])
        shift = first_shift(A)
        for _ in range(ATTEMPTS):
            partial = PartialCholesky(A + sp.diags_array(shift * squares, format="csc"), order, last, "A")
            try:
                self.factor: Array = np.asarray(scipy.linalg.cholesky(partial.schur()))
            except (np.linalg.LinAlgError, ValueError):
                raise NumericalError("A is not positive definite") from None
            errors = inverse * partial.round_off(inverse) + 2.0 * UNIT * (1.0 + shift)  # and that of the shift itself
            sizes = np.abs(self.factor)
            errors[-last:] += inverse[-last:] * _gamma(last) * (sizes.T @ (sizes @ inverse[-last:]))
            error = 1.01 * float(np.max(errors, initial=0.0))
            if error <= shift:
                return
            shift = 2.0 * error
        raise NumericalError("the round-off in a factorisation of A is not bounded")

    def energy_inf_sup(self, B: SparseMatrix, liftings: Array, W: InnerProduct) -> Constant:
        """Lower bound of β_A for B (m×c) on the retained unknowns, from Dᵀ (m×c); 0 where no other is proved."""
        if not B.shape[0]:
            return Constant(float("inf"), True)
        compliance = np.asarray(B @ liftings.T)
        square = smallest_quotient(0.5 * (compliance + compliance.T), W)
        if square <= 0.0:
            return Constant(0.0, True)
        pressed = self.factor @ liftings.T
        sizes = np.linalg.norm(pressed, axis=0)
        lower = compliance + compliance.T - pressed.T @ pressed
        lost = self._round_off(B, liftings, sizes)

        def stable(beta: float) -> bool:
            return _proved_positive(lower - beta**2 * W.matrix.toarray(), sizes, lost)

        found = moved(float(np.sqrt(square)), -1.0, stable)
        return found if found.proved else Constant(0.0, True)

    def _round_off(self, B: SparseMatrix, liftings: Array, sizes: Array) -> float:
        """A δ such that the round-off in T is between −δ diag(t²) and δ diag(t²), with t (m,) the norms of F D."""
        c, entries = len(self.factor), int(np.max(np.diff(sp.csr_array(B).indptr), initial=0))
        lengths = np.linalg.norm(liftings, axis=1)
        of_products = _gamma(c) * np.linalg.norm(self.factor) * lengths / sizes  # of F D, column by column
        rows = sp.linalg.norm(B, axis=1) / sizes
        m, ones = len(sizes), np.ones(len(sizes))
        # row sums of the bound of each entry over t_i t_j, which bound the largest eigenvalue
        sums = _gamma(entries + 2) * (rows * np.sum(lengths / sizes) + (lengths / sizes) * np.sum(rows))
        sums += of_products * m + ones * np.sum(of_products) + of_products * np.sum(of_products)
        sums += (_gamma(c) + 8.0 * UNIT) * (1.0 + np.max(of_products)) ** 2 * m
        return 1.01 * float(np.max(sums))


def _proved_positive(matrix: Array, sizes: Array, lost: float) -> bool:
    """Whether a symmetric matrix (m×m) is positive definite, of which δ diag(t²) may be round-off."""
    m = len(sizes)
    scaled = matrix / sizes / sizes[:, None]
    if not np.all(np.diag(scaled) <= 2.0):  # entries are then at most 2, and what a Cholesky factorisation loses is
        return False
    shifted = scaled - (lost + 4.0 * m * _gamma(m + 8)) * np.eye(m)
    try:
        np.linalg.cholesky(shifted)
    except np.linalg.LinAlgError:
        return False
    return True


def _gamma(terms: int) -> float:
    """γ_k of sums of k products."""
    return terms * UNIT / (1.0 - terms * UNIT)
