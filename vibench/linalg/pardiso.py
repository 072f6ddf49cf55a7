"""PARDISO of the Intel MKL, by pypardiso: Cholesky's factorisation without pivoting (matrix type 2)."""

from __future__ import annotations

import os
import weakref
from functools import cached_property
from importlib.metadata import PackageNotFoundError, files

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg.definite import BlockDiagonal, Factor, FactoredElimination, checked, dense_cholesky


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

FACTORISE, SOLVE, FORWARD, BACKWARD = 12, 33, 331, 333
"""Phases; the last two are those of L and Lᵀ alone."""

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


class PardisoFactor(Factor):
    """A factor; a `NumericalError` says that the matrix is not positive definite."""

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


class PardisoElimination(FactoredElimination):
    """One factorisation for the Schur complement and for solutions: FORWARD ends with its loads, BACKWARD begins there.

    FORWARD solves with L, so that what it makes of functionals has their inner products in X_ii⁻¹.
    """

    def __init__(self, matrix: SparseMatrix, order: Indices, last: int, name: str) -> None:
        self._matrix = checked(sp.csr_array(matrix)[order][:, order], name)
        self._order, self._split, self._name = order, len(order) - last, name
        self._solver, self._upper = _solver(), _upper(self._matrix)
        weakref.finalize(self, self._solver.free_memory, everything=True).atexit = False
        self._solver.iparm[SCHUR - 1] = 1
        self._solver.perm = np.zeros(len(order), np.int32)  # marks the last ones; overwritten by the permutation
        self._solver.perm[self._split :] = 1
        schur = self._call(FACTORISE, np.zeros((last, last), order="F"))
        self._schur = 0.5 * (schur + schur.T)
        self._entries = int(self._solver.iparm[ENTRIES - 1])

    def _call(self, phase: int, right: Array) -> Array:
        return _call(self._solver, phase, self._upper, np.asfortranarray(right, dtype=float), self._name)

    @property
    def nbytes(self) -> int:
        return 8 * self._entries + 24 * int(self._matrix.nnz) + self._schur.nbytes

    def schur_blocks(self) -> BlockDiagonal:
        bodies = connected_components(self._matrix, directed=False)[1][self._split :]
        if np.all(bodies == bodies[0]):
            return BlockDiagonal(len(bodies), ((np.arange(len(bodies)), self._schur),))
        sets = [np.flatnonzero(bodies == body) for body in np.unique(bodies)]
        return BlockDiagonal(len(bodies), tuple((each, self._schur[np.ix_(each, each)]) for each in sets))

    def eliminate(self, right: Array) -> tuple[Array, Array]:
        ordered, split = np.asarray(right[self._order], float), self._split
        if not ordered[:split].any():  # forces of the contact load no eliminated unknown
            return ordered[:split], ordered[split:]
        solved = self._call(FORWARD, ordered)
        load = solved[split:].copy()
        solved[split:] = 0.0
        return self._call(BACKWARD, solved)[:split], load

    def extend(self, last: Array) -> Array:
        ordered = np.zeros((len(self._order), *last.shape[1:]))
        ordered[self._split :] = last
        u = np.empty_like(ordered)
        u[self._order] = self._call(BACKWARD, ordered) if ordered.size else ordered
        return u

    @cached_property
    def trailing_factor(self) -> Array:
        return dense_cholesky(self._schur, self._name)

    def apply_factor(self, u: Array) -> Array:
        ordered = u[self._order]
        loads = np.asarray(self._matrix @ ordered)
        return np.concatenate([
            self._forward(loads)[: self._split], self.trailing_factor @ ordered[self._split :]
        ])  # fmt: skip

    def solve_factor_transposed(self, right: Array) -> Array:
        solved = self._forward(np.asarray(right[self._order], float))
        last = solved[self._split :]
        if last.size:
            last = scipy.linalg.solve_triangular(self.trailing_factor, last, trans="T", check_finite=False)
        return np.concatenate([solved[: self._split], last])

    def _forward(self, ordered: Array) -> Array:
        return self._call(FORWARD, ordered) if ordered.size else ordered
