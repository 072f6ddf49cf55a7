"""Proofs, in floating-point arithmetic, that sparse symmetric matrices are definite or have positive eigenvalues.

Let Q = Q₁ + … + Q_p be symmetric and S = diag(s) > 0. The factorisation LU ≈ M of the computed M ≈ Q − τS² without
off-diagonal pivoting gives P = L D Lᵀ, D = diag(U), which has exactly as many positive eigenvalues as D has positive
entries (Sylvester), whatever the round-off. With the unit round-off u, k terms at most in an inner product of the
factorisation and γ_k = ku/(1 − ku),

    |M − P| ≤ γ_k |L||U| + |L||U − D Lᵀ|    (Higham 2002, Theorem 9.3),    |Q − τS² − M| ≤ (p + 1)u (Σ|Q_i| + τS²).

With Δ the sum of both, −δS² ≼ Q − τS² − P ≼ δS² for the largest row sum δ of S⁻¹ΔS⁻¹, which takes products of sparse
matrices with one vector. If δ ≤ τ, then Q ≽ P, and Q has at least as many positive eigenvalues as P (Weyl). This is
Rump's verification of positive definiteness (BIT Numerical Mathematics 46, 2006) for any inertia, with a bound of the
round-off that is computed instead of estimated beforehand. It assumes that nothing under- or overflows.

A definite matrix with a narrow band, as of a mesh in the plane with a few thousand nodes, is proved to be definite in a
fourth of the time: LAPACK factorises the band before a sparse method has ordered the unknowns.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from functools import lru_cache, reduce

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpbtrf
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import SuperLU

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg import UNIT_ROUND_OFF
from vibench.linalg.cholesky import have_one_pattern, round_off_of_factors, symmetric_lu
from vibench.linalg.definite import checked
from vibench.linalg.factorisations import DEFAULT, Implementation


def is_proved_definite(parts: Sequence[SparseMatrix], chosen: Implementation, order: Indices | None = None) -> bool:
    """Prove that a sum of symmetric matrices (n×n) is positive definite, whatever the round-off.

    By default a narrow band is factorised, or the inertia is computed, with SuperLU in an `order` (n,) if given. Other
    implementations are only known to compute a Cholesky factorisation. If it succeeds for the computed D⁻¹XD⁻¹ − cI,
    D² being the diagonal of X, then X is definite. Here c is the sum of the round-off of summing and scaling and of the
    factorisation, Σ_j γ / (1 − γ) with γ_k of k = t_j + 1 and t_j entries in column j of the factor (Rump 2006, §2).
    Iterations prove nothing.
    """
    if chosen.is_iterative:
        return False
    if chosen.name == DEFAULT:
        if (proved := _proved_by_band(parts)) is not None:
            return proved
        diagonal = np.asarray(sum(part.diagonal() for part in parts))
        return bool(np.all(diagonal > 0.0)) and proved_positive(parts, np.sqrt(diagonal), order) == len(diagonal)
    try:
        matrix = checked(sum(sp.csc_array(part) for part in parts), "")
        scale = sp.diags_array(1.0 / np.sqrt(matrix.diagonal()), format="csc")
        sizes = scale @ sum(abs(sp.csc_array(part)) for part in parts) @ scale
        scaled = sp.csc_array(scale @ (0.5 * (matrix + matrix.T)) @ scale)
        rounded = (8.0 + 2.0 * len(parts)) * UNIT_ROUND_OFF * float(np.max(sizes.sum(axis=0), initial=0.0))
        shift, identity = _first_shift(scaled), sp.eye_array(matrix.shape[0], format="csc")
        for _ in range(3):
            factor = chosen.factorise(sp.csc_array(scaled - shift * identity), "")
            error = 1.01 * (2.0 * UNIT_ROUND_OFF * (factor.entries(matrix.shape[0]) + matrix.shape[0]) + rounded)
            if error <= shift:
                return True
            # A larger shift changes the factor, and its number of entries, hardly at all.
            shift = 1.01 * error
    except NumericalError:
        pass
    return False


def _proved_by_band(parts: Sequence[SparseMatrix]) -> bool | None:
    """Prove by a banded Cholesky factorisation that a sum of matrices (n×n) is definite; `None` if its band is wide.

    As for Cholesky factors of other implementations, c being the sum of the round-off of summing and scaling and of the
    factorisation, with k = b + 2 in each of the n columns for b diagonals beside the main one.
    """
    # Use the transpose of CSC matrices: the symmetric part is the same and a conversion would cost more than the proof.
    rows = [part.T if part.format == "csc" else sp.csr_array(part) for part in parts]
    total = sp.csr_array(reduce(operator.add, rows)).sorted_indices()
    magnitude = reduce(operator.add, [abs(part) for part in rows])
    diagonal, size = total.diagonal(), total.shape[0]
    if not np.all(np.isfinite(total.data)) or not np.all(diagonal > 0.0):
        return False
    places = _band_places(total.indptr.tobytes(), total.indices.tobytes(), total.indices.dtype.str)
    if places is None:  # the pattern is not symmetric
        total = sp.csr_array(0.5 * (total + total.T)).sorted_indices()
        places = _band_places(total.indptr.tobytes(), total.indices.tobytes(), total.indices.dtype.str)
        assert places is not None
    width, lower, upper, row, column, place = places
    # Above this number n b² of multiplications a sparse factorisation is as fast.
    if size * float(width) ** 2 > 1.5e8:
        return None
    units = 1.0 / np.sqrt(diagonal)
    band = np.zeros((size, width + 1))
    band.ravel()[place] = units[row] * (0.5 * (total.data[lower] + total.data[upper])) * units[column]
    sizes = units * (magnitude @ units + magnitude.T @ units) / 2.0
    terms = (width + 2) * UNIT_ROUND_OFF
    error = (8.0 + 2.0 * len(parts)) * UNIT_ROUND_OFF * float(np.max(sizes, initial=0.0))
    error += size * terms / (1.0 - 2.0 * terms)
    band[:, 0] -= 1.01 * error
    return bool(dpbtrf(band.T, lower=1, overwrite_ab=1)[1] == 0)


_Places = tuple[int, Indices, Indices, Indices, Indices, Indices]


@lru_cache(maxsize=2)  # the same few sparsity patterns recur
def _band_places(pointers: bytes, indices: bytes, kind: str) -> _Places | None:
    """Band of a sorted pattern (n×n, CSR) in the order of Cuthill and McKee; `None` if the pattern is not symmetric.

    The pattern is given as bytes of index arrays of a kind. The result is the number b of diagonals beside the main
    one, and, for the entries in the lower half of the band, their positions among all entries, the positions of the
    entries opposite the diagonal, rows, columns, and places in an array (n, b+1).
    """
    starts, columns = np.frombuffer(pointers, kind), np.frombuffer(indices, kind)
    size = len(starts) - 1
    pattern = sp.csr_array((np.arange(len(columns)), columns, starts), shape=(size, size))
    transposed = pattern.T.tocsr()
    if not (np.array_equal(transposed.indptr, starts) and np.array_equal(transposed.indices, columns)):
        return None
    order = np.empty(size, np.intp)
    order[reverse_cuthill_mckee(pattern, symmetric_mode=True)] = np.arange(size)
    rows = np.repeat(np.arange(size), np.diff(starts))
    below = order[rows] - order[columns]
    width, lower = int(below.max(initial=0)), np.flatnonzero(below >= 0)
    rows, columns = rows[lower], columns[lower]
    return width, lower, transposed.data[lower], rows, columns, below[lower] + (width + 1) * order[columns]


def proved_positive(parts: Sequence[SparseMatrix], scale: Array, order: Indices | None = None) -> int:
    """Number of positive eigenvalues that a sum of symmetric parts (n×n) has at least; 0 where nothing is proved.

    `scale` is s > 0 (n,), the roots of typical diagonal entries: the proof needs eigenvalues of S⁻¹QS⁻¹ away from
    round-off. The elimination `order` (n,) is minimum degree by default.
    """
    columns = [sp.csc_array(part) for part in parts]
    if not all(np.all(np.isfinite(part.data)) for part in columns):
        return 0
    sizes, squares = np.sum([_absolute_sums(part, 1.0 / scale) for part in columns], axis=0), scale**2
    total = columns[0] if len(columns) == 1 else reduce(operator.add, columns)
    if order is not None:
        total, sizes, squares = total[order][:, order], sizes[order], squares[order]
    matrix, permutation = _symmetric_part(total), "MMD_AT_PLUS_A" if order is None else "NATURAL"
    shift, inverse = _first_shift(matrix), 1.0 / np.sqrt(squares)
    for _ in range(3):
        try:
            lu = symmetric_lu(_less_diagonal(matrix, shift * squares), permutation)
        except RuntimeError:  # exactly singular
            return 0
        pivots = lu.U.diagonal()
        # With rows exchanged the factors are not L D Lᵀ, and Sylvester's law says nothing.
        if not np.array_equal(lu.perm_r, lu.perm_c) or not np.all(np.isfinite(pivots)):
            return 0
        added = (2 * len(parts) + 2) * UNIT_ROUND_OFF * (inverse * sizes + shift)
        error = float(np.max(_factorisation_error(lu, inverse) + added, initial=0.0))
        if error <= shift:
            return int(np.sum(pivots > 0.0))
        if not np.isfinite(error):
            return 0
        # The next factorisation has about the same round-off. Factors of a mesh in space take gigabytes: one at a time.
        shift = 2.0 * error
        del lu
    return 0


def _absolute_sums(part: SparseMatrix, weights: Array) -> Array:
    """Sums ½(|Q| + |Q|ᵀ)w (n,) for Q (n×n, CSC) and w (n,), without forming a matrix."""
    n, sizes = part.shape[0], np.abs(part.data)
    columns = np.repeat(np.arange(n), np.diff(part.indptr))
    of_rows = np.bincount(part.indices, sizes * weights[columns], n)
    return np.asarray(0.5 * (of_rows + np.bincount(columns, sizes * weights[part.indices], n)))


def _symmetric_part(matrix: SparseMatrix) -> SparseMatrix:
    mirrored = sp.csc_array(sp.csr_array(matrix))  # sorted
    transposed = sp.csc_array(mirrored.T)
    if not have_one_pattern(mirrored, transposed):
        return sp.csc_array(0.5 * (mirrored + transposed))
    mirrored.data = 0.5 * (mirrored.data + transposed.data)
    return mirrored


def _less_diagonal(matrix: SparseMatrix, squares: Array) -> SparseMatrix:
    """Difference M − diag(s²) (n×n, CSC) for a sorted M."""
    places = np.flatnonzero(matrix.indices == np.repeat(np.arange(len(squares)), np.diff(matrix.indptr)))
    if len(places) < len(squares):
        return sp.csc_array(matrix - sp.diags_array(squares, format="csc"))
    result = matrix.copy()
    result.data[places] -= squares
    return result


def _first_shift(matrix: SparseMatrix) -> float:
    # This is well above the round-off of factors of a few thousand unknowns. Factors of meshes in space, with more than
    # 16 entries in a row, have longer sums.
    return 1e-11 * max(1.0, int(matrix.nnz) / (16.0 * max(int(matrix.shape[0]), 1)))


def _factorisation_error(lu: SuperLU, inverse: Array) -> Array:
    """Row sums (n,) of S⁻¹(γ|L||U| + |L||U − D Lᵀ|)S⁻¹ in the order of the matrix; `inverse` is 1/s (n,)."""
    back = np.argsort(lu.perm_c)  # row k of the factors is this unknown
    weights, sums = inverse[back], np.empty_like(inverse)
    sums[back] = weights * round_off_of_factors(lu, len(inverse), sp.csc_array((0, 0)), weights)
    return sums
