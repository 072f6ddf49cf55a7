"""Symmetric positive definite matrices: dense ones, with a block for each body, and the interface of sparse factors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.linalg.lapack import dpotri

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError

# Dense work on at most so many unknowns costs less than to determine which of them it can do without.
MANY_UNKNOWNS = 1500


@dataclass(frozen=True)
class BlockDiagonal:
    """A matrix (c×c), c being its `size`, that is zero between disjoint sets of unknowns.

    `blocks` are the sets (k,), rising, which cover all unknowns, and the blocks (k×k) of the matrix there.
    """

    size: int
    blocks: tuple[tuple[Indices, Array], ...]

    @classmethod
    def of(cls, matrix: Array) -> BlockDiagonal:
        """Find the blocks of a symmetric matrix (c×c)."""
        sets = connected_blocks(matrix)
        if len(sets) == 1:
            return cls(len(matrix), ((sets[0], matrix),))
        return cls(len(matrix), tuple((block, matrix[np.ix_(block, block)]) for block in sets))

    def __len__(self) -> int:
        return self.size

    def __matmul__(self, values: Array) -> Array:
        if len(self.blocks) == 1:
            return np.asarray(self.blocks[0][1] @ values)
        product = np.empty((self.size, *values.shape[1:]))
        for unknowns, block in self.blocks:
            product[unknowns] = block @ values[unknowns]
        return product

    def times_sparse(self, values: Array) -> Array:
        """The product X v for a symmetric X and values (c,) or (c, k), most rows of which may be zero."""
        product = np.zeros((self.size, *values.shape[1:]))
        for unknowns, block in self.blocks:
            part = values[unknowns]
            acting = np.flatnonzero(part if part.ndim == 1 else part.any(axis=1))
            # The rows are copied, and all of them would take longer to copy than to multiply.
            few = 4 * len(acting) < len(unknowns)
            product[unknowns] = block[acting].T @ part[acting] if few else block @ part
        return product

    def toarray(self) -> Array:
        if len(self.blocks) == 1:
            return self.blocks[0][1]
        matrix = np.zeros((self.size, self.size))
        for unknowns, block in self.blocks:
            matrix[np.ix_(unknowns, unknowns)] = block
        return matrix

    def congruent(self, rows: SparseMatrix) -> Array:
        """The product R X Rᵀ (k×k) for a sparse R (k×c)."""
        rows = rows if rows.format == "csr" else sp.csr_array(rows)
        total = np.zeros((rows.shape[0], rows.shape[0]))
        for unknowns, block in self.blocks:
            # Neighbouring columns, as those of a body, are extracted much faster by a slice.
            neighbours = len(unknowns) and unknowns[-1] - unknowns[0] + 1 == len(unknowns)
            columns = slice(unknowns[0], unknowns[-1] + 1) if neighbours else unknowns
            part, compliance = rows if len(self.blocks) == 1 else rows[:, columns], block
            # Rows touch a short range of unknowns where these are numbered along the contact. SciPy copies slices of
            # dense matrices, which pays only for a short range of many.
            if len(unknowns) > 512 and part.nnz:
                along = slice(int(part.indices.min()), int(part.indices.max()) + 1)
                if 2 * (along.stop - along.start) < len(unknowns):
                    shape = part.shape[0], along.stop - along.start
                    part = sp.csr_array((part.data, part.indices - along.start, part.indptr), shape=shape)
                    compliance = block[along, along]
            total += part @ np.ascontiguousarray((part @ compliance).T)
        return total

    def cholesky(self, name: str) -> BlockDiagonal:
        """The upper triangular F with FᵀF = X.

        Raises a `NumericalError` that calls X by `name` if X is not positive definite.
        """
        return self._by_blocks(name, lambda block: np.asarray(scipy.linalg.cholesky(block)))

    def inverse(self, name: str, overwrite: bool = False) -> BlockDiagonal:
        """The inverse X⁻¹ of a definite X, which may be overwritten; raises as `cholesky` does."""
        return self._by_blocks(name, partial(_inverse, overwrite=overwrite))

    def solve_triangular(self, right: Array, transposed: bool = False) -> Array:
        """The solution F⁻¹ r, or F⁻ᵀ r, for an upper triangular F and r (c,) or (c, k)."""
        solution, trans = np.empty_like(right, dtype=float), "T" if transposed else "N"
        for unknowns, block in self.blocks:
            part = right[unknowns]
            solution[unknowns] = scipy.linalg.solve_triangular(block, part, trans=trans, check_finite=False)
        return solution

    def _by_blocks(self, name: str, function: Callable[[Array], Array]) -> BlockDiagonal:
        try:
            return BlockDiagonal(self.size, tuple((unknowns, function(block)) for unknowns, block in self.blocks))
        except (np.linalg.LinAlgError, ValueError):  # a pivot is not positive, an entry not finite
            raise NumericalError(f"{name} is not positive definite") from None


def dense_cholesky(matrix: Array, name: str) -> Array:
    """The upper triangular F (c×c) with FᵀF = X, block by block; raises as `BlockDiagonal.cholesky` does."""
    return BlockDiagonal.of(matrix).cholesky(name).toarray()


def dense_inverse(matrix: Array, name: str) -> Array:
    """The inverse of a symmetric positive definite X (c×c), which is overwritten; raises likewise."""
    return BlockDiagonal.of(matrix).inverse(name, overwrite=True).toarray()


def connected_blocks(matrix: Array) -> list[Indices]:
    """The sets of unknowns of a symmetric matrix (c×c) between which all entries are zero."""
    blocks, left = [], np.ones(len(matrix), bool)
    while left.any():
        block = np.zeros_like(left)
        reached = np.flatnonzero(left)[:1]
        while len(reached):
            block[reached] = True
            reached = np.flatnonzero((matrix[reached] != 0.0).any(axis=0) & ~block)
        left &= ~block
        blocks.append(np.flatnonzero(block))
    return blocks


def mirrored(lower: Array) -> Array:
    """The symmetric matrix (c×c) of this lower triangle, in place: a second array of this size may not fit."""
    for first in range(0, len(lower), 64):
        last = first + 64
        corner = np.tril(lower[first:last, first:last])
        lower[first:last, first:last] = corner + np.tril(corner, -1).T
        lower[first:last, last:] = lower[last:, first:last].T
    return lower


def _inverse(block: Array, overwrite: bool) -> Array:
    # The transpose has LAPACK's order of columns. The result is stored row by row: sparse products would copy columns.
    factor = scipy.linalg.cholesky(block.T, lower=True, overwrite_a=overwrite)
    return mirrored(np.asarray(dpotri(factor, lower=True, overwrite_c=True)[0])).T


class Factor(ABC):
    """A factor of a sparse symmetric positive definite X (n×n)."""

    @abstractmethod
    def solve(self, right: Array) -> Array:
        """The solution X⁻¹ r for right-hand sides (n,) or (n, k)."""

    def entries(self, n: int) -> float:
        """Upper bound of the number of entries of the triangular factor of a matrix (n×n)."""
        return n * (n + 1.0) / 2.0


class Elimination(ABC):
    """A sparse symmetric positive definite X (n×n) of which all unknowns i but the last ones c are eliminated."""

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Memory of the factors."""

    @abstractmethod
    def schur_blocks(self) -> BlockDiagonal:
        """The Schur complement S = X_cc − X_ci X_ii⁻¹ X_ic (c×c), body by body."""

    @abstractmethod
    def eliminate(self, right: Array) -> tuple[Array, Array]:
        """The solution X_ii⁻¹ r_i and the load of the Schur complement, r_c − X_ci X_ii⁻¹ r_i, for r (n,) or (n, k)."""

    @abstractmethod
    def extend(self, last: Array) -> Array:
        """Solution (n,) or (n, k) of X u = 0 in the rows of i, with u (c,) or (c, k) given on the last unknowns."""


class FactoredElimination(Elimination):
    """An elimination with a factor F of X = FᵀF, upper triangular in an order that ends with the last unknowns."""

    @property
    @abstractmethod
    def trailing_factor(self) -> Array:
        """The trailing block F_cc (c×c) of F, upper triangular, with F_ccᵀF_cc = S.

        Raises a `NumericalError` if S, and with it X, is not positive definite.
        """

    @abstractmethod
    def apply_factor(self, u: Array) -> Array:
        """The product F u for u (n,) or (n, k): first the entries of i."""

    @abstractmethod
    def solve_factor_transposed(self, right: Array) -> Array:
        """The solution F⁻ᵀ r for r (n,) or (n, k); a load on the last unknowns has nonzeros only there."""

    @abstractmethod
    def backward_errors(self, squares: Array) -> tuple[float, float]:
        """Bounds δ and τ of round-off in units of S² = diag(X), `squares` (n,) (Higham 2002, §8.1 and 10.1).

        X differs by a matrix between ±δS² from one whose exact factors are the computed ones of the eliminated unknowns
        and whose exact Schur complement is the computed one. Of y = F⁻ᵀt as it is computed, |S⁻¹(t − Fᵀy)| ≤ τ|y|.
        """


def checked(matrix: SparseMatrix, name: str) -> SparseMatrix:
    """Return the matrix (CSC); raises a `NumericalError` if an entry is not finite, or a diagonal one not positive."""
    matrix = sp.csc_array(matrix)
    if not np.all(np.isfinite(matrix.data)):
        raise NumericalError(f"{name} has entries that are not finite")
    if not np.all(matrix.diagonal() > 0.0):
        raise NumericalError(f"{name} is not positive definite")
    return matrix
