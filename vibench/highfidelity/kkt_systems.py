"""The systems that an active set method solves: a stiffness, condensed, and a set of constraints as equalities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.schur_complement import Condensed, Pattern
from vibench.qp.scaling import row_norms

FEW = 0.5
"""Systems are condensed on the constrained unknowns where these are no more than this share of all."""

BORDER = 16
"""Constraints by which an active set may differ from one that is factorised, for the factor to be used again."""

ROUND_OFF = 1e-12
"""Entries of a bordered system below this, relative to what they were made from, may be nothing but that."""


class Stiffness:
    """A stiffness A as the active set method needs it, condensed on some unknowns.

    Parameters
    ----------
    A
        Sparse SPD (n×n).
    pattern
        Unknowns to condense on, all that B touches among them; by default all unknowns.
    reused
        Whether it is that of many solutions.
    """

    def __init__(self, A: SparseMatrix, pattern: Pattern | None = None, *, reused: bool = False) -> None:
        if pattern is None or len(pattern.kept) > FEW * A.shape[0]:
            pattern = Pattern(np.arange(A.shape[0]), np.zeros(0, np.intp), np.zeros(0, np.intp))
        self._pattern = pattern
        self._condensed = Condensed(A, self._pattern, reused=reused)

    def check_definite(self, name: str) -> None:
        """Refuse an A that is not positive definite: what is left to be shown once the others are eliminated.

        Raises
        ------
        NumericalError
            Calling A by `name`.
        """
        if self._condensed.dense:
            self._inverse  # noqa: B018  no other has one
        else:
            SparseCholesky(self._condensed.matrix, name)

    @cached_property
    def _inverse(self) -> Array:
        """Ŝ⁻¹ (c×c)."""
        try:
            factor = scipy.linalg.cho_factor(self._condensed.array)
        except np.linalg.LinAlgError:
            raise NumericalError("A is not positive definite") from None
        return np.ascontiguousarray(scipy.linalg.cho_solve(factor, np.eye(len(self._pattern.kept))))

    def system(self, vi: VariationalInequality) -> ActiveSystem:
        """The equality-constrained systems of the active sets of `vi`, whose stiffness this is."""
        condensed = self._condensed
        load, free = condensed.load(vi.f)
        B = sp.csr_array(sp.csc_array(vi.B)[:, self._pattern.kept])
        solve_active = (
            _by_compliance(self._inverse, load, B, vi.g)
            if condensed.dense
            else SaddlePoint(condensed.matrix, load, B, vi.g)
        )
        return ActiveSystem(B, vi.g, solve_active, lambda u: condensed.expand(u, free), condensed.settle)


@dataclass(frozen=True)
class ActiveSystem:
    """What the active set method works on: everything in the c unknowns that are left.

    Attributes
    ----------
    B, g
        Constraints, B sparse (m×c).
    solve_active
        From the active constraints: u (c,) and λ (m,) with these as equalities and no other multiplier.
    expand
        All n unknowns from the c ones.
    settle
        Correction of the other unknowns (n,) that takes a residual (n,) out of their equilibrium.
    """

    B: SparseMatrix
    g: Array
    solve_active: Callable[[Indices], tuple[Array, Array]]
    expand: Callable[[Array], Array]
    settle: Callable[[Array], Array]


class SaddlePoint:
    """Solutions for active sets of a sparse system, refined once.

    One set is factorised; sets that differ from it in few constraints are solved for with the same factor, bordered by
    a column per constraint that has come (its row of B) or gone (a slack, with no force).

    Parameters
    ----------
    A, f
        Stiffness, sparse SPD (c×c), and load (c,).
    B, g
        Constraints, B sparse (m×c), and their bounds (m,).
    """

    def __init__(self, A: SparseMatrix, f: Array, B: SparseMatrix, g: Array) -> None:
        stiffness = np.abs(A.diagonal())
        self._size = 1.0 / np.sqrt(np.where(stiffness > 0.0, stiffness, 1.0))  # one unit for displacements and forces
        B = _scaled(np.ones(len(g)), sp.csr_array(B), self._size)
        self._force = 1.0 / row_norms(B)
        self._A, self._f = _scaled(self._size, sp.csr_array(A), self._size), self._size * f
        self._B, self._g = _scaled(self._force, B, np.ones(len(f))), self._force * g
        self._base = np.zeros(0, dtype=np.intp)
        self._factorised: _Factorised | None = None

    def __call__(self, active: Indices) -> tuple[Array, Array]:
        """The solution u (c,), λ (m,) with these constraints as equalities and no other force.

        Raises
        ------
        RuntimeError
            If their system is exactly singular.
        """
        found = None
        if self._factorised is not None and len(np.setxor1d(active, self._base)) <= BORDER:
            found = self._bordered(self._factorised, active)
        if found is None:
            self._base, self._factorised = active, _Factorised(_saddle(self._A, self._B[active]))
            found = self._bordered(self._factorised, active)
        assert found is not None  # without a border there is nothing that could be dependent
        return found

    def _bordered(self, known: _Factorised, active: Indices) -> tuple[Array, Array] | None:
        """The solution from what is factorised; `None` where the border is not clearly independent."""
        n, base = self._A.shape[0], self._base
        come, gone = np.setdiff1d(active, base), np.flatnonzero(~np.isin(base, active))
        border = np.zeros((n + len(base), len(come) + len(gone)))
        border[:n, : len(come)] = self._B[come].toarray().T
        border[n + gone, len(come) + np.arange(len(gone))] = 1.0
        given = np.concatenate([self._g[come], np.zeros(len(gone))])
        found = known.solve(border, np.concatenate([self._f, self._g[base]]), given)
        if found is None:
            return None
        lam = np.zeros(self._B.shape[0])
        lam[base], lam[come] = found[0][n:], found[1][: len(come)]
        lam[base[gone]] = 0.0
        return self._size * found[0][:n], self._force * lam


def _scaled(rows: Array, matrix: SparseMatrix, columns: Array) -> SparseMatrix:
    """A matrix (CSR) with its rows and columns multiplied by factors."""
    data = np.repeat(rows, np.diff(matrix.indptr)) * matrix.data * columns[matrix.indices]
    return sp.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)


def _saddle(A: SparseMatrix, B: SparseMatrix) -> SparseMatrix:
    """[[A, Bᵀ], [B, 0]] (CSC) of a symmetric A (c×c) and of B (m×c), both CSR."""
    below = sp.csc_array(B)
    ends = A.indptr + below.indptr  # of the columns of A, each with one of B below it
    last = int(ends[-1])
    data, rows = np.empty(last + B.nnz), np.empty(last + B.nnz, dtype=A.indices.dtype)
    upper = np.arange(A.nnz) + np.repeat(below.indptr[:-1], np.diff(A.indptr))
    lower = np.arange(B.nnz) + np.repeat(A.indptr[1:], np.diff(below.indptr))
    data[upper], rows[upper] = A.data, A.indices
    data[lower], rows[lower] = below.data, A.shape[0] + below.indices
    data[last:], rows[last:] = B.data, B.indices
    size = A.shape[0] + B.shape[0]
    return sp.csc_array((data, rows, np.concatenate([ends, last + B.indptr[1:]])), shape=(size, size))


class _Factorised:
    """A symmetric system K (k×k), equilibrated and factorised, that can be bordered.

    Raises
    ------
    RuntimeError
        If it is exactly singular; what is so up to round-off may have a solution all the same, which is verified.
    """

    def __init__(self, matrix: SparseMatrix) -> None:
        self._matrix, self._factor = matrix, splu(matrix)

    def solve(self, border: Array, right: Array, given: Array) -> tuple[Array, Array] | None:
        """The x (k,) and y (d,) with K x + C y = r and Cᵀx = s; `None` where Cᵀ K⁻¹ C is not clearly regular."""
        solved = self._factor.solve(border) if border.size else border
        schur = border.T @ solved
        if not _regular(schur, np.linalg.norm(border, axis=0) * np.linalg.norm(solved, axis=0)):
            return None

        def once(load: Array, values: Array) -> tuple[Array, Array]:
            alone = self._factor.solve(load)
            y = np.linalg.solve(schur, border.T @ alone - values)
            return alone - solved @ y, y

        x, y = once(right, given)
        dx, dy = once(right - self._matrix @ x - border @ y, given - border.T @ x)
        return x + dx, y + dy


def _regular(schur: Array, sizes: Array) -> bool:
    """Whether a symmetric matrix (d×d) is far from singular, its diagonal being no round-off of products of `sizes`."""
    if not len(schur):
        return True
    diagonal = np.abs(np.diag(schur))
    if np.any(diagonal <= ROUND_OFF * sizes):
        return False
    scale = np.sqrt(diagonal)
    return bool(np.linalg.cond(schur / np.outer(scale, scale)) < 1.0 / np.sqrt(ROUND_OFF))


def _by_compliance(inverse: Array, f: Array, B: SparseMatrix, g: Array) -> Callable[[Indices], tuple[Array, Array]]:
    """Solutions for active sets from what active constraints displace, S⁻¹B_aᵀ; forces are refined once."""
    free = inverse @ f
    excess = B @ free - g

    def solve_active(active: Indices) -> tuple[Array, Array]:
        rows, lam = B[active], np.zeros(len(g))
        if not len(active):
            return free, lam
        displaced = np.asarray(rows @ inverse)
        compliance = rows @ displaced.T
        factor = scipy.linalg.cho_factor(compliance)
        forces = scipy.linalg.cho_solve(factor, excess[active])
        forces += scipy.linalg.cho_solve(factor, excess[active] - compliance @ forces)
        lam[active] = forces
        return free - forces @ displaced, lam

    return solve_active
