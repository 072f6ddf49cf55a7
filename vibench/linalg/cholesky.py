"""Cholesky factors of sparse symmetric positive definite matrices, whole and up to a dense Schur complement."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property
from math import sqrt
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.linalg.blas import dsyrk
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu, spsolve_triangular

from vibench.arrays import Array, Indices, SparseMatrix, read_only
from vibench.errors import NumericalError
from vibench.linalg import UNIT_ROUND_OFF
from vibench.linalg.definite import BlockDiagonal, Factor, FactoredElimination, dense_cholesky, mirrored


def symmetric_lu(matrix: SparseMatrix, order: str) -> SuperLU:
    """LU of a symmetric matrix (CSC) without off-diagonal pivoting; raises a `RuntimeError` if it is exactly singular.

    For a definite matrix it is a Cholesky factorisation; SciPy has no sparse one of its own.
    """
    # Above 32 nonzeros per row, as in elasticity in space, SuperLU is fastest with panels of 20 columns, below with 1.
    panel = 20 if matrix.nnz > 32 * matrix.shape[0] else 1
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, panel_size=panel, options={"SymmetricMode": True})


class OrderedFactor(ABC):
    """Factors L D Lᵀ of a sparse symmetric matrix (k×k), also an indefinite one, in its natural order.

    `pivots` (k,) are the diagonal of D. They are NaN where this order has none, and nothing can be solved then.
    """

    pivots: Array

    @abstractmethod
    def solve(self, right: Array) -> Array:
        """The solution for right-hand sides (k,) or (k, j)."""

    @abstractmethod
    def squares(self, functionals: Array) -> Array:
        """Values ℓᵀA⁻¹ℓ (j,) of functionals (n, j), A being the first n rows and columns."""


class OrderedLU(OrderedFactor):
    """Factors by SuperLU; raises a `RuntimeError` if the matrix (CSC) is exactly singular."""

    def __init__(self, matrix: SparseMatrix) -> None:
        self._lu = symmetric_lu(matrix, "NATURAL")
        natural = np.array_equal(self._lu.perm_r, np.arange(matrix.shape[0]))
        self.pivots = np.asarray(self._lu.U.diagonal()) if natural else np.full(matrix.shape[0], np.nan)

    def solve(self, right: Array) -> Array:
        return np.asarray(self._lu.solve(right))

    def squares(self, functionals: Array) -> Array:
        # The solution x, y for ℓ and zero splits ℓ = A x + Bᵀy, B x = 0, into parts that are orthogonal in A⁻¹. The
        # second one has the norm of y in B A⁻¹Bᵀ.
        n = len(functionals)
        solved = self._lu.solve(np.pad(functionals, ((0, len(self.pivots) - n), (0, 0))))
        corner = self._lu.L[:, n:].T @ solved
        return np.asarray(np.einsum("ik,ik->k", solved[:n], functionals) - self.pivots[n:] @ corner**2)


def few_at_once(solve: Callable[[Array], Array], right: Array) -> Array:
    """Solve for right-hand sides (n,) or (n, k), at most 32 at once, whose vectors stay in the cache."""
    if right.ndim == 1 or right.shape[1] <= 32:
        return np.asarray(solve(right))
    solved = np.empty(right.shape, order="F")
    for first in range(0, right.shape[1], 32):
        columns = slice(first, first + 32)
        solved[:, columns] = solve(np.asfortranarray(right[:, columns], dtype=float))
    return solved


class SparseCholesky(Factor):
    """X = FᵀF for a sparse symmetric positive definite X (n×n), without pivoting; its symmetry is not checked.

    F is upper triangular in the minimum degree `order`. Raises a `NumericalError` that calls X by `name` if X is not
    positive definite.
    """

    def __init__(self, matrix: SparseMatrix, name: str = "the matrix") -> None:
        matrix = sp.csc_array(matrix)
        self._arguments = matrix, name
        self._lu, pivots = _pivots(matrix, "MMD_AT_PLUS_A", name)
        self._root = read_only(np.sqrt(pivots))
        self.order: Indices = read_only(np.argsort(self._lu.perm_c))

    def __getstate__(self) -> dict[str, object]:
        return dict(zip(("matrix", "name"), self._arguments, strict=True))  # SuperLU objects cannot be stored

    def __setstate__(self, state: dict[str, Any]) -> None:
        SparseCholesky.__init__(self, **state)

    @property
    def nbytes(self) -> int:
        return 12 * int(self._lu.nnz)

    @cached_property
    def _lower(self) -> SparseMatrix:
        lower = sp.csc_array(self._lu.L)
        # Sort once here; every triangular solve would otherwise sort again.
        lower.sort_indices()
        return lower

    def solve(self, right: Array) -> Array:
        return few_at_once(self._lu.solve, np.ascontiguousarray(right))

    def apply_factor(self, u: Array) -> Array:
        return _scale_rows(self._root, self._lower.T @ u[self.order])

    def solve_factor(self, y: Array) -> Array:
        u = np.empty_like(y, dtype=float)
        if y.size:
            scaled = _scale_rows(1.0 / self._root, y)
            u[self.order] = _triangular_solutions(self._lower.T, scaled, lower=False)
        return u

    def solve_factor_transposed(self, right: Array) -> Array:
        permuted = np.ascontiguousarray(right[self.order])
        if not permuted.size:
            return permuted
        return _scale_rows(1.0 / self._root, _triangular_solutions(self._lower, permuted, lower=True))


class PartialCholesky(FactoredElimination):
    """A sparse symmetric positive definite X (n×n) with all unknowns eliminated but a few.

    With the eliminated unknowns i and the last ones c, the factors of [X_ii 0; X_ci I] without pivoting are those of
    X_ii, and L_ci with X_ci = L_ci D L_iiᵀ. Their last block has no fill-in: the Schur complement
    S = X_cc − L_ci D L_ciᵀ is a dense matrix of its own, and products and factors of it are those of LAPACK. A sparse
    factorisation of all of X would spend most of its time there.

    The `last` unknowns c of an elimination `order` (n,) are not eliminated. Raises a `NumericalError` if X_ii is not
    positive definite; an indefinite S is detected where it is factorised.
    """

    def __init__(self, matrix: SparseMatrix, order: Indices, last: int, name: str = "the matrix") -> None:
        self._arguments = matrix, order, last, name
        self.order, self._name, self._split = order, name, len(order) - last
        if not np.array_equal(order, np.arange(len(order))):
            matrix = sp.csr_array(matrix)[order][:, order]
        matrix, split = sp.csc_array(matrix), self._split
        self._coupling, self._corner = matrix[split:, :split], matrix[split:, split:]
        # With columns of the identity in place of the last ones SuperLU leaves the Schur complement alone.
        unit = sp.eye_array(len(order), last, k=-split)
        self._lu, pivots = _pivots(sp.csc_array(sp.hstack([matrix[:, :split], unit])), "NATURAL", name)
        self._root, self._bodies = np.sqrt(pivots[:split]), connected_components(matrix, directed=False)[1][split:]

    def __getstate__(self) -> dict[str, object]:
        return dict(zip(("matrix", "order", "last", "name"), self._arguments, strict=True))

    def __setstate__(self, state: dict[str, Any]) -> None:
        PartialCholesky.__init__(self, **state)

    @property
    def nbytes(self) -> int:
        return 12 * int(self._lu.nnz)  # a value of 8 bytes and an index of 4 per entry

    @cached_property
    def _columns(self) -> SparseMatrix:
        lower = sp.csc_array(self._lu.L)[:, : self._split]
        lower.sort_indices()
        return lower

    @cached_property
    def _coupling_factor(self) -> SparseMatrix:
        return self._columns[self._split :]  # L_ci

    @cached_property
    def _corner_factor(self) -> SparseMatrix:
        corner = sp.csc_array(self._columns[: self._split])
        corner.sort_indices()
        return corner.T  # L_iiᵀ

    def schur_blocks(self) -> BlockDiagonal:
        lower = sp.csc_array(self._lu.L)[self._split :, : self._split]
        lower.data *= np.repeat(self._root, np.diff(lower.indptr))
        blocks = []
        for body in np.unique(self._bodies):
            unknowns = np.flatnonzero(self._bodies == body)
            columns = sp.csc_array(lower if len(unknowns) == len(self._bodies) else lower[unknowns])
            columns.eliminate_zeros()
            blocks.append((unknowns, _less_products(self._corner[unknowns][:, unknowns], columns)))
        return BlockDiagonal(len(self._bodies), tuple(blocks))

    @cached_property
    def trailing_factor(self) -> Array:
        return dense_cholesky(self.schur_blocks().toarray(), self._name)

    def round_off(self, weights: Array) -> Array:
        """Bounds of the row sums Σ_j |X − P|_ij w_j (n,) with weights w (n,), both in elimination order.

        P is the matrix whose factors are exactly the computed L_ii, L_ci and D, with the computed S as its complement.
        """
        return round_off_of_factors(self._lu, self._split, self._corner, weights)

    def backward_errors(self, squares: Array) -> tuple[float, float]:
        inverse, count = 1.0 / np.sqrt(squares[self.order]), len(self.order)
        eliminated, columns = float(np.max(inverse * self.round_off(inverse), initial=0.0)), abs(self._columns)
        # k_i terms in column i of F, the entries of row i of L. Loads of the last unknowns are summed before their
        # solution: twice the terms.
        terms = np.bincount(columns.indices, minlength=count) + 8.0
        terms[self._split :] += count - self._split
        weights, trailing, squares = terms * inverse, np.abs(self.trailing_factor), self._root**2
        # With M = (k_i |F_ji| / S_i) the norm of M is at most the root of the largest entry of MᵀM x over x, for x > 0.
        x = np.ones(count)
        for _ in range(8):
            scaled = weights * x
            product = columns @ (squares * (columns.T @ scaled))
            product[self._split :] += trailing.T @ (trailing @ scaled[self._split :])
            largest, x = float(np.max(weights * product / x, initial=0.0)), weights * product
            x = np.maximum(x / np.max(x, initial=1e-300), 1e-3)
        return eliminated, 2.2 * UNIT_ROUND_OFF * sqrt(largest)

    def eliminate(self, right: Array) -> tuple[Array, Array]:
        solved = np.ascontiguousarray(right[self.order], dtype=float)
        # Contact forces load no eliminated unknown, and need no solution.
        loading = solved[: self._split].any(axis=0)
        if loading.any() and not loading.all():
            solved[:, loading] = few_at_once(self._lu.solve, np.ascontiguousarray(solved[:, loading]))
        elif loading.any():
            solved = few_at_once(self._lu.solve, solved)
        return solved[: self._split], solved[self._split :]

    def extend(self, last: Array) -> Array:
        right = np.zeros((len(self.order), *last.shape[1:]))
        right[: self._split] = -(self._coupling.T @ last)
        u = np.empty_like(right)
        if right.size:
            u[self.order] = few_at_once(self._lu.solve, right)
        u[self.order[self._split :]] = last
        return u

    def apply_factor(self, u: Array) -> Array:
        u = u[self.order]
        first = _scale_rows(self._root, self._columns.T @ u)
        return np.concatenate([first, self.trailing_factor @ u[self._split :]])

    def solve_factor(self, y: Array) -> Array:
        split, u = self._split, np.empty_like(y, dtype=float)
        last = y[split:]
        if last.size:
            last = scipy.linalg.solve_triangular(self.trailing_factor, last, check_finite=False)
        u[self.order[split:]] = last
        first = _scale_rows(1.0 / self._root, y[:split]) - self._coupling_factor.T @ last
        if first.size:
            u[self.order[:split]] = _triangular_solutions(self._corner_factor, first, lower=False)
        return u

    def solve_factor_transposed(self, right: Array) -> Array:
        right, split = np.ascontiguousarray(right[self.order], dtype=float), self._split
        first, last = right[:split], right[split:]
        if first.any():
            first = _scale_rows(1.0 / self._root, _triangular_solutions(self._corner_factor.T, first, lower=True))
            last = last - self._coupling_factor @ _scale_rows(self._root, first)
        if last.size:
            last = scipy.linalg.solve_triangular(self.trailing_factor, last, trans="T", check_finite=False)
        return np.concatenate([first, last])


def _less_products(corner: SparseMatrix, columns: SparseMatrix) -> Array:
    """X_cc − C Cᵀ (c×c) for a sparse C in which most columns have few entries, and some nearly all.

    Columns with at most 256 entries, and entries in at most an eighth of the rows, are multiplied as sparse ones,
    which needs few operations there.
    """
    entries, limit = np.diff(columns.indptr), min(256, columns.shape[0] / 8)
    few, many = columns[:, entries <= limit], np.flatnonzero(entries > limit)
    result, place = (corner - few @ few.T).toarray(order="F"), np.empty(len(entries) and corner.shape[0], np.intp)
    # Consecutive longer columns belong to neighbouring separators, and have entries in nearly the same rows: they are
    # multiplied as one dense matrix on these rows.
    for first in range(0, len(many), 256):
        block = columns[:, many[first : first + 256]]
        rows = np.unique(block.indices)
        place[rows] = np.arange(len(rows))
        dense = np.zeros((len(rows), block.shape[1]), order="F")
        dense[place[block.indices], np.repeat(np.arange(block.shape[1]), np.diff(block.indptr))] = block.data
        product = dsyrk(-1.0, dense, lower=True)
        if rows[-1] - rows[0] + 1 == len(rows):  # neighbours are added in place
            result[rows[0] : rows[-1] + 1, rows[0] : rows[-1] + 1] += product
        else:
            result[np.ix_(rows, rows)] += product
    return mirrored(result)


def _pivots(matrix: SparseMatrix, permutation: str, name: str) -> tuple[SuperLU, Array]:
    """Factors without pivoting off the diagonal, and the positive pivots (n,)."""
    try:
        lu = symmetric_lu(matrix, permutation)
    except RuntimeError as error:
        raise NumericalError(f"{name} cannot be factorised: {error}") from None
    pivots = lu.U.diagonal()
    # SuperLU exchanges rows where a diagonal pivot vanishes, even if it is told not to.
    if not np.array_equal(lu.perm_r, lu.perm_c) or not np.all(pivots > 0.0):
        raise NumericalError(f"{name} is not positive definite")
    if permutation == "NATURAL" and not np.array_equal(lu.perm_c, np.arange(len(pivots))):
        raise NumericalError(f"{name} was not factorised in the requested order")
    return lu, pivots


def round_off_of_factors(lu: SuperLU, split: int, corner: SparseMatrix, weights: Array) -> Array:
    """Bounds of the row sums Σ_j |X − P|_ij w_j (n,) with weights w (n,), both in elimination order.

    P has the first `split` columns L_i and pivots D of the computed factors exactly, and a computed Schur complement of
    X_cc, the `corner`: in the columns of i, |X − P| ≤ γ|L||U| + |L||U − D Lᵀ| (Higham 2002, Theorem 9.3). Where all
    columns are taken, P is L D Lᵀ.
    """
    # The rows of L are sorted so; the columns of U are rows of its transpose.
    lower, upper = lu.L.tocsr(), lu.U
    terms = int(np.max(np.diff(lower.indptr), initial=0)) + 8
    gamma, pivots = terms * UNIT_ROUND_OFF / (1.0 - terms * UNIT_ROUND_OFF), upper.diagonal()[:split]
    w_i, w_c = weights[:split], weights[split:]
    back = abs(lower[split:, :split]).T @ w_c
    inner, across = np.zeros(split), np.zeros(split)
    for few in _groups(upper.indptr[: split + 1]):
        product = _rows_of(lower, few, split)
        product.data = product.data * pivots[product.indices]
        mirrored = _rows_of(upper, few, split).tocsc().tocsr()  # sorted, which is a copy
        if have_one_pattern(mirrored, product):
            missing = sp.csr_array((mirrored.data - product.data, *_pattern(mirrored)), shape=mirrored.shape)
        else:
            # SuperLU drops an entry of one factor that happens to be zero, and the patterns differ.
            missing = mirrored - product
        for part in (mirrored, missing):
            np.abs(part.data, out=part.data)
        inner += gamma * (mirrored.T @ w_i[few]) + (1.0 + gamma) * (missing.T @ w_i[few])
        across[few] = gamma * (mirrored @ back) + (1.0 + gamma) * (missing @ back)
    np.abs(lower.data, out=lower.data)
    sums = lower @ np.concatenate([inner, np.zeros_like(w_c)])
    sums[:split] += across
    if len(w_c):
        sums[split:] += gamma * (abs(corner) @ w_c + lower[split:, :split] @ (np.abs(pivots) * back))
    return np.asarray(1.01 * sums)  # the factor covers the round-off in this bound itself


def have_one_pattern(first: SparseMatrix, second: SparseMatrix) -> bool:
    """Check whether two matrices of one format have their entries, in sorted order, at the same places."""
    return all(map(np.array_equal, _pattern(first), _pattern(second)))


def _pattern(matrix: SparseMatrix) -> tuple[Indices, Indices]:
    return matrix.indices, matrix.indptr


def _groups(pointers: Indices) -> Iterator[slice]:
    """Consecutive rows with about 2¹⁸ entries: many large arrays would take longer to allocate than to fill."""
    places = np.arange(2**18, int(pointers[-1]) + 2**18, 2**18)
    edges = np.unique(np.concatenate([[0], np.searchsorted(pointers[:-1], places), [len(pointers) - 1]]))
    return (slice(first, last) for first, last in itertools.pairwise(edges.tolist()))


def _rows_of(matrix: SparseMatrix, rows: slice, columns: int) -> SparseMatrix:
    """Some rows (CSR) of a matrix (CSR), or of the transpose of one (CSC), whose entries are in the first columns."""
    pointers = matrix.indptr[rows.start : rows.stop + 1]
    inside = slice(int(pointers[0]), int(pointers[-1]))
    entries = matrix.data[inside], matrix.indices[inside], pointers - pointers[0]
    return sp.csr_array(entries, shape=(rows.stop - rows.start, columns))


def _triangular_solutions(factor: SparseMatrix, right: Array, *, lower: bool) -> Array:
    return few_at_once(lambda r: spsolve_triangular(factor, r, lower=lower, unit_diagonal=True), right)


def _scale_rows(factors: Array, values: Array) -> Array:
    return np.asarray(factors * values if values.ndim == 1 else factors[:, None] * values)


def elimination_order(matrix: SparseMatrix, last: Indices) -> Indices:
    """Elimination order (n,) of an SPD matrix (n×n) with little fill-in: minimum degree, then `last` in its order."""
    matrix = sp.csc_array(matrix)
    rest = np.setdiff1d(np.arange(matrix.shape[0]), last)
    if not len(rest):
        return np.asarray(last)
    lu = symmetric_lu(sp.csc_array(matrix[rest][:, rest]), "MMD_AT_PLUS_A")
    return np.concatenate([rest[np.argsort(lu.perm_c)], last])
