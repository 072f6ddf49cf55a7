"""Active set systems at a cost linear in the unknowns: conjugate gradients in the null space of the active rows.

Every active row of B has a pivot among its unknowns a. The others, i, are free, and u_a = M_aa⁻¹(g_a − M_ai u_i) with a
sparse factor of the rows M. With the columns of Z spanning the null space, ZᵀAZ differs from A_ii only next to the
pivots, and is preconditioned by multigrid of A_ii. Solutions of sets that are left at once are rough.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.sparse.linalg import splu

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.highfidelity.kkt_systems import ActiveSetSystem, CondensedStiffness
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.multigrid import Cycle, MultigridFactor, solution
from vibench.qp.scaling import row_norms
from vibench.qp.verification import norms_by_solutions

# Energy of the error of a solution, relative to that of the load.
EXACT = 1e-12


class MultigridStiffness(CondensedStiffness):
    """A stiffness matrix A whose systems are solved by multigrid; it is condensed only where bounds ask for it."""

    def _condense(self) -> None:
        self._solver = MultigridFactor(self._A, "A")

    def solve(self, right: Array) -> Array:
        return self._solver.solve(right)

    def check_definite(self, name: str) -> None:
        """Do nothing: where A was seen not to be definite there is no solver of it."""

    def dual_norms(self, functionals: Array) -> Array:
        # The error of a norm is the square of that of the solution.
        return norms_by_solutions(functionals, self._solver.solve_to(functionals, 1e-2))

    def active_set_system(self, vi: VariationalInequality) -> ActiveSetSystem:
        solver, nothing = NullSpaceSolver(self._A, vi), np.zeros(len(vi.f))
        return ActiveSetSystem(sp.csr_array(vi.B), vi.g, solver, lambda u: u, lambda _: nothing, K=vi.K, inexact=solver)


class NullSpaceSolver:
    """Solves the KKT systems of successive active sets, each from the solution of the one before.

    A set that is new is solved roughly, ten times better than the one before; one that stays, to `EXACT`.
    """

    def __init__(self, A: SparseMatrix, vi: VariationalInequality) -> None:
        self._A, self._B, self._f, self._g = sp.csr_array(A), sp.csr_array(vi.B), vi.f, vi.g
        self._u, self._goal, self._scale = np.zeros(len(vi.f)), 1e-2, 0.0
        self._key: bytes | None = None
        self._base: Mask | None = None
        self._diagonal = self._A.diagonal()
        self._reach = row_norms(self._B) / np.sqrt(sp.linalg.norm(self._A, np.inf))

    @property
    def is_exact(self) -> bool:
        """Whether the last solution was exact."""
        return self._goal == EXACT

    @property
    def noise(self) -> Array:
        """A small multiple (m,) of the errors in B u, below ten times `EXACT` in natural residuals."""
        return np.asarray(10.0 * EXACT * self._scale * self._reach)

    def __call__(self, active: Indices, fixed: Array | None = None) -> tuple[Array, Array]:
        """The solution u (n,), λ (m,) of an `ActiveSolver`; raises a `RuntimeError` if the rows are dependent."""
        load = self._f if fixed is None else self._f - self._B.T @ fixed
        key = active.tobytes() + (b"" if fixed is None else fixed.tobytes())
        self._goal = EXACT if key == self._key else max(0.1 * self._goal, EXACT)
        if key != self._key:
            self._key = None  # where this fails
            self._restrict(active)
            self._key = key
        pinned, free, u = self._pinned, self._free, np.zeros(len(load))
        u[pinned] = self._solve(self._g[active], "N")

        def lifted(values: Array) -> Array:
            v = np.zeros(len(load))
            v[free] = values
            v[pinned] = -self._solve(self._coupling @ values, "N")
            return v

        def reduced(r: Array) -> Array:
            return np.asarray(r[free] - self._coupling.T @ self._solve(r[pinned], "T"))

        right = reduced(load - self._A @ u)
        self._scale = self._scale or float(np.sqrt(right @ self._preconditioned(right)))
        args = self._preconditioned, right, self._u[free], self._goal * self._scale, "A on the free unknowns"
        self._u = u + lifted(solution(lambda v: reduced(self._A @ lifted(v)), *args))
        lam = np.zeros(len(self._g)) if fixed is None else fixed.copy()
        lam[active] = self._solve((load - self._A @ self._u)[pinned], "T")
        return self._u, lam

    def _preconditioned(self, residual: Array) -> Array:
        """About the product of the inverse of A on the free unknowns and a residual there."""
        if self._is_free is self._base:
            return self._cycle(residual)
        assert self._base is not None
        r = np.zeros(len(self._f))
        r[self._free] = residual
        z = r / self._diagonal
        z[self._base] = self._cycle(r[self._base])
        return np.asarray(z[self._free])

    def _restrict(self, active: Indices) -> None:
        """Choose the pivots of active rows, factorise these there, and make the hierarchy of the other unknowns."""
        rows = self._B[active]
        rows.eliminate_zeros()
        sizes, places = abs(rows), np.repeat(np.arange(len(active)), np.diff(rows.indptr))
        largest = sizes.max(axis=1).toarray().ravel()[places]
        first = np.unique(places[sizes.data == largest], return_index=True)[1]
        self._pinned = rows.indices[sizes.data == largest][first]
        if len(np.unique(self._pinned)) < len(active):  # rows share an unknown, as opposite ones do
            sizes.data = 1.0 + np.log(largest / sizes.data)
            try:
                self._pinned = min_weight_full_bipartite_matching(sizes)[1]
            except ValueError:
                raise RuntimeError("the active constraints are dependent") from None
        is_free = np.ones(len(self._f), bool)
        is_free[self._pinned] = False
        self._free, columns = np.flatnonzero(is_free), sp.csc_array(rows)
        self._coupling, self._lengths = sp.csr_array(columns[:, self._free]), row_norms(rows)
        pivots = sp.csc_array(sp.diags_array(1.0 / self._lengths) @ columns[:, self._pinned])
        self._factor = splu(pivots) if len(active) else None
        if self._factor is not None and np.min(np.abs(self._factor.U.diagonal())) < 1e-12:
            raise RuntimeError("the active constraints are dependent")
        # The hierarchy of a set that differs in few rows costs less than its own.
        if self._base is None or 40 * np.count_nonzero(is_free != self._base) > len(active):
            self._base, self._cycle = is_free, Cycle(self._A[self._free][:, self._free], "A on the free unknowns")
        self._is_free = is_free

    def _solve(self, right: Array, trans: str) -> Array:
        """The product of M_aa⁻¹, or its transpose, and r (k,)."""
        if self._factor is None:
            return right
        solved = self._factor.solve(right if trans == "T" else right / self._lengths, trans)
        return np.asarray(solved / self._lengths if trans == "T" else solved)
