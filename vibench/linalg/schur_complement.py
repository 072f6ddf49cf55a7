"""Systems with a sparse stiffness condensed on the few unknowns that constraints touch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.linalg.cholesky import SparseCholesky, elimination_order


@dataclass(frozen=True)
class Pattern:
    """Which unknowns are kept and how the others are eliminated; the same for all matrices of one sparsity pattern.

    Attributes
    ----------
    kept
        Unknowns c to condense on, rising.
    order
        Elimination order of all others, followed by the interface: the kept ones that couple to others.
    interface
        Where the interface is among the kept ones.
    """

    kept: Indices
    order: Indices
    interface: Indices

    @cached_property
    def eliminated(self) -> Submatrix:
        """What is factorised: all in `order`."""
        return Submatrix(self.order)

    @cached_property
    def kept_block(self) -> Submatrix:
        """The kept ones among themselves."""
        return Submatrix(self.kept)

    @classmethod
    def of(cls, A: SparseMatrix, kept: Indices) -> Pattern:
        """Pattern for matrices with the sparsity of A (n×n), symmetric positive definite."""
        others = np.setdiff1d(np.arange(A.shape[0]), kept)
        interface = np.unique(sp.csr_array(A)[others][:, kept].indices)
        inside = np.union1d(others, kept[interface])
        order = elimination_order(sp.csr_array(A)[inside][:, inside], np.searchsorted(inside, kept[interface]))
        return cls(kept, inside[order], interface)


class Submatrix:
    """Some rows and columns of square matrices; where one has the sparsity of the last, its entries are only copied.

    Parameters
    ----------
    chosen
        Which, in the order in which they are wanted.
    """

    def __init__(self, chosen: Indices) -> None:
        self._chosen = chosen
        self._known: tuple[Indices, Indices] | None = None

    def of(self, A: SparseMatrix) -> SparseMatrix:
        """Those of A (CSR)."""
        places = A.indptr, A.indices
        if self._known is None or not all(map(np.array_equal, self._known, places)):
            self._known = A.indptr.copy(), A.indices.copy()  # libraries sort in place
            numbered = sp.csr_array((np.arange(A.nnz), *reversed(places)), shape=A.shape)
            self._numbers = numbered[self._chosen][:, self._chosen]
            self._numbers.sort_indices()
        found = self._numbers
        return sp.csr_array((A.data[found.data], found.indices.copy(), found.indptr.copy()), shape=found.shape)


class Condensed:
    """One stiffness A, condensed: whatever is wanted of the kept unknowns takes arrays of their number alone.

    Parameters
    ----------
    A, pattern
        The matrix (n×n), and what to condense it on.
    reused
        Whether many solutions will be expanded, so that preparing for it pays.

    Attributes
    ----------
    dense
        Whether most of Ŝ is filled in.
    """

    def __init__(self, A: SparseMatrix, pattern: Pattern, *, reused: bool = False) -> None:
        self._pattern, self._size, self._reused = pattern, A.shape[0], reused
        A, count = sp.csr_array(A), len(pattern.interface)
        natural = np.arange(len(pattern.order))
        self._factor = SparseCholesky(pattern.eliminated.of(A).T, "A", natural, count) if len(natural) else None
        self._eliminated = len(natural) - count
        upper = self._factor.tail(count) if self._factor is not None else np.zeros((0, 0))
        self._schur = upper.T @ upper
        self.dense = 2 * count > len(pattern.kept)
        self._kept_block = pattern.kept_block.of(A)
        self._loaded: tuple[Array, tuple[Array, Array]] | None = None

    @property
    def matrix(self) -> SparseMatrix:
        """Schur complement Ŝ of the eliminated unknowns (c×c), sparse."""
        return _with_block(sp.coo_array(self._kept_block), self._pattern.interface, self._schur)

    @property
    def array(self) -> Array:
        """Ŝ as an array."""
        found, interface = self._kept_block.toarray(), self._pattern.interface
        found[np.ix_(interface, interface)] = self._schur
        return np.asarray(found)

    def load(self, f: Array) -> tuple[Array, Array]:
        """Load (c,) on the kept unknowns that f (n,) amounts to, and what `expand` needs of f."""
        if self._loaded is not None and np.array_equal(self._loaded[0], f):
            return self._loaded[1]
        order, interface = self._pattern.order, self._pattern.interface
        right = f[order]
        right[self._eliminated :] = 0.0
        free = self._factor.solve(right) if self._factor is not None else right
        condensed = f[self._pattern.kept]
        condensed[interface] += self._schur @ free[self._eliminated :]
        self._loaded = f, (condensed, free)
        return self._loaded[1]

    def expand(self, u_kept: Array, free: Array) -> Array:
        """All unknowns (n,) from the kept ones (c,), equilibrium holding in the others."""
        order, interface = self._pattern.order, self._pattern.interface
        u = np.empty(self._size)
        if self._factor is not None:
            u[order] = free + self._extended(self._factor, u_kept[interface] - free[self._eliminated :])
        u[self._pattern.kept] = u_kept
        return u

    def settle(self, residual: Array) -> Array:
        """Displacement (n,) of the unknowns not kept that takes a residual (n,) out of their equilibrium."""
        order, found = self._pattern.order, np.zeros(self._size)
        if self._factor is not None:
            inside = residual[order]
            inside[self._eliminated :] = 0.0
            free = self._factor.solve(inside)
            settled = free + self._extended(self._factor, -free[self._eliminated :])
            found[order[: self._eliminated]] = settled[: self._eliminated]
        return found

    def _extended(self, factor: SparseCholesky, interface: Array) -> Array:
        """Unknowns in the order of elimination that are given on the interface and in equilibrium elsewhere."""
        if self._reused:
            return factor.extend(interface)
        right = np.zeros(len(self._pattern.order))
        right[self._eliminated :] = self._schur @ interface
        return factor.solve(right)


def _with_block(matrix: SparseMatrix, where: Indices, block: Array) -> SparseMatrix:
    """A sparse matrix (CSC) with the rows and columns `where` of it replaced by a dense block."""
    inside = np.zeros(matrix.shape[0], dtype=bool)
    inside[where] = True
    rows, columns = matrix.coords
    stays = ~(inside[rows] & inside[columns])
    return sp.csc_array(
        (
            np.concatenate([matrix.data[stays], block.ravel()]),
            (
                np.concatenate([rows[stays], np.repeat(where, len(where))]),
                np.concatenate([columns[stays], np.tile(where, len(where))]),
            ),
        ),
        shape=matrix.shape,
    )
