"""Static condensation: sparse systems reduced to the few unknowns that constraints involve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.linalg.cholesky import SparseCholesky, elimination_order


@dataclass(frozen=True)
class EliminationPattern:
    """Which unknowns are retained and in which order the others are eliminated, for one sparsity pattern.

    Attributes
    ----------
    retained
        Unknowns (c,) that the system is condensed on, rising.
    order
        Elimination order of all others, followed by the interface: the retained unknowns that couple to others.
    interface
        Positions of the interface among the retained unknowns.
    """

    retained: Indices
    order: Indices
    interface: Indices

    @cached_property
    def factorised_block(self) -> PrincipalSubmatrix:
        """The block of the eliminated unknowns and the interface, in elimination order."""
        return PrincipalSubmatrix(self.order)

    @cached_property
    def retained_block(self) -> PrincipalSubmatrix:
        """The block of the retained unknowns."""
        return PrincipalSubmatrix(self.retained)

    @classmethod
    def of(cls, A: SparseMatrix, retained: Indices) -> EliminationPattern:
        """Pattern for matrices with the sparsity of A (n×n), symmetric positive definite."""
        others = np.setdiff1d(np.arange(A.shape[0]), retained)
        interface = np.unique(sp.csr_array(A)[others][:, retained].indices)
        inside = np.union1d(others, retained[interface])
        order = elimination_order(sp.csr_array(A)[inside][:, inside], np.searchsorted(inside, retained[interface]))
        return cls(retained, inside[order], interface)


class PrincipalSubmatrix:
    """Extracts the rows and columns of chosen unknowns from many square matrices.

    The positions of the entries are found once per sparsity pattern; after that, extraction copies entries.

    Parameters
    ----------
    chosen
        Unknowns, in the order they have in the submatrix.
    """

    def __init__(self, chosen: Indices) -> None:
        self._chosen = chosen
        self._sparsity: tuple[Indices, Indices] | None = None

    def of(self, A: SparseMatrix) -> SparseMatrix:
        """The submatrix of A (CSR)."""
        sparsity = A.indptr, A.indices
        if self._sparsity is None or not all(map(np.array_equal, self._sparsity, sparsity)):
            self._sparsity = A.indptr.copy(), A.indices.copy()  # copies, since libraries sort indices in place
            numbered = sp.csr_array((np.arange(A.nnz), *reversed(sparsity)), shape=A.shape)
            self._positions = numbered[self._chosen][:, self._chosen]
            self._positions.sort_indices()
        found = self._positions
        return sp.csr_array((A.data[found.data], found.indices.copy(), found.indptr.copy()), shape=found.shape)


class StaticCondensation:
    """A stiffness matrix A condensed on the retained unknowns of a pattern.

    Parameters
    ----------
    A, pattern
        The matrix (n×n) and its elimination pattern.
    reused
        Whether many solutions are recovered from it, so that a dense extension operator pays off.

    Attributes
    ----------
    dense
        Whether most entries of the Schur complement are non-zero.
    """

    def __init__(self, A: SparseMatrix, pattern: EliminationPattern, *, reused: bool = False) -> None:
        self._pattern, self._size, self._reused = pattern, A.shape[0], reused
        A, count = sp.csr_array(A), len(pattern.interface)
        natural = np.arange(len(pattern.order))
        self._factor = SparseCholesky(pattern.factorised_block.of(A).T, "A", natural, count) if len(natural) else None
        self._eliminated = len(natural) - count
        upper = self._factor.trailing_factor(count) if self._factor is not None else np.zeros((0, 0))
        self._interface_schur = upper.T @ upper
        self.dense = 2 * count > len(pattern.retained)
        self._retained_block = pattern.retained_block.of(A)
        self._last_load: tuple[Array, tuple[Array, Array]] | None = None

    @property
    def schur(self) -> SparseMatrix:
        """Schur complement Ŝ of the eliminated unknowns (c×c), sparse."""
        return _with_block(sp.coo_array(self._retained_block), self._pattern.interface, self._interface_schur)

    @property
    def dense_schur(self) -> Array:
        """Ŝ as an array."""
        found, interface = self._retained_block.toarray(), self._pattern.interface
        found[np.ix_(interface, interface)] = self._interface_schur
        return np.asarray(found)

    def condense_load(self, f: Array) -> tuple[Array, Array]:
        """The condensed load (c,) of f (n,), and the particular solution that `recover` needs."""
        if self._last_load is not None and np.array_equal(self._last_load[0], f):
            return self._last_load[1]
        order, interface = self._pattern.order, self._pattern.interface
        right = f[order]
        right[self._eliminated :] = 0.0
        particular = self._factor.solve(right) if self._factor is not None else right
        condensed = f[self._pattern.retained]
        condensed[interface] += self._interface_schur @ particular[self._eliminated :]
        self._last_load = f, (condensed, particular)
        return self._last_load[1]

    def recover(self, u_retained: Array, particular: Array) -> Array:
        """All unknowns (n,) from the retained ones (c,), with equilibrium in the eliminated ones."""
        order, interface = self._pattern.order, self._pattern.interface
        u = np.empty(self._size)
        if self._factor is not None:
            on_interface = u_retained[interface] - particular[self._eliminated :]
            u[order] = particular + self._extension(self._factor, on_interface)
        u[self._pattern.retained] = u_retained
        return u

    def correct_eliminated(self, residual: Array) -> Array:
        """Correction (n,) of the eliminated unknowns alone that restores their equilibrium, from a residual (n,)."""
        order, correction = self._pattern.order, np.zeros(self._size)
        if self._factor is not None:
            right = residual[order]
            right[self._eliminated :] = 0.0
            particular = self._factor.solve(right)
            inside = particular + self._extension(self._factor, -particular[self._eliminated :])
            correction[order[: self._eliminated]] = inside[: self._eliminated]
        return correction

    def _extension(self, factor: SparseCholesky, interface: Array) -> Array:
        """Unknowns in elimination order with given interface values and equilibrium in the eliminated ones."""
        if self._reused:
            return factor.extend(interface)
        right = np.zeros(len(self._pattern.order))
        right[self._eliminated :] = self._interface_schur @ interface
        return factor.solve(right)


def _with_block(matrix: SparseMatrix, where: Indices, block: Array) -> SparseMatrix:
    """A sparse matrix (CSC) with the rows and columns `where` of it replaced by a dense block."""
    inside = np.zeros(matrix.shape[0], dtype=bool)
    inside[where] = True
    rows, columns = matrix.coords
    outside = ~(inside[rows] & inside[columns])
    return sp.csc_array(
        (
            np.concatenate([matrix.data[outside], block.ravel()]),
            (
                np.concatenate([rows[outside], np.repeat(where, len(where))]),
                np.concatenate([columns[outside], np.tile(where, len(where))]),
            ),
        ),
        shape=matrix.shape,
    )
