"""Numbers of positive eigenvalues of sparse symmetric matrices, proved by a factorisation and a bound of its round-off.

Let Q = Q₁ + … + Q_p be symmetric and S = diag(s) > 0. The factorisation LU ≈ M of the computed M ≈ Q − τS² without
off-diagonal pivoting gives P = L D Lᵀ, D = diag(U), which has exactly as many positive eigenvalues as D has positive
entries (Sylvester), whatever the round-off. With the unit round-off u, k terms at most in an inner product of the
factorisation and γ_k = ku/(1 − ku),

    |M − P| ≤ γ_k |L||U| + |L||U − D Lᵀ|    (Higham 2002, Theorem 9.3),    |Q − τS² − M| ≤ (p + 1)u (Σ|Q_i| + τS²).

With Δ the sum of both, −δS² ≼ Q − τS² − P ≼ δS² for the largest row sum δ of S⁻¹ΔS⁻¹, which takes products of sparse
matrices with one vector. If δ ≤ τ, then Q ≽ P, and Q has at least as many positive eigenvalues as P (Weyl). This is
Rump's verification of positive definiteness (BIT Numerical Mathematics 46, 2006) for any inertia, with a bound of the
round-off that is computed instead of estimated beforehand. It assumes that nothing under- or overflows.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from functools import reduce

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.linalg import UNIT_ROUND_OFF
from vibench.linalg.cholesky import have_one_pattern, round_off_of_factors, symmetric_lu

FIRST_SHIFT, PLANE = 1e-11, 16.0
"""τ of the first attempt, and the entries of a row from which on it is larger by their share: factors of matrices of
meshes in space have longer sums. Where the round-off exceeds it, τ becomes twice the round-off."""

ATTEMPTS = 3


def proved_positive(parts: Sequence[SparseMatrix], scale: Array, order: Indices | None = None) -> int:
    """How many positive eigenvalues the sum of symmetric matrices (n×n) has at least; 0 where nothing is proved.

    Parameters
    ----------
    parts
        Q₁, …, Q_p; the sum is that of their symmetric parts.
    scale
        s > 0 (n,): roots of typical diagonal entries. The proof needs eigenvalues of S⁻¹QS⁻¹ away from round-off.
    order
        Elimination order (n,); by default minimum degree.
    """
    columns = [sp.csc_array(part) for part in parts]
    if not all(np.all(np.isfinite(part.data)) for part in columns):
        return 0
    sizes, squares = np.sum([_absolute_sums(part, 1.0 / scale) for part in columns], axis=0), scale**2
    total = columns[0] if len(columns) == 1 else reduce(operator.add, columns)
    if order is not None:
        total, sizes, squares = total[order][:, order], sizes[order], squares[order]
    matrix, permutation = _symmetric_part(total), "MMD_AT_PLUS_A" if order is None else "NATURAL"
    shift, inverse = first_shift(matrix), 1.0 / np.sqrt(squares)
    for _ in range(ATTEMPTS):
        try:
            lu = symmetric_lu(_less_diagonal(matrix, shift * squares), permutation)
        except RuntimeError:  # exactly singular
            return 0
        pivots = lu.U.diagonal()
        if not np.array_equal(lu.perm_r, lu.perm_c) or not np.all(np.isfinite(pivots)):
            return 0
        added = (2 * len(parts) + 2) * UNIT_ROUND_OFF * (inverse * sizes + shift)
        error = float(np.max(_factorisation_error(lu, inverse) + added, initial=0.0))
        if error <= shift:
            return int(np.sum(pivots > 0.0))
        if not np.isfinite(error):
            return 0
        shift = 2.0 * error
    return 0


def _absolute_sums(part: SparseMatrix, weights: Array) -> Array:
    """½(|Q| + |Q|ᵀ)w (n,) for Q (n×n, CSC) and w (n,), without a matrix that costs more to make than to multiply."""
    n, sizes = part.shape[0], np.abs(part.data)
    columns = np.repeat(np.arange(n), np.diff(part.indptr))
    of_rows = np.bincount(part.indices, sizes * weights[columns], n)
    return np.asarray(0.5 * (of_rows + np.bincount(columns, sizes * weights[part.indices], n)))


def _symmetric_part(matrix: SparseMatrix) -> SparseMatrix:
    """½(M + Mᵀ) of M (n×n)."""
    mirrored = sp.csc_array(sp.csr_array(matrix))  # sorted
    transposed = sp.csc_array(mirrored.T)
    if not have_one_pattern(mirrored, transposed):
        return sp.csc_array(0.5 * (mirrored + transposed))
    mirrored.data = 0.5 * (mirrored.data + transposed.data)
    return mirrored


def _less_diagonal(matrix: SparseMatrix, squares: Array) -> SparseMatrix:
    """M − diag(s²) (n×n, CSC) for a sorted M."""
    places = np.flatnonzero(matrix.indices == np.repeat(np.arange(len(squares)), np.diff(matrix.indptr)))
    if len(places) < len(squares):
        return sp.csc_array(matrix - sp.diags_array(squares, format="csc"))
    result = matrix.copy()
    result.data[places] -= squares
    return result


def first_shift(matrix: SparseMatrix) -> float:
    """τ of the first attempt for a matrix (n×n)."""
    return FIRST_SHIFT * max(1.0, int(matrix.nnz) / (PLANE * max(int(matrix.shape[0]), 1)))


def _factorisation_error(lu: SuperLU, inverse: Array) -> Array:
    """Row sums (n,) of S⁻¹(γ|L||U| + |L||U − D Lᵀ|)S⁻¹ in the order of the matrix; `inverse` is 1/s (n,)."""
    back = np.argsort(lu.perm_c)  # row k of the factors is this unknown
    weights, sums = inverse[back], np.empty_like(inverse)
    sums[back] = weights * round_off_of_factors(lu, len(inverse), sp.csc_array((0, 0)), weights)
    return sums
