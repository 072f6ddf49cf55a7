"""Sparse symmetric positive definite matrices, factorised in an order of one's own choice."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu, spsolve_triangular

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError

_SYMMETRIC = {"diag_pivot_thresh": 0.0, "panel_size": 1, "options": {"SymmetricMode": True}}
"""No pivoting off the diagonal; panels of one column are the fastest for the matrices of plane meshes."""

DENSER = 8
"""What follows from the last unknowns comes from a full matrix where it has no more than this many times the entries of
the sparse factor: a product does far more operations in the same time than a triangular solve."""


class SparseCholesky:
    """X = FᵀF for a sparse symmetric positive definite X (n×n), without pivoting off the diagonal.

    Parameters
    ----------
    matrix
        X; only its symmetry is taken for granted.
    name
        What to call it when it is refused.
    order
        Elimination order (n,), as `elimination_order` gives it; by default minimum degree.
    dense
        How many of the unknowns eliminated last couple to each other almost all: F is taken for full there.

    Attributes
    ----------
    order
        Unknowns in the order of their elimination, in which F is upper triangular.

    Raises
    ------
    NumericalError
        If X is not positive definite.
    """

    def __init__(
        self, matrix: SparseMatrix, name: str = "the matrix", order: Indices | None = None, dense: int = 0
    ) -> None:
        matrix = sp.csc_array(matrix)
        self._made_from = matrix, name, order, dense
        if order is not None and not np.array_equal(order, np.arange(len(order))):
            matrix = sp.csc_array(matrix[order][:, order])
        try:
            lu = splu(matrix, permc_spec="MMD_AT_PLUS_A" if order is None else "NATURAL", **_SYMMETRIC)
        except RuntimeError as error:
            raise NumericalError(f"{name} cannot be factorised: {error}") from None
        pivots = lu.U.diagonal()
        if not np.array_equal(lu.perm_r, lu.perm_c) or np.any(pivots <= 0.0):
            raise NumericalError(f"{name} is not positive definite")
        self._lu: SuperLU = lu
        self._root = np.sqrt(pivots)
        eliminated = np.argsort(lu.perm_c)
        if order is not None and not np.array_equal(eliminated, np.arange(len(order))):
            raise NumericalError(f"{name} was factorised in another order than asked for")  # SuperLU promises not to
        self._given, self._sparse = order, matrix.shape[0] - dense
        self.order: Indices = eliminated if order is None else order

    def __reduce__(self) -> tuple[type[SparseCholesky], tuple[SparseMatrix, str, Indices | None, int]]:
        """Factorise anew where it is unpickled: SuperLU objects do not travel."""
        return SparseCholesky, self._made_from

    @cached_property
    def _lower(self) -> SparseMatrix:
        lower = sp.csc_array(self._lu.L)
        lower.sort_indices()  # once, not at every triangular solve
        return lower

    @cached_property
    def _blocks(self) -> tuple[SparseMatrix, SparseMatrix, Array]:
        """Transposes of the lower factor's sparse blocks, that of the first unknowns and the coupling; dense F."""
        split = self._sparse
        if split == len(self._root):
            return self._lower.T, sp.csc_array((split, 0)), np.zeros((0, 0))
        first = sp.csc_array(self._lower[:, :split])
        corner, coupling = sp.csc_array(first[:split]), sp.csc_array(first[split:])
        corner.sort_indices()
        return corner.T, coupling.T, np.asfortranarray(self.tail(len(self._root) - split))

    def solve(self, right: Array) -> Array:
        """X⁻¹ r for right-hand sides (n,) or (n, k)."""
        if self._given is None:
            return np.asarray(self._lu.solve(np.ascontiguousarray(right)))
        found = np.empty_like(right, dtype=float)
        found[self._given] = self._lu.solve(np.ascontiguousarray(right[self._given]))
        return found

    def up(self, u: Array) -> Array:
        """F u, for u (n,) or (n, k)."""
        return _rows(self._root, self._lower.T @ u[self.order])

    def up_inverse(self, y: Array) -> Array:
        """F⁻¹ y, for y (n,) or (n, k)."""
        split, u = self._sparse, np.empty_like(y, dtype=float)
        corner, coupling, tail = self._blocks
        last = scipy.linalg.solve_triangular(tail, y[split:], check_finite=False) if len(tail) else y[split:]
        u[self.order[split:]] = last
        first = _rows(1.0 / self._root[:split], y[:split]) - coupling @ last
        if first.size:
            u[self.order[:split]] = spsolve_triangular(corner, first, lower=False, unit_diagonal=True)
        return u

    def extend(self, last: Array) -> Array:
        """Solution (n,) or (n, k) of X u = 0 in all rows but those of the `dense` unknowns, where u is given."""
        split, u = self._sparse, np.zeros((len(self._root), *last.shape[1:]))
        corner, coupling, _ = self._blocks
        u[self.order[split:]] = last
        if split and last.size:
            where, extension = self._extension
            u[self.order[:split]] = (
                spsolve_triangular(corner, -(coupling @ last), lower=False, unit_diagonal=True)
                if extension is None
                else extension @ last[where]
            )
        return u

    @cached_property
    def _extension(self) -> tuple[Indices, Array | None]:
        """The `dense` unknowns that others depend on (c,), and how these follow; `None` where to solve is cheaper."""
        corner, coupling, _ = self._blocks
        where = np.unique(coupling.indices)
        if self._sparse * len(where) > DENSER * (corner.nnz + coupling.nnz):
            return where, None
        right = -coupling[:, where].toarray()
        return where, spsolve_triangular(corner, right, lower=False, unit_diagonal=True)

    def down_inverse(self, right: Array) -> Array:
        """F⁻ᵀ r, for r (n,) or (n, k)."""
        permuted = np.ascontiguousarray(right[self.order])
        if not permuted.size:
            return permuted
        return _rows(1.0 / self._root, spsolve_triangular(self._lower, permuted, lower=True, unit_diagonal=True))

    def tail(self, count: int) -> Array:
        """The last block F_cc (count×count) of F, in the order of elimination: a factor of the Schur complement.

        With c the last `count` unknowns, F_ccᵀF_cc is X_cc minus what the elimination of all others takes from it.
        """
        first = len(self._root) - count
        block = sp.csc_array(self._lu.L)[:, first:][first:].toarray()
        return np.asarray((block * self._root[first:]).T)


def _rows(factors: Array, values: Array) -> Array:
    return np.asarray(factors * values if values.ndim == 1 else factors[:, None] * values)


def elimination_order(matrix: SparseMatrix, last: Indices) -> Indices:
    """Order of elimination with little fill-in (minimum degree) that ends with some unknowns, in their order.

    Parameters
    ----------
    matrix
        A symmetric positive definite matrix (n×n) with the sparsity pattern in question.
    last
        Unknowns that come last.
    """
    matrix = sp.csc_array(matrix)
    rest = np.setdiff1d(np.arange(matrix.shape[0]), last)
    if not len(rest):
        return np.asarray(last)
    lu = splu(sp.csc_array(matrix[rest][:, rest]), permc_spec="MMD_AT_PLUS_A", **_SYMMETRIC)
    return np.concatenate([rest[np.argsort(lu.perm_c)], last])
