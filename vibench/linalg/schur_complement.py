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
    """Which unknowns are retained and in which order the others are eliminated, for one sparsity pattern."""

    retained: Indices
    """Unknowns (c,) that the system is condensed on, rising."""
    order: Indices
    """Elimination order of all others, followed by the interface: the retained unknowns that couple to others."""
    interface: Indices
    """Positions of the interface among the retained unknowns."""

    @cached_property
    def factorised_block(self) -> PrincipalSubmatrix:
        """Extracts the block of the eliminated unknowns and the interface, in elimination order."""
        return PrincipalSubmatrix(self.order)

    @cached_property
    def retained_block(self) -> PrincipalSubmatrix:
        """Extracts the block of the retained unknowns."""
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
        block = self._positions
        return sp.csr_array((A.data[block.data], block.indices.copy(), block.indptr.copy()), shape=block.shape)


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
        upper = self._factor.trailing_factor() if self._factor is not None else np.zeros((0, 0))
        self._interface_schur = upper.T @ upper
        self.dense = 2 * count > len(pattern.retained)
        self._retained_block = pattern.retained_block.of(A)
        self._last_load: tuple[Array, tuple[Array, Array]] | None = None

    @property
    def schur(self) -> SparseMatrix:
        """Schur complement Ŝ of the eliminated unknowns (c×c), sparse."""
        retained, interface = sp.coo_array(self._retained_block), self._pattern.interface
        rows, columns = retained.coords
        kept = ~(np.isin(rows, interface) & np.isin(columns, interface))
        data = np.concatenate([retained.data[kept], self._interface_schur.ravel()])
        rows = np.concatenate([rows[kept], np.repeat(interface, len(interface))])
        columns = np.concatenate([columns[kept], np.tile(interface, len(interface))])
        return sp.csc_array((data, (rows, columns)), shape=retained.shape)

    @property
    def dense_schur(self) -> Array:
        """Ŝ as an array."""
        schur, interface = self._retained_block.toarray(), self._pattern.interface
        schur[np.ix_(interface, interface)] = self._interface_schur
        return np.asarray(schur)

    def condense_load(self, f: Array) -> tuple[Array, Array]:
        """The condensed load (c,) of f (n,), and the particular solution that `recover` needs."""
        if self._last_load is not None and np.array_equal(self._last_load[0], f):
            return self._last_load[1]
        interface, particular = self._pattern.interface, self._particular(f)
        condensed = f[self._pattern.retained]
        condensed[interface] += self._interface_schur @ particular[self._eliminated :]
        self._last_load = f.copy(), (condensed, particular)  # the next load may be written into the same vector
        return self._last_load[1]

    def _particular(self, f: Array) -> Array:
        """A solution in elimination order of the equations of the eliminated unknowns."""
        right = f[self._pattern.order]
        right[self._eliminated :] = 0.0
        return self._factor.solve(right) if self._factor is not None else right

    def recover(self, u_retained: Array, particular: Array) -> Array:
        """All unknowns (n,) from the retained ones (c,), with equilibrium in the eliminated ones."""
        u = np.empty(self._size)
        if self._factor is not None:
            on_interface = u_retained[self._pattern.interface] - particular[self._eliminated :]
            if self._reused:
                extension = self._factor.extend(on_interface)
            else:
                right = np.zeros(len(particular))
                right[self._eliminated :] = self._interface_schur @ on_interface
                extension = self._factor.solve(right)
            u[self._pattern.order] = particular + extension
        u[self._pattern.retained] = u_retained
        return u

    def correct_eliminated(self, residual: Array) -> Array:
        """Correction (n,) of the eliminated unknowns alone that restores their equilibrium, from a residual (n,)."""
        return self.recover(np.zeros(len(self._pattern.retained)), self._particular(residual))
