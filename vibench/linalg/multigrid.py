"""Conjugate gradients preconditioned by algebraic multigrid (pyamg): seconds and memory linear in the unknowns.

Residuals are measured in the norm of the preconditioner, close to that of A⁻¹, in which they are the energy of the
error. In the Euclidean norm the round-off of A u alone is 1e-10 of a load on a million unknowns. Convergence does not
prove that A is definite: only a direction without energy is noticed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.linalg.blas import daxpy

from vibench.arrays import Array, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.definite import Factor, checked

Product = Callable[[Array], Array]


class Cycle:
    """A symmetric V-cycle of Ruge and Stüben for a sparse symmetric positive definite A (n×n)."""

    def __init__(self, matrix: SparseMatrix, name: str) -> None:
        from pyamg import ruge_stuben_solver  # noqa: PLC0415  an optional library

        rows = checked(matrix, name).T
        self._unit = float(rows.diagonal().max())
        # A preconditioner needs no more digits than single precision, which moves half the bytes.
        rows = sp.csr_matrix(((rows.data / self._unit).astype(np.float32), rows.indices, rows.indptr), rows.shape)
        sweeps = [("gauss_seidel", {"sweep": sweep}) for sweep in ("forward", "backward")]
        hierarchy = ruge_stuben_solver(
            rows, presmoother=sweeps[0], postsmoother=sweeps[1], max_coarse=200, coarse_solver="splu"
        )
        self._cycle = hierarchy.aspreconditioner()

    def __call__(self, residual: Array) -> Array:
        # Residuals of a converged solution would underflow.
        size = float(np.max(np.abs(residual), initial=0.0)) or 1.0
        return np.asarray(self._cycle @ (residual / size).astype(np.float32), float) * (size / self._unit)

    def norm(self, residual: Array) -> float:
        """The norm of a residual (n,), about that in A⁻¹."""
        return float(np.sqrt(max(float(residual @ self(residual)), 0.0)))


class MultigridFactor(Factor):
    """Solutions with a sparse symmetric positive definite X (n×n).

    Raises a `NumericalError` that calls X by `name` as `solution` does, for a random load already when it is made: that
    finds most directions without energy, and proves nothing.
    """

    def __init__(self, matrix: SparseMatrix, name: str) -> None:
        self._matrix, self._name, self._cycle = sp.csr_array(matrix), name, Cycle(matrix, name)
        if matrix.shape[0] <= 1000:
            # The direct solution on the coarsest level hides a direction, which costs little to find.
            SparseCholesky(matrix, name)
        else:
            self.solve_to(np.random.default_rng(0).standard_normal(matrix.shape[0]), 1e-2)

    def solve(self, right: Array) -> Array:
        # The round-off of products with 1e6 unknowns is of this size.
        return self.solve_to(right, 1e-13)

    def solve_to(self, right: Array, accuracy: float) -> Array:
        """Solutions X⁻¹ r for r (n,) or (n, k), to an accuracy relative to their energy."""
        if not right.size:
            return np.zeros_like(right, float)
        columns = np.asarray(right, float).reshape(len(right), -1).T
        solved = [solution(lambda v: self._matrix @ v, self._cycle, column, np.zeros(len(column)),
                           accuracy * self._cycle.norm(column), self._name) for column in columns]  # fmt: skip
        return np.array(solved).reshape(columns.shape).T.reshape(right.shape)


def solution(apply: Product, cycle: Product, right: Array, start: Array, goal: float, name: str) -> Array:
    """The solution x (n,) of A x = r from a first one, until the residual has at most the norm `goal`.

    Raises a `NumericalError` that calls A by `name` if it is seen not to be definite, or the residual stays a thousand
    times above the goal.
    """
    x, before = start.copy(), float("inf")
    while True:
        residual = right - apply(x)
        direction = cycle(residual)
        square = first = float(residual @ direction)
        # Round-off has the last word: the residual that an iteration updates falls below that of its solution.
        if first <= goal**2 or (first <= 1e6 * goal**2 and first > 0.25 * before):
            return x
        if not first <= 0.25 * before:
            raise NumericalError(f"{name}: conjugate gradients stop at {first**0.5:.1e}, above {goal:.1e}")
        before = first
        for _ in range(500):
            image = apply(direction)
            curvature = float(direction @ image)
            if not (curvature > 0.0 and square > 0.0):
                raise NumericalError(f"{name} is not positive definite")
            # In place: arrays of this size are allocated page by page.
            x, residual = daxpy(direction, x, a=square / curvature), daxpy(image, residual, a=-square / curvature)
            z = cycle(residual)
            square, last = float(residual @ z), square
            if square <= goal**2:
                break
            direction = daxpy(direction, z, a=square / last)
        # A few digits are above round-off.
        if square <= goal**2 and square > 1e-16 * first:
            return x
