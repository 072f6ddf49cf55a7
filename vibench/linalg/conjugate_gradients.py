"""Conjugate gradients, preconditioned by smoothed aggregation of pyamg, where no factor fits in memory.

A near kernel makes the aggregation good for elasticity: the rigid body modes. Where no problem gives them, they are
what a few relaxations of A u = 0 leave of random vectors, beside the constant one.
"""

from __future__ import annotations

import numpy as np
import pyamg
import scipy.sparse as sp

from vibench.arrays import Array, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.factorisations import Factor

TOLERANCE = 1e-14
"""Residual over the right-hand side in the norm of the preconditioner, to which a solution is iterated."""

STAGNATED = 1e-10
"""A residual above this share of the right-hand side in the end is no solution."""

ITERATIONS = 1000

CANDIDATES = 5
"""Random vectors whose smooth parts stand in for rigid body modes."""

SWEEPS = 20

SMALL = 100
"""Matrices of at most so many unknowns are factorised, as dense ones."""


class ConjugateGradients(Factor):
    """Solves with a sparse symmetric positive definite matrix (n×n).

    Parameters
    ----------
    matrix, name
        The matrix, and what messages call it.
    near_kernel
        Vectors (n×k) of small energy, such as rigid body modes; computed by default.

    Raises
    ------
    NumericalError
        If it is seen not to be positive definite, or the iteration does not converge, also where a system is solved.
    """

    def __init__(self, matrix: SparseMatrix, name: str, near_kernel: Array | None = None) -> None:
        self._matrix, self._name = sp.csr_matrix(matrix), name
        kernel = _smooth(self._matrix) if near_kernel is None else near_kernel
        self._levels = pyamg.smoothed_aggregation_solver(self._matrix, B=kernel, symmetry="symmetric", max_coarse=SMALL)
        self._precondition = self._levels.aspreconditioner(cycle="V")
        self.solve(np.random.default_rng(0).standard_normal(matrix.shape[0]))  # an indefinite matrix is seen here

    def solve(self, right: Array) -> Array:
        """X⁻¹ r for right-hand sides (n,) or (n, k)."""
        if right.ndim == 1:
            return self._solve(np.asarray(right, float))
        return np.column_stack([self._solve(column) for column in right.T]) if right.size else np.zeros(right.shape)

    def _solve(self, right: Array) -> Array:
        u, size = np.zeros_like(right), float(np.linalg.norm(right))
        for _ in range(2):  # the residual that the recurrence has lost is solved for once more
            u = u + self._iterate(right - self._matrix @ u, size)
        if not np.linalg.norm(right - self._matrix @ u) <= STAGNATED * size:
            raise NumericalError(f"conjugate gradients do not converge with {self._name}; is it positive definite?")
        return u

    def _iterate(self, residual: Array, size: float) -> Array:
        u = np.zeros_like(residual)
        z = self._precondition @ residual
        direction, product = z.copy(), float(residual @ z)
        for _ in range(ITERATIONS):
            if np.linalg.norm(residual) <= TOLERANCE * size:
                break
            image = self._matrix @ direction
            curvature = float(direction @ image)
            if not (curvature > 0.0 and product > 0.0):
                raise NumericalError(f"{self._name} is not positive definite")
            step = product / curvature
            u, residual = u + step * direction, residual - step * image
            z = self._precondition @ residual
            product, before = float(residual @ z), product
            direction = z + (product / before) * direction
        return u


def _smooth(matrix: SparseMatrix) -> Array:
    """The constant vector and smooth parts (n×k) of random ones."""
    n = matrix.shape[0]
    kernel = np.column_stack([np.ones(n), np.random.default_rng(0).standard_normal((n, CANDIDATES))])
    for column in kernel.T:
        relaxed, zero = np.ascontiguousarray(column), np.zeros(n)
        pyamg.relaxation.relaxation.gauss_seidel(matrix, relaxed, zero, iterations=SWEEPS, sweep="symmetric")
        column[:] = relaxed / np.linalg.norm(relaxed)
    return kernel


class _Dense(Factor):
    def __init__(self, matrix: SparseMatrix, name: str) -> None:
        self._factor = BlockDiagonal(matrix.shape[0], ((np.arange(matrix.shape[0]), matrix.toarray()),)).cholesky(name)

    def solve(self, right: Array) -> Array:
        return self._factor.solve_triangular(self._factor.solve_triangular(right, transposed=True))


def factorise(matrix: SparseMatrix, name: str) -> Factor:
    """What solves with a matrix (n×n); raises a `NumericalError` if it is seen not to be positive definite."""
    return _Dense(matrix, name) if matrix.shape[0] <= SMALL else ConjugateGradients(matrix, name)
