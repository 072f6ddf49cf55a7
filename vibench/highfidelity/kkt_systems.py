"""KKT systems of the active set method: a condensed stiffness with the active constraints as equalities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.definite import dense_inverse
from vibench.linalg.schur_complement import EliminationPattern, StaticCondensation
from vibench.qp.scaling import row_norms

MAX_RETAINED_SHARE = 0.5
"""Systems are condensed on the constrained unknowns where these are at most this share of all."""

MAX_BORDER = 16
"""A factorisation is bordered and reused for active sets that differ from its own in at most so many constraints."""

ROUND_OFF = 1e-12
"""Entries of a bordered system below this, relative to their terms, may consist of round-off alone."""


ActiveSolver = Callable[[Indices], tuple[Array, Array]]
"""From the active constraints to u (c,) and λ (m,): these are equalities, all other multipliers vanish."""


class CondensedStiffness:
    """A stiffness matrix A, condensed on the unknowns that constraints involve.

    Parameters
    ----------
    A
        Sparse SPD (n×n).
    pattern
        Retains at least all unknowns that B touches; by default every unknown is retained.
    """

    def __init__(self, A: SparseMatrix, pattern: EliminationPattern | None = None) -> None:
        if pattern is None or len(pattern.retained) > MAX_RETAINED_SHARE * A.shape[0]:
            pattern = EliminationPattern(np.arange(A.shape[0]), np.zeros(0, np.intp), np.zeros(0, np.intp))
        self._pattern = pattern
        self._condensed = StaticCondensation(A, self._pattern)

    def check_definite(self, name: str) -> None:
        """Raise a `NumericalError` that calls A by `name` if A is not positive definite.

        The elimination has factorised one block; A is definite exactly where the Schur complement is, too.
        """
        if self._condensed.dense:
            self._compliance  # noqa: B018  its Cholesky factorisation fails otherwise
        else:
            SparseCholesky(self._condensed.schur, name)  # its message has this name

    def solve(self, right: Array) -> Array:
        """A⁻¹ r for right-hand sides (n, k)."""
        load, particular = self._condensed.eliminate(right)
        retained = self._compliance @ load if self._condensed.dense else self._schur_factor.solve(load)
        return self._condensed.recover(retained, particular)

    def norm_of_force(self, force: Array) -> float | None:
        """‖ℓ‖ in A⁻¹ of a force ℓ (n,) on retained unknowns, such as Bᵀλ; `None` without a dense compliance."""
        if not self._condensed.dense:
            return None
        load = force[self._pattern.retained]
        pressed = np.flatnonzero(load)
        energy = load[pressed] @ self._compliance[np.ix_(pressed, pressed)] @ load[pressed]
        return float(np.sqrt(max(float(energy), 0.0)))

    @cached_property
    def _schur_factor(self) -> SparseCholesky:
        return SparseCholesky(self._condensed.schur, "A")

    @cached_property
    def _compliance(self) -> Array:
        """Ŝ⁻¹ (c×c)."""
        return dense_inverse(self._condensed.dense_schur, "A")

    def active_set_system(self, vi: VariationalInequality) -> ActiveSetSystem:
        """The KKT systems of the active sets of `vi`, whose stiffness must be this one."""
        condensed = self._condensed
        load, particular = condensed.condense_load(vi.f)
        B = sp.csr_array(sp.csc_array(vi.B)[:, self._pattern.retained])
        solve_active = (
            _compliance_solver(self._compliance, load, B, vi.g)
            if condensed.dense
            else SaddlePointSolver(condensed.schur, load, B, vi.g)
        )
        recover = partial(condensed.recover, particular=particular)
        return ActiveSetSystem(B, vi.g, solve_active, recover, condensed.correct_eliminated)


@dataclass(frozen=True)
class ActiveSetSystem:
    """The variational inequality of one parameter in the c retained unknowns: B sparse (m×c), g (m,).

    `recover` and `correct_eliminated` are those of `StaticCondensation`, the first one at this load.
    """

    B: SparseMatrix
    g: Array
    solve_active: ActiveSolver
    recover: Callable[[Array], Array]
    correct_eliminated: Callable[[Array], Array]


class SaddlePointSolver:
    """Solves the sparse KKT systems of successive active sets, with one step of iterative refinement.

    The system of one active set is factorised. Active sets that differ from it in few constraints reuse the factor,
    bordered by a column per added constraint (its row of B) or removed one (a slack that sets its multiplier to zero).

    Parameters
    ----------
    A, f
        Stiffness, sparse SPD (c×c), and load (c,).
    B, g
        Constraints, B sparse (m×c), and their bounds (m,).
    """

    def __init__(self, A: SparseMatrix, f: Array, B: SparseMatrix, g: Array) -> None:
        stiffness = np.abs(A.diagonal())
        # Jacobi scaling: displacements and forces of steel in metres differ by 1e11, and `ROUND_OFF` compares them
        self._displacement = 1.0 / np.sqrt(np.where(stiffness > 0.0, stiffness, 1.0))
        B = _in_units(np.ones(len(g)), sp.csr_array(B), self._displacement)
        self._force = 1.0 / row_norms(B)
        self._A, self._f = _in_units(self._displacement, sp.csr_array(A), self._displacement), self._displacement * f
        self._B, self._g = _in_units(self._force, B, np.ones(len(f))), self._force * g
        self._factorised_set = np.zeros(0, dtype=np.intp)
        self._factorisation: _BorderedFactorisation | None = None

    def __call__(self, active: Indices) -> tuple[Array, Array]:
        """The solution u (c,), λ (m,) with the active constraints as equalities and no other multiplier.

        Raises
        ------
        RuntimeError
            If the system is exactly singular.
        """
        solution = None
        if self._factorisation is not None and len(np.setxor1d(active, self._factorised_set)) <= MAX_BORDER:
            solution = self._solve_bordered(self._factorisation, active)
        if solution is None:
            # in this order: the set must stay that of the last factorisation where this one fails
            B = self._B[active]
            zero = sp.csr_array((len(active), len(active)))  # SciPy stacks blocks that are all CSR without triplets
            saddle = sp.block_array([[self._A, sp.csr_array(B.T)], [B, zero]], format="csr").T
            self._factorisation = _BorderedFactorisation(saddle)
            self._factorised_set = active
            solution = self._solve_bordered(self._factorisation, active)
        assert solution is not None  # an empty border is always independent
        return solution

    def _solve_bordered(self, factorisation: _BorderedFactorisation, active: Indices) -> tuple[Array, Array] | None:
        """The solution from the factorised set; `None` where the border is not clearly linearly independent."""
        n, base = self._A.shape[0], self._factorised_set
        added, removed = np.setdiff1d(active, base), np.flatnonzero(~np.isin(base, active))
        border = np.zeros((n + len(base), len(added) + len(removed)))
        border[:n, : len(added)] = self._B[added].toarray().T
        border[n + removed, len(added) + np.arange(len(removed))] = 1.0
        values = np.concatenate([self._g[added], np.zeros(len(removed))])
        solved = factorisation.solve(border, np.concatenate([self._f, self._g[base]]), values)
        if solved is None:
            return None
        lam = np.zeros(self._B.shape[0])
        lam[base], lam[added] = solved[0][n:], solved[1][: len(added)]
        lam[base[removed]] = 0.0
        return self._displacement * solved[0][:n], self._force * lam


def _in_units(rows: Array, matrix: SparseMatrix, columns: Array) -> SparseMatrix:
    """A matrix (CSR) with its rows and columns multiplied by factors."""
    data = np.repeat(rows, np.diff(matrix.indptr)) * matrix.data * columns[matrix.indices]
    return sp.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)


class _BorderedFactorisation:
    """The LU factorisation of a symmetric system K (k×k), solved with borders of a few rows and columns.

    Raises
    ------
    RuntimeError
        If it is exactly singular. A system that is singular up to round-off may still be consistent; its solution is
        verified by the active set method.
    """

    def __init__(self, matrix: SparseMatrix) -> None:
        self._matrix, self._factor = matrix, splu(matrix)

    def solve(self, border: Array, right: Array, values: Array) -> tuple[Array, Array] | None:
        """The x (k,) and y (d,) with K x + C y = r and Cᵀx = s; `None` where Cᵀ K⁻¹ C is not clearly regular."""
        solved = self._factor.solve(border) if border.size else border
        schur = border.T @ solved
        if not _regular(schur, np.linalg.norm(border, axis=0) * np.linalg.norm(solved, axis=0)):
            return None

        def solve_once(right: Array, values: Array) -> tuple[Array, Array]:
            unbordered = self._factor.solve(right)
            y = np.linalg.solve(schur, border.T @ unbordered - values)
            return unbordered - solved @ y, y

        x, y = solve_once(right, values)
        dx, dy = solve_once(right - self._matrix @ x - border @ y, values - border.T @ x)
        return x + dx, y + dy


def _regular(schur: Array, sizes: Array) -> bool:
    """Whether a symmetric matrix (d×d) is far from singular and its diagonal above the round-off of its terms."""
    if not len(schur):
        return True
    diagonal = np.abs(np.diag(schur))
    if np.any(diagonal <= ROUND_OFF * sizes):
        return False
    scale = np.sqrt(diagonal)
    return bool(np.linalg.cond(schur / np.outer(scale, scale)) < 1.0 / np.sqrt(ROUND_OFF))


def _compliance_solver(compliance: Array, f: Array, B: SparseMatrix, g: Array) -> ActiveSolver:
    """Solutions for active sets through their dense compliance B_a Ŝ⁻¹B_aᵀ; multipliers are refined once."""
    unconstrained = compliance @ f
    excess = B @ unconstrained - g

    def solve_active(active: Indices) -> tuple[Array, Array]:
        rows, lam = B[active], np.zeros(len(g))
        if not len(active):
            return unconstrained, lam
        touched = np.unique(rows.indices)  # of the compliance of all candidates few rows are needed
        rows = rows[:, touched]
        contact = np.asarray(rows @ (rows @ compliance[np.ix_(touched, touched)]).T)
        scale = 1.0 / np.sqrt(np.diag(contact))  # rows of any length
        factor = scipy.linalg.cho_factor(contact * np.outer(scale, scale))
        forces = scale * scipy.linalg.cho_solve(factor, scale * excess[active])
        forces += scale * scipy.linalg.cho_solve(factor, scale * (excess[active] - contact @ forces))
        lam[active] = forces
        return unconstrained - (rows.T @ forces) @ compliance[touched], lam

    return solve_active
