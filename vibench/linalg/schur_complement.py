"""Static condensation: sparse systems reduced to the few unknowns that constraints involve."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.cholesky import PartialCholesky
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.factorisations import DEFAULT, implementation

FEW_PER_UNKNOWN = 0.25
"""Constraints per unknown up to which multipliers come last in an elimination: with more of them their dense Schur
complement is most of the work."""


@dataclass(frozen=True)
class EliminationPattern:
    """Which unknowns are retained and in which order the others are eliminated, for one sparsity pattern."""

    retained: Indices
    """Unknowns (c,) that the system is condensed on, rising."""
    order: Indices
    """Elimination order of all others, followed by the interface: the retained unknowns that couple to others."""
    interface: Indices
    """Positions of the interface among the retained unknowns."""
    whole: PrincipalSubmatrix | None = None
    """Extracts the whole matrix in an elimination order, where no unknown is eliminated; `None` elsewhere."""

    @property
    def is_dense(self) -> bool:
        """Whether most entries of the Schur complement are non-zero."""
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
        # copies, since libraries sort indices in place
        return sp.csr_array((B.data.copy(), columns, B.indptr.copy()), shape=(B.shape[0], len(self.retained)))

    @cached_property
    def factorised_block(self) -> PrincipalSubmatrix:
        """Extracts the block of the eliminated unknowns and the interface, in elimination order."""
        return PrincipalSubmatrix(self.order)

    @cached_property
    def retained_block(self) -> PrincipalSubmatrix:
        """Extracts the block of the retained unknowns."""
        return PrincipalSubmatrix(self.retained)

    @classmethod
    def of(cls, A: SparseMatrix, retained: Indices, factorisation: str = DEFAULT) -> EliminationPattern:
        """Pattern for matrices with the sparsity of A (n×n), symmetric positive definite, to be factorised so."""
        others = np.setdiff1d(np.arange(A.shape[0]), retained)
        interface = np.unique(sp.csr_array(A)[others][:, retained].indices)
        inside = np.union1d(others, retained[interface])
        last = np.searchsorted(inside, retained[interface])
        order = implementation(factorisation).order(sp.csr_array(A)[inside][:, inside], last)
        return cls(retained, inside[order], interface)

    @classmethod
    def of_none(cls, A: SparseMatrix, factorisation: str = DEFAULT) -> EliminationPattern:
        """The pattern that eliminates no unknown of matrices with the sparsity of A (n×n), and orders all."""
        none = np.zeros(0, np.intp)
        return cls(np.arange(A.shape[0]), none, none, PrincipalSubmatrix(implementation(factorisation).order(A, none)))


class PrincipalSubmatrix:
    """Extracts the rows and columns of chosen unknowns from many square matrices.

    The positions of the entries are found once per sparsity pattern; after that, extraction copies entries.

    Parameters
    ----------
    chosen
        Unknowns, in the order they have in the submatrix.
    """

    def __init__(self, chosen: Indices) -> None:
        self.chosen = chosen
        self._sparsity: tuple[Indices, Indices] | None = None

    @cached_property
    def places(self) -> Indices:
        """Where the unknowns are in the submatrix, if all of them are chosen."""
        return np.argsort(self.chosen)

    def of(self, A: SparseMatrix) -> SparseMatrix:
        """The submatrix of A (CSR)."""
        sparsity = A.indptr, A.indices
        if self._sparsity is None or not all(map(np.array_equal, self._sparsity, sparsity)):
            self._sparsity = A.indptr.copy(), A.indices.copy()  # copies, since libraries sort indices in place
            numbered = sp.csr_array((np.arange(A.nnz), *reversed(sparsity)), shape=A.shape)
            self._positions = numbered[self.chosen][:, self.chosen]
            self._positions.sort_indices()
        block = self._positions
        return sp.csr_array((A.data[block.data], block.indices.copy(), block.indptr.copy()), shape=block.shape)


class StaticCondensation:
    """A stiffness matrix A condensed on the retained unknowns of a pattern.

    Parameters
    ----------
    A, pattern
        The matrix (n×n) and its elimination pattern.
    factorisation
        Who eliminates (`vibench.linalg.factorisations`).

    Attributes
    ----------
    dense
        Whether most entries of the Schur complement are non-zero.
    """

    def __init__(self, A: SparseMatrix, pattern: EliminationPattern, factorisation: str = DEFAULT) -> None:
        self._pattern, self._size = pattern, A.shape[0]
        A, count = sp.csr_array(A), len(pattern.interface)
        natural = np.arange(len(pattern.order))
        eliminate = implementation(factorisation).eliminate
        self._factor = eliminate(pattern.factorised_block.of(A).T, natural, count, "A") if len(natural) else None
        self.dense = pattern.is_dense
        self._retained_block = pattern.retained_block.of(A)
        self._last_load: tuple[Array, tuple[Array, Array]] | None = None

    @property
    def nbytes(self) -> int:
        """Memory of the factor of the eliminated unknowns, twice: SuperLU allocates more than it fills."""
        return 0 if self._factor is None else 2 * self._factor.nbytes

    @property
    def _interface_schur(self) -> Array:
        return self._factor.schur_blocks().toarray() if self._factor is not None else np.zeros((0, 0))

    @cached_property
    def schur(self) -> SparseMatrix:
        """Schur complement Ŝ of the eliminated unknowns (c×c), sparse."""
        if self._factor is None:
            return self._retained_block.T
        retained, interface = sp.coo_array(self._retained_block), self._pattern.interface
        rows, columns = retained.coords
        kept = ~(np.isin(rows, interface) & np.isin(columns, interface))
        data = np.concatenate([retained.data[kept], self._interface_schur.ravel()])
        rows = np.concatenate([rows[kept], np.repeat(interface, len(interface))])
        columns = np.concatenate([columns[kept], np.tile(interface, len(interface))])
        return sp.csc_array((data, (rows, columns)), shape=retained.shape)

    @property
    def dense_blocks(self) -> BlockDiagonal:
        """Ŝ body by body."""
        if self._factor is not None and len(self._pattern.interface) == len(self._pattern.retained):
            return self._factor.schur_blocks()
        return BlockDiagonal.of(self.dense_schur)

    @property
    def dense_schur(self) -> Array:
        """Ŝ as an array."""
        if not self.dense:  # both are asked for there, and the sparse one is kept
            return np.asarray(sp.csr_array(self.schur).toarray())  # of columns it would go through memory row by row
        schur, interface = self._retained_block.toarray(), self._pattern.interface
        schur[np.ix_(interface, interface)] = self._interface_schur
        return np.asarray(schur)

    def round_off(self, squares: Array) -> float:
        """A δ such that A differs by a matrix between −δS² and δS² from one whose exact complement is the computed one.

        S² = diag(`squares`) (n,). Of eliminations of SuperLU alone (`PartialCholesky.round_off`).
        """
        if self._factor is None:
            return 0.0
        assert isinstance(self._factor, PartialCholesky)  # nothing is known of others
        inverse = 1.0 / np.sqrt(squares[self._pattern.order])
        return float(np.max(inverse * self._factor.round_off(inverse), initial=0.0))

    def eliminate(self, f: Array) -> tuple[Array, Array]:
        """Condensed loads (c,) or (c, k) of f (n,) or (n, k), and what `recover` needs of the eliminated unknowns."""
        condensed, particular = f[self._pattern.retained], np.zeros((0, *f.shape[1:]))
        if self._factor is not None:
            particular, condensed[self._pattern.interface] = self._factor.eliminate(f[self._pattern.order])
        return condensed, particular

    def eliminated_squares(self, right: Array) -> tuple[Array, Array]:
        """Condensed loads (c, k) of r (n, k), and r_iᵀ A_ii⁻¹ r_i (k,): what ‖r‖² in A⁻¹ has beside them in Ŝ⁻¹."""
        load, particular = self.eliminate(right)
        eliminated = self._pattern.order[: len(particular)]
        return load, np.asarray(np.einsum("ik,ik->k", particular, right[eliminated]))

    def condense_load(self, f: Array) -> tuple[Array, Array]:
        """The same of one load, which is remembered until another one comes."""
        if self._last_load is None or not np.array_equal(self._last_load[0], f):
            self._last_load = f.copy(), self.eliminate(f)  # the next load may be written into the same vector
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
