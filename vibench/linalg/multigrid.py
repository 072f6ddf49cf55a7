"""Conjugate gradients preconditioned by algebraic multigrid (pyamg): seconds and memory linear in the unknowns.

Residuals are measured in the norm of the preconditioner, close to that of A⁻¹: in the Euclidean norm the round-off of
A u alone is 1e-10 of a load on a million unknowns. A direction without energy is noticed, but nothing is proved.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.linalg.blas import daxpy
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.sparse.linalg import splu

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.definite import Factor, checked

Product = Callable[[Array], Array]
# Error of an exact solution, in energy and relative to its load: above the round-off on a million unknowns.
EXACT = 1e-12


class MultigridFactor(Factor):
    """Solutions with a sparse symmetric positive definite X (n×n); raises as `solution`, for a random load at once."""

    def __init__(self, matrix: SparseMatrix, name: str) -> None:
        self._matrix, self._name, self._cycle = sp.csr_array(matrix), name, _cycle(matrix, name)
        if matrix.shape[0] <= 1000:
            SparseCholesky(matrix, name)  # the coarsest level alone would hide a direction
        else:
            self.solve_to(np.random.default_rng(0).standard_normal(matrix.shape[0]), 1e-2)

    def solve(self, right: Array) -> Array:
        return self.solve_to(right, EXACT)

    def solve_to(self, right: Array, accuracy: float) -> Array:
        """Solutions X⁻¹ r for r (n,) or (n, k), to an accuracy relative to their energy."""
        solved = np.zeros(right.shape)
        for one in np.ndindex(right.shape[1:]):
            load = np.array(right[:, *one], float)
            goal = accuracy * float(np.sqrt(load @ self._cycle(load)))
            solved[:, *one] = solution(self._matrix.__matmul__, self._cycle, load, 0.0 * load, goal, self._name)
        return solved


def _cycle(matrix: SparseMatrix, name: str) -> Product:
    """A symmetric V-cycle of Ruge and Stüben for a matrix (n×n), in single precision: fewer bytes, digits enough."""
    from pyamg import ruge_stuben_solver  # noqa: PLC0415  an optional library

    rows = checked(matrix, name).T
    unit = float(np.max(rows.diagonal()))
    rows = sp.csr_matrix(((rows.data / unit).astype(np.float32), rows.indices, rows.indptr), rows.shape)
    before, after = (("gauss_seidel", {"sweep": sweep}) for sweep in ("forward", "backward"))
    levels = ruge_stuben_solver(rows, presmoother=before, postsmoother=after, max_coarse=200, coarse_solver="splu")
    product = levels.aspreconditioner().matvec

    def cycle(residual: Array) -> Array:
        size = float(np.max(np.abs(residual))) or 1.0  # residuals of a converged solution would underflow
        try:
            return np.asarray(product((residual / size).astype(np.float32)), float) * (size / unit)
        except RuntimeError as error:  # of the factorisation on the coarsest level
            raise NumericalError(f"{name} has no multigrid hierarchy, as of one scalar field: {error}") from None

    return cycle


def solution(apply: Product, cycle: Product, right: Array, start: Array, goal: float, name: str) -> Array:
    """The solution x (n,) of A x = r from a first one, until its residual has at most the norm `goal`.

    Raises a `NumericalError` that calls A by `name` if it is seen not to be definite, or the residual stays above.
    """
    x, direction, last = start.copy(), np.zeros_like(start), 1.0
    residual = right - apply(x)
    for step in range(1, 500):
        z = cycle(residual)
        square = float(residual @ z)
        if square <= goal**2:
            return x
        # In place: arrays of this size are allocated page by page.
        direction = daxpy(direction, z, a=square / last)
        image = apply(direction)
        curvature, last = float(direction @ image), square
        if not (curvature > 0.0 and square > 0.0):
            raise NumericalError(f"{name} is not positive definite")
        x = daxpy(direction, x, a=square / curvature)
        # The residual that is updated falls far below that of x, which round-off bounds.
        residual = daxpy(image, residual, a=-square / curvature) if step % 8 else right - apply(x)
    raise NumericalError(f"{name}: multigrid of scalar fields stops at {last**0.5:.1e}, above {goal:.1e}")


class NullSpaceSolver:
    """An `ActiveSolver` of min ½ uᵀA u − fᵀu, B u ≤ g (m×n) by conjugate gradients, each from the last u.

    Every active row has a pivot among its unknowns a. The others, i, are free, u_a = M_aa⁻¹(g_a − M_ai u_i) with a
    sparse factor of the rows M. With Z spanning the null space of M, ZᵀAZ differs from A_ii only next to the pivots. A
    new set is solved roughly, ten times better than the last one; one that stays exactly.
    """

    def __init__(self, A: SparseMatrix, f: Array, B: SparseMatrix, g: Array) -> None:
        lengths = sp.linalg.norm(B, axis=1)
        self._unit, self._A, self._f, self._g = np.where(lengths > 0.0, lengths, 1.0), sp.csr_array(A), f, g
        self._B = sp.csr_array(sp.diags_array(1.0 / self._unit) @ B)
        self._u, self._base, self._set = np.zeros(len(f)), np.zeros(len(f), bool), np.zeros(0)
        self._share, self._diagonal, self._largest = 1e-2, self._A.diagonal(), sp.linalg.norm(A, np.inf)
        self.noise: Array = np.zeros(len(g))

    @property
    def is_exact(self) -> bool:
        """Whether the last solution was exact; others only show which set is next."""
        return self._share == EXACT

    def __call__(self, active: Indices, fixed: Array | None = None) -> tuple[Array, Array]:
        """The solution u (n,), λ (m,); raises a `RuntimeError` if the rows are dependent."""
        lam, A = np.zeros(len(self._g)) if fixed is None else fixed.copy(), self._A
        load, now, before = self._f - self._B.T @ (self._unit * lam), np.append(active.astype(float), lam), self._set
        self._share = EXACT if np.array_equal(now, before) else max(0.1 * self._share, EXACT)
        pinned, coupling, solve = self._pivots(self._B[active])
        is_free, u = np.ones(len(load), bool), np.zeros(len(load))
        is_free[pinned] = False
        u[pinned] = solve(self._g[active] / self._unit[active], "N")

        def lifted(values: Array) -> Array:
            v = np.zeros(len(load))
            v[is_free] = values
            v[pinned] = -solve(coupling @ v, "N")
            return v

        def reduced(r: Array) -> Array:
            return np.asarray((r - coupling.T @ solve(r[pinned], "T"))[is_free])

        def cycle(residual: Array) -> Array:
            r = np.zeros(len(load))
            r[is_free] = residual
            z = r / self._diagonal
            z[self._base] = self._cycle(r[self._base])
            return np.asarray(z[is_free])

        if is_free.any():
            # The cycle of a set that differs in few rows costs less than another one.
            if 40 * np.count_nonzero(is_free != self._base) > len(active):
                self._base, self._cycle = is_free, _cycle(A[is_free][:, is_free], "A on the free unknowns")
            right = reduced(load - A @ u)
            size = float(np.sqrt(right @ cycle(right)))
            # Ten times the errors in B u: the norm of a row in A⁻¹ is at least its length over the root of that of A.
            self.noise = np.asarray(10.0 * EXACT * size * self._unit / np.sqrt(self._largest))
            goal, start = self._share * size, self._u[is_free]
            u = u + lifted(
                solution(lambda v: reduced(A @ lifted(v)), cycle, right, start, goal, "A on the free unknowns")
            )
        self._u, self._set = u, now
        lam[active] = solve((load - A @ u)[pinned], "T") / self._unit[active]
        return u, lam

    def _pivots(self, rows: SparseMatrix) -> tuple[Indices, SparseMatrix, Callable[[Array, str], Array]]:
        """The pivots of active rows (k×n), large entries, the rows without these, and the solutions with M_aa."""
        if not rows.shape[0]:
            return np.zeros(0, np.intp), rows, lambda r, _: r
        rows.eliminate_zeros()
        touched, places = np.unique(rows.indices, return_inverse=True)
        try:
            costs = sp.csr_array((1.0 - np.log(np.abs(rows.data)), places, rows.indptr))
            pinned = touched[min_weight_full_bipartite_matching(costs)[1]]
            columns = sp.csc_array(rows)
            factor = splu(columns[:, pinned])
        except ValueError:  # there is no matching of all rows
            factor = None
        if factor is None or np.min(np.abs(factor.U.diagonal())) < 1e-12:
            raise RuntimeError("the active constraints are dependent")
        kept = np.ones(rows.shape[1])
        kept[pinned] = 0.0
        return pinned, sp.csr_array(columns @ sp.diags_array(kept)), factor.solve
