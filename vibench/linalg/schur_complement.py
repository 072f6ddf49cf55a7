"""Static condensation: sparse systems reduced to the few unknowns that constraints involve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.cholesky import PartialCholesky, elimination_order
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.factorisations import DEFAULT, implementation

# Constraints per unknown up to which multipliers come last in an elimination: with more of them their dense Schur
# complement is most of the work.
FEW_PER_UNKNOWN = 0.25


@dataclass(frozen=True)
class EliminationPattern:
    """Retained unknowns (c,), rising, and the elimination order of the others, for one sparsity pattern.

    The `order` of all others ends with the interface: the retained unknowns that couple to others. `interface` are its
    positions among the retained unknowns. `whole` extracts the whole matrix in an elimination order, where no unknown
    is eliminated.
    """

    retained: Indices
    order: Indices
    interface: Indices
    whole: PrincipalSubmatrix | None = None

    @property
    def is_dense(self) -> bool:
        """Whether most entries of the Schur complement are nonzero."""
        return 2 * len(self.interface) > len(self.retained)

    @cached_property
    def _places(self) -> Indices:
        """Positions of all unknowns (n,) among the retained ones, −1 of the others."""
        places = np.full(max(self.retained.max(initial=-1), self.order.max(initial=-1)) + 1, -1)
        places[self.retained] = np.arange(len(self.retained))
        return places

    def on_retained(self, B: SparseMatrix) -> SparseMatrix:
        """The columns of B (m×n) of the retained unknowns, others have no entries: m×c, CSR.

        Raises a `NumericalError` if others have some.
        """
        B = sp.csr_array(B)
        columns = self._places[B.indices]
        if columns.min(initial=0) < 0:
            raise NumericalError("a constraint touches unknowns that are to be eliminated")
        # Copy: libraries sort indices in place.
        return sp.csr_array((B.data.copy(), columns, B.indptr.copy()), shape=(B.shape[0], len(self.retained)))

    @cached_property
    def blocks(self) -> tuple[PrincipalSubmatrix, PrincipalSubmatrix]:
        """Extract the block of eliminated unknowns and interface, in elimination order, and that of retained ones."""
        return PrincipalSubmatrix(self.order), PrincipalSubmatrix(self.retained)

    @classmethod
    def of(cls, A: SparseMatrix, retained: Indices, factorisation: str = DEFAULT) -> EliminationPattern:
        """Pattern for symmetric positive definite matrices with the sparsity of A (n×n), for a factorisation."""
        others = np.setdiff1d(np.arange(A.shape[0]), retained)
        interface = np.unique(sp.csr_array(A)[others][:, retained].indices)
        inside = np.union1d(others, retained[interface])
        last = np.searchsorted(inside, retained[interface])
        order = implementation(factorisation).order(sp.csr_array(A)[inside][:, inside], last)
        return cls(retained, inside[order], interface)

    @classmethod
    def of_none(cls, A: SparseMatrix) -> EliminationPattern:
        """The pattern that eliminates no unknown of matrices with the sparsity of A (n×n), and orders all."""
        none = np.zeros(0, np.intp)
        return cls(np.arange(A.shape[0]), none, none, PrincipalSubmatrix(elimination_order(A, none)))


class PrincipalSubmatrix:
    """Extracts the rows and columns of chosen unknowns, in their order, from many square matrices.

    The positions of the entries are found once per sparsity pattern; after that, extraction copies entries.
    """

    def __init__(self, chosen: Indices) -> None:
        self.chosen = chosen
        self._sparsity: tuple[Indices, Indices] | None = None

    @cached_property
    def places(self) -> Indices:
        """Positions of the unknowns in the submatrix, if all of them are chosen."""
        return np.argsort(self.chosen)

    def of(self, A: SparseMatrix) -> SparseMatrix:
        """Extract the submatrix of A (CSR)."""
        sparsity = A.indptr, A.indices
        if self._sparsity is None or not all(map(np.array_equal, self._sparsity, sparsity)):
            self._sparsity = A.indptr.copy(), A.indices.copy()  # libraries sort indices in place
            numbered = sp.csr_array((np.arange(A.nnz), *reversed(sparsity)), shape=A.shape)
            self._positions = numbered[self.chosen][:, self.chosen]
            self._positions.sort_indices()
        block = self._positions
        return sp.csr_array((A.data[block.data], block.indices.copy(), block.indptr.copy()), shape=block.shape)


class StaticCondensation:
    """A stiffness matrix A (n×n) condensed on the retained unknowns of a pattern, by a named factorisation."""

    def __init__(self, A: SparseMatrix, pattern: EliminationPattern, factorisation: str = DEFAULT) -> None:
        self._pattern, self._size = pattern, A.shape[0]
        A, count = sp.csr_array(A), len(pattern.interface)
        natural = np.arange(len(pattern.order))
        eliminate, self._A = implementation(factorisation).eliminate, A
        self._factor = eliminate(pattern.blocks[0].of(A).T, natural, count, "A") if len(natural) else None
        self.dense = pattern.is_dense
        self._last_load: tuple[Array, tuple[Array, Array]] | None = None

    @cached_property
    def _retained_block(self) -> SparseMatrix:
        return self._pattern.blocks[1].of(self._A)

    @property
    def nbytes(self) -> int:
        """Memory of the factor of the eliminated unknowns."""
        # SuperLU allocates more than it fills.
        return 0 if self._factor is None else 2 * self._factor.nbytes

    @cached_property
    def schur(self) -> SparseMatrix:
        """Schur complement Ŝ of the eliminated unknowns (c×c), sparse."""
        if self._factor is None:
            return self._retained_block.T
        retained, interface = sp.coo_array(self._retained_block), self._pattern.interface
        rows, columns = retained.coords
        apart = ~(np.isin(rows, interface) & np.isin(columns, interface))
        data = np.concatenate([retained.data[apart], self._factor.schur_blocks().toarray().ravel()])
        rows = np.concatenate([rows[apart], np.repeat(interface, len(interface))])
        columns = np.concatenate([columns[apart], np.tile(interface, len(interface))])
        return sp.csc_array((data, (rows, columns)), shape=retained.shape)

    @property
    def dense_blocks(self) -> BlockDiagonal:
        if self._factor is not None and len(self._pattern.interface) == len(self._pattern.retained):
            return self._factor.schur_blocks()
        return BlockDiagonal.of(self.dense_schur)

    @property
    def dense_schur(self) -> Array:
        if not self.dense:
            # The sparse one is needed and cached there; CSC columns would be written across the rows of the array.
            return np.asarray(sp.csr_array(self.schur).toarray())
        schur, interface = self._retained_block.toarray(), self._pattern.interface
        if self._factor is not None:
            schur[np.ix_(interface, interface)] = self._factor.schur_blocks().toarray()
        return np.asarray(schur)

    def round_off(self, squares: Array) -> float:
        """A δ such that A differs by a matrix between −δS² and δS² from one whose exact complement is the computed one.

        S² = diag(`squares`) (n,). Only eliminations of SuperLU have a `PartialCholesky.round_off`.
        """
        if self._factor is None:
            return 0.0
        assert isinstance(self._factor, PartialCholesky)
        inverse = 1.0 / np.sqrt(squares[self._pattern.order])
        return float(np.max(inverse * self._factor.round_off(inverse), initial=0.0))

    def eliminate(self, f: Array) -> tuple[Array, Array]:
        """Condensed loads (c,) or (c, k) of f (n,) or (n, k), and the particular solution that `recover` adds."""
        condensed, particular = f[self._pattern.retained], np.zeros((0, *f.shape[1:]))
        if self._factor is not None:
            particular, condensed[self._pattern.interface] = self._factor.eliminate(f[self._pattern.order])
        return condensed, particular

    def eliminated_squares(self, right: Array) -> tuple[Array, Array]:
        """Condensed loads (c, k) of r (n, k), and r_iᵀ A_ii⁻¹ r_i (k,): ‖r‖² in A⁻¹ is the sum of both parts."""
        load, particular = self.eliminate(right)
        eliminated = self._pattern.order[: len(particular)]
        return load, np.asarray(np.einsum("ik,ik->k", particular, right[eliminated]))

    def condense_load(self, f: Array) -> tuple[Array, Array]:
        """`eliminate(f)` for one load, cached until the load changes."""
        if self._last_load is None or not np.array_equal(self._last_load[0], f):
            self._last_load = f.copy(), self.eliminate(f)  # copied: the next load may be written into the same vector
        return self._last_load[1]

    def recover(self, u_retained: Array, particular: Array) -> Array:
        """All unknowns (n,) or (n, k) from the retained ones, with equilibrium in the eliminated ones."""
        u = np.empty((self._size, *u_retained.shape[1:]))
        if self._factor is not None:
            extension = self._factor.extend(u_retained[self._pattern.interface])
            extension[: len(particular)] += particular
            u[self._pattern.order] = extension
        u[self._pattern.retained] = u_retained
        return u

    def correct_eliminated(self, residual: Array) -> Array:
        """Correction (n,) of the eliminated unknowns alone that restores their equilibrium, from a residual (n,)."""
        correction = np.zeros(self._size)
        if self._factor is not None:
            particular, _ = self._factor.eliminate(residual[self._pattern.order])
            correction[self._pattern.order[: len(particular)]] = particular
        return correction
