"""Cholesky factors of sparse symmetric positive definite matrices, with a chosen elimination order."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu, spsolve_triangular

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError

SYMMETRIC = {"diag_pivot_thresh": 0.0, "panel_size": 1, "options": {"SymmetricMode": True}}
"""SuperLU without off-diagonal pivoting is a Cholesky factorisation; SciPy has no sparse one of its own. Panels of one
column are the fastest for matrices of plane meshes."""

FILL_RATIO = 8
"""A dense extension operator replaces triangular solves where it has at most this many times the entries of the sparse
factor: a dense product does far more operations in the same time than a sparse triangular solve."""


class SparseCholesky:
    """X = FᵀF for a sparse symmetric positive definite X (n×n), without pivoting off the diagonal.

    Parameters
    ----------
    matrix
        X; its symmetry is assumed and not checked.
    name
        Its name in error messages.
    order
        Elimination order (n,), from `elimination_order`; by default minimum degree.
    dense
        Size of the trailing block of F that is stored as a dense matrix.

    Attributes
    ----------
    order
        Unknowns in elimination order, in which F is upper triangular.

    Raises
    ------
    NumericalError
        If X is not positive definite.
    """

    def __init__(
        self, matrix: SparseMatrix, name: str = "the matrix", order: Indices | None = None, dense: int = 0
    ) -> None:
        matrix = sp.csc_array(matrix)
        self._arguments = matrix, name, order, dense
        if order is not None and not np.array_equal(order, np.arange(len(order))):
            matrix = sp.csc_array(matrix[order][:, order])
        try:
            lu = splu(matrix, permc_spec="MMD_AT_PLUS_A" if order is None else "NATURAL", **SYMMETRIC)
        except RuntimeError as error:
            raise NumericalError(f"{name} cannot be factorised: {error}") from None
        pivots = lu.U.diagonal()
        if not np.array_equal(lu.perm_r, lu.perm_c) or np.any(pivots <= 0.0):
            raise NumericalError(f"{name} is not positive definite")
        self._lu: SuperLU = lu
        self._root = np.sqrt(pivots)
        eliminated = np.argsort(lu.perm_c)
        if order is not None and not np.array_equal(eliminated, np.arange(len(order))):
            raise NumericalError(f"{name} was not factorised in the requested order")
        self._requested_order, self._split = order, matrix.shape[0] - dense
        self.order: Indices = eliminated if order is None else order

    def __getstate__(self) -> dict[str, object]:
        """What it was made of: SuperLU objects cannot be stored."""
        return dict(zip(("matrix", "name", "order", "dense"), self._arguments, strict=True))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Factorise again."""
        SparseCholesky.__init__(self, **state)

    @property
    def nbytes(self) -> int:
        """Memory of the factors: a value of 8 bytes and an index of 4 per entry."""
        return 12 * int(self._lu.nnz)

    @cached_property
    def _lower(self) -> SparseMatrix:
        lower = sp.csc_array(self._lu.L)
        lower.sort_indices()  # here once; a triangular solve would sort every time
        return lower

    @cached_property
    def _blocks(self) -> tuple[SparseMatrix, SparseMatrix, Array]:
        """Leading and coupling block of the unit lower factor, transposed, and the dense trailing block of F."""
        split = self._split
        if split == len(self._root):
            return self._lower.T, sp.csc_array((split, 0)), np.zeros((0, 0))
        first = sp.csc_array(self._lower[:, :split])
        corner, coupling = sp.csc_array(first[:split]), sp.csc_array(first[split:])
        corner.sort_indices()
        return corner.T, coupling.T, np.asfortranarray(self.trailing_factor())

    def solve(self, right: Array) -> Array:
        """X⁻¹ r for right-hand sides (n,) or (n, k)."""
        if self._requested_order is None:
            return np.asarray(self._lu.solve(np.ascontiguousarray(right)))
        x = np.empty_like(right, dtype=float)
        x[self._requested_order] = self._lu.solve(np.ascontiguousarray(right[self._requested_order]))
        return x

    def apply_factor(self, u: Array) -> Array:
        """F u, for u (n,) or (n, k)."""
        return _scale_rows(self._root, self._lower.T @ u[self.order])

    def solve_factor(self, y: Array) -> Array:
        """F⁻¹ y, for y (n,) or (n, k)."""
        split, u = self._split, np.empty_like(y, dtype=float)
        corner, coupling, tail = self._blocks
        last = scipy.linalg.solve_triangular(tail, y[split:], check_finite=False) if len(tail) else y[split:]
        u[self.order[split:]] = last
        first = _scale_rows(1.0 / self._root[:split], y[:split]) - coupling @ last
        if first.size:
            u[self.order[:split]] = spsolve_triangular(corner, first, lower=False, unit_diagonal=True)
        return u

    def extend(self, last: Array) -> Array:
        """Solution (n,) or (n, k) of X u = 0 in all rows but the last `dense` ones, with u given there."""
        split, u = self._split, np.zeros((len(self._root), *last.shape[1:]))
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
        """Unknowns (c,) among the last `dense` ones that couple to others, and the extension from them, or `None`."""
        corner, coupling, _ = self._blocks
        where = np.unique(coupling.indices)
        if self._split * len(where) > FILL_RATIO * (corner.nnz + coupling.nnz):
            return where, None
        right = -coupling[:, where].toarray()
        return where, spsolve_triangular(corner, right, lower=False, unit_diagonal=True)

    def solve_factor_transposed(self, right: Array) -> Array:
        """F⁻ᵀ r, for r (n,) or (n, k)."""
        permuted = np.ascontiguousarray(right[self.order])
        if not permuted.size:
            return permuted
        return _scale_rows(1.0 / self._root, spsolve_triangular(self._lower, permuted, lower=True, unit_diagonal=True))

    def trailing_factor(self) -> Array:
        """The trailing block F_cc of F on the last `dense` unknowns c; F_ccᵀF_cc is the Schur complement of X on c."""
        block = sp.csc_array(self._lu.L)[:, self._split :][self._split :].toarray()
        return np.asarray((block * self._root[self._split :]).T)


def _scale_rows(factors: Array, values: Array) -> Array:
    return np.asarray(factors * values if values.ndim == 1 else factors[:, None] * values)


def elimination_order(matrix: SparseMatrix, last: Indices) -> Indices:
    """Elimination order (n,) of an SPD matrix (n×n) with little fill-in: minimum degree, then `last` in its order."""
    matrix = sp.csc_array(matrix)
    rest = np.setdiff1d(np.arange(matrix.shape[0]), last)
    if not len(rest):
        return np.asarray(last)
    lu = splu(sp.csc_array(matrix[rest][:, rest]), permc_spec="MMD_AT_PLUS_A", **SYMMETRIC)
    return np.concatenate([rest[np.argsort(lu.perm_c)], last])
