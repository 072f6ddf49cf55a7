"""PARDISO of the Intel MKL, by pypardiso: Cholesky's factorisation without pivoting (matrix type 2)."""

from __future__ import annotations

import os
import weakref
from functools import cached_property
from importlib.metadata import PackageNotFoundError, files
from math import sqrt

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.linalg import UNIT_ROUND_OFF
from vibench.linalg.definite import BlockDiagonal, Factor, FactoredElimination, checked, dense_cholesky


def _library() -> str:
    """Path of the MKL; "" if that is not known."""
    try:
        names = [str(file.locate()) for file in files("mkl") or () if file.name.startswith(("libmkl_rt.", "mkl_rt."))]
    except PackageNotFoundError:
        return ""
    return os.path.realpath(names[0]) if names else ""


# pypardiso loads the MKL when it is imported, and searches only the folder of Python, which has none in an environment
# on top of another.
if "PYPARDISO_MKL_RT" not in os.environ and (_place := _library()):
    os.environ["PYPARDISO_MKL_RT"] = _place

from pypardiso import PyPardisoSolver  # noqa: E402
from pypardiso.pardiso_wrapper import PyPardisoError  # noqa: E402


class _Factorised:
    """A matrix (n×n) factorised by PARDISO, up to the Schur complement of its `last` unknowns if there are some."""

    def __init__(self, matrix: SparseMatrix, name: str, last: int) -> None:
        upper = sp.csr_matrix(sp.triu(matrix, format="csr"))
        upper.sort_indices()
        self._solver, self._upper, self._name = PyPardisoSolver(mtype=2), upper, name
        # Python does not see this memory, so that nothing else would free it.
        weakref.finalize(self, self._solver.free_memory, everything=True).atexit = False
        # Set all of `iparm`: its defaults, those of `iparm(1) = 0`, are wrong since 2025. The order is METIS's, entries
        # of factors are counted, and definite matrices need no scaling, matching or refinement.
        self._solver.iparm[:] = 0
        for number, value in ((1, 1), (2, 2), (10, 8), (18, -1), (21, 1), (36, int(last > 0))):
            self._solver.iparm[number - 1] = value
        if last:
            self._solver.perm = np.zeros(matrix.shape[0], np.int32)  # overwritten by the permutation
            self._solver.perm[-last:] = 1
        self._schur = self._call(12, np.zeros((last, last) if last else (matrix.shape[0], 1), order="F"))
        self._entries = int(self._solver.iparm[17])

    def _call(self, phase: int, right: Array) -> Array:
        """The result of a phase: 12 factorises, 33 solves, 331 and 333 solve with L and with Lᵀ alone."""
        if not right.size:
            return np.zeros_like(right, dtype=float)
        self._solver.set_phase(phase)
        try:
            return np.asarray(self._solver._call_pardiso(self._upper, np.asfortranarray(right, dtype=float)))
        except PyPardisoError as error:
            raise NumericalError(f"{self._name} is not positive definite (PARDISO: error {error.value})") from None


class PardisoFactor(_Factorised, Factor):
    """A factor by PARDISO."""

    def __init__(self, matrix: SparseMatrix, name: str) -> None:
        super().__init__(matrix, name, 0)

    def entries(self, n: int) -> float:
        return self._entries if self._entries > 0 else super().entries(n)

    def solve(self, right: Array) -> Array:
        return self._call(33, right)


class PardisoElimination(_Factorised, FactoredElimination):
    """One factorisation for the Schur complement and for solutions: with L until its loads, with Lᵀ from there."""

    def __init__(self, matrix: SparseMatrix, order: Indices, last: int, name: str) -> None:
        self._matrix = checked(sp.csr_array(matrix)[order][:, order], name)
        self._order, self._split = order, len(order) - last
        super().__init__(self._matrix, name, last)
        self._schur = 0.5 * (self._schur + self._schur.T)

    @property
    def nbytes(self) -> int:
        return 8 * self._entries + 24 * int(self._matrix.nnz) + self._schur.nbytes

    def schur_blocks(self) -> BlockDiagonal:
        bodies = connected_components(self._matrix, directed=False)[1][self._split :]
        if np.all(bodies == bodies[0]):  # saves a copy of a large matrix
            return BlockDiagonal(len(bodies), ((np.arange(len(bodies)), self._schur),))
        sets = [np.flatnonzero(bodies == body) for body in np.unique(bodies)]
        return BlockDiagonal(len(bodies), tuple((each, self._schur[np.ix_(each, each)]) for each in sets))

    def eliminate(self, right: Array) -> tuple[Array, Array]:
        ordered, split = np.asarray(right[self._order], float), self._split
        if not ordered[:split].any():  # contact forces load no eliminated unknown
            return ordered[:split], ordered[split:]
        solved = self._call(331, ordered)
        load = solved[split:].copy()
        solved[split:] = 0.0
        return self._call(333, solved)[:split], load

    def extend(self, last: Array) -> Array:
        ordered = np.zeros((len(self._order), *last.shape[1:]))
        ordered[self._split :] = last
        u = np.empty_like(ordered)
        u[self._order] = self._call(333, ordered)
        return u

    def backward_errors(self, squares: Array) -> tuple[float, float]:  # noqa: ARG002
        count, last = len(self._order), len(self._order) - self._split
        entries = (self._entries if self._entries > 0 else 0.5 * count * (count + 1.0)) + last**2
        # the sum over columns of γ_{t+1} of t entries (Rump 2006); no column has more terms than there are unknowns
        terms = sqrt((count + 8.0) * (entries + 8.0 * count))
        return 1.01 * UNIT_ROUND_OFF * (entries + 2.0 * count), 2.2 * UNIT_ROUND_OFF * terms

    @cached_property
    def trailing_factor(self) -> Array:
        return dense_cholesky(self._schur, self._name)

    def apply_factor(self, u: Array) -> Array:
        ordered = u[self._order]
        first = self._call(331, np.asarray(self._matrix @ ordered))[: self._split]
        return np.concatenate([first, self.trailing_factor @ ordered[self._split :]])

    def solve_factor_transposed(self, right: Array) -> Array:
        solved = self._call(331, np.asarray(right[self._order], float))
        last = solved[self._split :]
        if last.size:
            last = scipy.linalg.solve_triangular(self.trailing_factor, last, trans="T", check_finite=False)
        return np.concatenate([solved[: self._split], last])
