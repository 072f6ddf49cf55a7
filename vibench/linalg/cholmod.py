"""CHOLMOD of SuiteSparse, by kvxopt: supernodal Cholesky's factorisation."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from kvxopt import cholmod
from kvxopt.base import matrix, spmatrix

from vibench.arrays import Array, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.factorisations import Factor


class _Cholmod(Factor):
    def __init__(self, given: SparseMatrix, name: str) -> None:
        lower = sp.coo_array(sp.tril(given))
        rows, columns = lower.coords
        values: list[Any] = [matrix(part) for part in (lower.data.astype(float), rows.astype(int), columns.astype(int))]
        make: Any = spmatrix
        entries = make(*values, given.shape)
        self._factor = cholmod.symbolic(entries)
        try:
            cholmod.numeric(entries, self._factor)
            cholmod.diag(self._factor)  # which alone raises where the factorisation has stopped before its end
        except (ArithmeticError, ValueError):
            raise NumericalError(f"{name} is not positive definite") from None

    def solve(self, right: Array) -> Array:
        if not right.size:
            return np.zeros_like(right, dtype=float)
        columns: Any = np.asfortranarray(right.reshape(len(right), -1), dtype=float)
        solution = matrix(columns)
        cholmod.solve(self._factor, solution)
        return np.ascontiguousarray(np.array(solution).reshape(columns.shape)).reshape(right.shape)


def factorise(given: SparseMatrix, name: str) -> Factor:
    """A factor of a matrix (n×n); raises a `NumericalError` if it is not positive definite."""
    return _Cholmod(given, name)
