"""PARDISO of the Intel MKL, by pypardiso: Cholesky's factorisation without pivoting (matrix type 2)."""

from __future__ import annotations

import os
import weakref
from importlib.metadata import PackageNotFoundError, files

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.factorisations import Factor


def _library() -> str:
    """Where the MKL is installed; "" if that is not known."""
    try:
        names = [str(file.locate()) for file in files("mkl") or () if file.name.startswith(("libmkl_rt.", "mkl_rt."))]
    except PackageNotFoundError:
        return ""
    return os.path.realpath(names[0]) if names else ""


# pypardiso, which loads it at once, looks in the folder of Python alone, where an environment on another has none
if "PYPARDISO_MKL_RT" not in os.environ and (_place := _library()):
    os.environ["PYPARDISO_MKL_RT"] = _place

from pypardiso import PyPardisoSolver  # noqa: E402
from pypardiso.pardiso_wrapper import PyPardisoError  # noqa: E402

FACTORISE, SOLVE = 12, 33
"""Phases."""

PARAMETERS = {1: 1, 2: 2, 8: 0, 10: 8, 18: -1, 21: 1, 27: 0, 35: 0}
"""`iparm` by number, all others are 0. None is a default of the MKL: those of `iparm(1) = 0` are wrong since 2025. The
order is that of METIS; entries of factors are counted; definite matrices need no scaling, matching or refinement;
indices begin with one."""

ENTRIES, SCHUR = 18, 36
"""`iparm` of the number of entries of a factor, and of the Schur complement of the unknowns that `perm` marks."""


def _solver() -> PyPardisoSolver:
    solver = PyPardisoSolver(mtype=2)
    solver.iparm[:] = 0
    for number, value in PARAMETERS.items():
        solver.iparm[number - 1] = value
    return solver


def _upper(matrix: SparseMatrix) -> SparseMatrix:
    upper = sp.csr_matrix(sp.triu(matrix, format="csr"))
    upper.sort_indices()
    return upper


def _call(solver: PyPardisoSolver, phase: int, upper: SparseMatrix, right: Array, name: str) -> Array:
    solver.set_phase(phase)
    try:
        return np.asarray(solver._call_pardiso(upper, right))
    except PyPardisoError as error:
        raise NumericalError(f"{name} is not positive definite (PARDISO: error {error.value})") from None


class _Pardiso(Factor):
    def __init__(self, matrix: SparseMatrix, name: str) -> None:
        self._solver, self._upper, self._name = _solver(), _upper(matrix), name
        weakref.finalize(self, self._solver.free_memory, everything=True).atexit = False  # memory that NumPy has not
        _call(self._solver, FACTORISE, self._upper, np.zeros((matrix.shape[0], 1)), name)
        self._entries = int(self._solver.iparm[ENTRIES - 1])

    def entries(self, n: int) -> float:
        return self._entries if self._entries > 0 else super().entries(n)

    def solve(self, right: Array) -> Array:
        if not right.size:
            return np.zeros_like(right, dtype=float)
        return _call(self._solver, SOLVE, self._upper, np.asfortranarray(right, dtype=float), self._name)


def factorise(matrix: SparseMatrix, name: str) -> Factor:
    """A factor of a matrix (n×n); raises a `NumericalError` if it is not positive definite."""
    return _Pardiso(matrix, name)


def schur(matrix: SparseMatrix, count: int, name: str) -> Array:
    """The Schur complement (k×k) of all unknowns but the last ones; raises as `factorise` of them does."""
    solver = _solver()
    solver.iparm[SCHUR - 1] = 1
    solver.perm = np.zeros(matrix.shape[0], np.int32)
    solver.perm[matrix.shape[0] - count :] = 1
    try:
        found = _call(solver, FACTORISE, _upper(matrix), np.zeros((count, count), order="F"), name)
    finally:
        solver.free_memory(everything=True)
    return np.asarray(0.5 * (found + found.T))
