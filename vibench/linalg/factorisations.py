"""Factorisations of sparse symmetric positive definite matrices: one interface and its implementations.

A factor solves; an elimination condenses a matrix on some unknowns.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from importlib import import_module
from typing import Any, ClassVar, cast

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError, RequestError, UnsupportedError, foreign, unknown_name
from vibench.linalg.cholesky import OrderedFactor, OrderedLU, PartialCholesky, SparseCholesky, elimination_order
from vibench.linalg.definite import BlockDiagonal, Elimination, Factor, FactoredElimination, checked
from vibench.linalg.multigrid import MultigridFactor
from vibench.provenance import distribution_version
from vibench.text import shown


class _Empty(Factor):
    """The factor of a matrix without unknowns."""

    def solve(self, right: Array) -> Array:
        return np.zeros_like(right, dtype=float)


class Implementation(ABC):
    """A library that factorises without pivoting, with its `name` in studies and a line about it.

    `distribution` is what it needs; "" if vibench needs that anyway. One that `is_iterative` proves nothing. All
    methods raise a `NumericalError` that calls the matrix by a name if it is not positive definite.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    distribution: ClassVar[str] = ""
    module: ClassVar[str] = __name__
    is_iterative: ClassVar[bool] = False

    @cached_property
    def fault(self) -> str:
        """Reason why its module cannot be imported; "" if it can."""
        try:
            with foreign(f"the factorisation '{self.name}' cannot be used"):
                import_module(self.module)
        except UnsupportedError as error:
            return str(error)
        return ""

    @property
    def is_installed(self) -> bool:
        """Whether it can be used here."""
        return not self.distribution or bool(distribution_version(self.distribution))

    def factorise(self, matrix: SparseMatrix, name: str) -> Factor:
        """Return a factor of a sparse symmetric matrix (n×n), all of whose entries have to be finite."""
        matrix = checked(matrix, name)
        return self._factor(matrix, name) if matrix.shape[0] else _Empty()

    @abstractmethod
    def _factor(self, matrix: SparseMatrix, name: str) -> Factor: ...

    def eliminate(self, matrix: SparseMatrix, order: Indices, last: int, name: str) -> Elimination:
        """Eliminate all unknowns of a `matrix` (n×n) in an `order` (n,) but the last ones."""
        return EliminationBySolutions(self, matrix, order, last, name)

    def eliminate_with_factor(self, matrix: SparseMatrix, last: Indices, name: str) -> FactoredElimination:
        """Eliminate all unknowns of a `matrix` (n×n) but `last` (c,), by the default where this one shows no factor."""
        return IMPLEMENTATIONS[DEFAULT].eliminate_with_factor(matrix, last, name)

    def in_order(self, matrix: SparseMatrix) -> OrderedFactor:
        """Factorise a symmetric `matrix` (k×k, CSC) in its natural order; not every one has pivots.

        Raises a `RuntimeError` if it is exactly singular.
        """
        return OrderedLU(matrix)

    def order(self, matrix: SparseMatrix, last: Indices) -> Indices:
        """Return an order (n,) for `eliminate` that ends with the unknowns `last` (c,)."""
        # Libraries order the others themselves.
        return np.concatenate([np.setdiff1d(np.arange(matrix.shape[0]), last), last])


class _SuperLU(Implementation):
    name, summary = "superlu", "SuperLU of SciPy"

    def _factor(self, matrix: SparseMatrix, name: str) -> Factor:
        return SparseCholesky(matrix, name)

    def eliminate(self, matrix: SparseMatrix, order: Indices, last: int, name: str) -> FactoredElimination:
        return PartialCholesky(matrix, order, last, name)

    def eliminate_with_factor(self, matrix: SparseMatrix, last: Indices, name: str) -> FactoredElimination:
        return self.eliminate(matrix, self.order(matrix, last), len(last), name)

    def order(self, matrix: SparseMatrix, last: Indices) -> Indices:
        return elimination_order(matrix, last)


class _Pardiso(Implementation):
    name, summary, distribution = "pardiso", "PARDISO of the Intel MKL", "pypardiso"
    module = "vibench.linalg.pardiso"

    def _factor(self, matrix: SparseMatrix, name: str) -> Factor:
        from vibench.linalg.pardiso import PardisoFactor  # noqa: PLC0415  an optional library

        return PardisoFactor(matrix, name)

    def eliminate(self, matrix: SparseMatrix, order: Indices, last: int, name: str) -> Elimination:
        if not 0 < last < len(order):  # PARDISO has no Schur complement of no unknown or of all
            return super().eliminate(matrix, order, last, name)
        from vibench.linalg.pardiso import PardisoElimination  # noqa: PLC0415

        return PardisoElimination(matrix, order, last, name)

    def eliminate_with_factor(self, matrix: SparseMatrix, last: Indices, name: str) -> FactoredElimination:
        if not 0 < len(last) < matrix.shape[0]:
            return super().eliminate_with_factor(matrix, last, name)
        from vibench.linalg.pardiso import PardisoElimination  # noqa: PLC0415

        return PardisoElimination(matrix, self.order(matrix, last), len(last), name)


class _Cholmod(Implementation):
    name, summary, distribution = "cholmod", "CHOLMOD", "cvxopt"
    module = "cvxopt.cholmod"

    def _factor(self, matrix: SparseMatrix, name: str) -> Factor:
        return CholmodFactor(matrix, name)

    def in_order(self, matrix: SparseMatrix) -> OrderedFactor:
        return OrderedCholmod(matrix)


class _CholmodSolver:
    """Factors of a sparse symmetric matrix (n×n) by CHOLMOD of SuiteSparse, in an `order` (n,) or one of its own.

    Raises an `ArithmeticError` if a pivot vanishes, or is negative in a supernodal factor.
    """

    def __init__(self, matrix: SparseMatrix, order: Indices | None = None, **options: int) -> None:
        from cvxopt import base, cholmod  # noqa: PLC0415  an optional library

        matrix, self._library, self._dense = sp.csc_array(matrix), cholmod, base.matrix
        rows, columns = matrix.indices, np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
        lower, sparse = rows >= columns, cast("Any", base.spmatrix)
        parts = (matrix.data.astype(float), rows.astype(int), columns)
        entries = sparse(*(self._dense(cast("Any", part[lower])) for part in parts), matrix.shape)
        before, given = dict(cholmod.options), () if order is None else (self._dense(cast("Any", order)),)
        # Options of this library are global.
        cholmod.options.update(options)
        try:
            self._symbolic = cholmod.symbolic(entries, *given)
            cholmod.numeric(entries, self._symbolic)
        finally:
            cholmod.options.clear()
            cholmod.options.update(before)

    def solve(self, right: Array, system: int = 0) -> Array:
        """Solve with all factors, or one `system`: 4 is L, 6 is D."""
        if not right.size:
            return np.zeros_like(right, dtype=float)
        columns: Any = np.asfortranarray(right.reshape(len(right), -1), dtype=float)
        solution = self._dense(columns)
        self._library.solve(self._symbolic, solution, system)
        return np.ascontiguousarray(np.array(solution).reshape(columns.shape)).reshape(right.shape)


class CholmodFactor(_CholmodSolver, Factor):
    """A supernodal Cholesky factor by CHOLMOD."""

    def __init__(self, matrix: SparseMatrix, name: str) -> None:
        try:
            super().__init__(matrix)
            # Only the diagonal raises where the factorisation has stopped before its end.
            self._library.diag(self._symbolic)
        except (ArithmeticError, ValueError):
            raise NumericalError(f"{name} is not positive definite") from None


class OrderedCholmod(_CholmodSolver, OrderedFactor):
    """Factors by CHOLMOD, column by column, which may have negative pivots; all are NaN where one vanishes."""

    def __init__(self, matrix: SparseMatrix) -> None:
        order = np.arange(matrix.shape[0])
        try:
            # Neither compare the order with others nor change it.
            super().__init__(matrix, order, supernodal=0, nmethods=1, postorder=False)
        except ArithmeticError:
            self.pivots = np.full(len(order), np.nan)
        else:
            self.pivots = 1.0 / self.solve(np.ones(len(order)), 6)

    def squares(self, functionals: Array) -> Array:
        n = len(functionals)
        solved = self.solve(np.pad(functionals, ((0, len(self.pivots) - n), (0, 0))), 4)[:n]
        return np.asarray((1.0 / self.pivots[:n]) @ solved**2)


class _Multigrid(Implementation):
    name, summary, distribution = "multigrid", "conjugate gradients, multigrid", "pyamg"
    module, is_iterative = "pyamg", True

    def _factor(self, matrix: SparseMatrix, name: str) -> Factor:
        return MultigridFactor(matrix, name)

    def eliminate(self, matrix: SparseMatrix, order: Indices, last: int, name: str) -> Elimination:
        # A solution for every column of a Schur complement takes a factor.
        return EliminationBySolutions(IMPLEMENTATIONS[DEFAULT], matrix, order, last, name)


IMPLEMENTATIONS: dict[str, Implementation] = {
    one.name: one for one in (_SuperLU(), _Pardiso(), _Cholmod(), _Multigrid())
}
DEFAULT: str = next(iter(IMPLEMENTATIONS))


def implementation(name: str) -> Implementation:
    """Return the implementation of a name, or the fastest one that is "available".

    Raises a `RequestError` if there is none of this name.
    """
    if not isinstance(name, str):
        raise RequestError(f"the factorisation is {shown(name)}, expected the name of one")
    if name == "available":
        fastest_first = (IMPLEMENTATIONS[one] for one in ("pardiso", "cholmod", DEFAULT))
        return next(one for one in fastest_first if one.is_installed and not one.fault)
    if name not in IMPLEMENTATIONS:
        raise unknown_name("factorisation", name, [*IMPLEMENTATIONS, "available"])
    return IMPLEMENTATIONS[name]


class EliminationBySolutions(Elimination):
    """An elimination that solves with a factor of X_ii; arguments are those of `Implementation.eliminate`."""

    def __init__(self, chosen: Implementation, matrix: SparseMatrix, order: Indices, last: int, name: str) -> None:
        self._chosen, self._order, self._name, self._split = chosen, order, name, len(order) - last
        self._matrix = checked(sp.csr_array(matrix)[order][:, order], name)
        split = self._split
        self._coupling = sp.csr_array(self._matrix[split:, :split])
        self._factor = chosen.factorise(self._matrix[:split, :split], name) if split else None

    @property
    def nbytes(self) -> int:
        return 12 * int(self._matrix.nnz)

    def schur_blocks(self) -> BlockDiagonal:
        split, bodies = self._split, connected_components(self._matrix, directed=False)[1]
        blocks = []
        for body in np.unique(bodies[split:]):
            inside = np.flatnonzero(bodies == body)
            unknowns = inside[inside >= split] - split
            matrix, eliminated = sp.csc_array(self._matrix[inside][:, inside]), len(inside) - len(unknowns)
            schur = matrix[eliminated:, eliminated:].toarray(order="F")
            if eliminated:
                coupling = matrix[:eliminated, eliminated:]
                factor = self._chosen.factorise(matrix[:eliminated, :eliminated], self._name)
                # Solve for some columns at once: the dense right-hand side of all may not fit in memory.
                for columns in (slice(first, first + 128) for first in range(0, len(unknowns), 128)):
                    schur[:, columns] -= coupling.T @ factor.solve(coupling[:, columns].toarray())
            blocks.append((unknowns, np.asarray(0.5 * (schur + schur.T))))
        return BlockDiagonal(len(self._order) - split, tuple(blocks))

    def eliminate(self, right: Array) -> tuple[Array, Array]:
        first, last = np.asarray(right[self._order[: self._split]], float), right[self._order[self._split :]]
        if self._factor is None or not first.any():
            return np.zeros_like(first), np.asarray(last, float)
        solved = self._factor.solve(first)
        return solved, last - self._coupling @ solved

    def extend(self, last: Array) -> Array:
        u = np.empty((len(self._order), *last.shape[1:]))
        if self._factor is not None:
            u[self._order[: self._split]] = -self._factor.solve(np.asarray(self._coupling.T @ last))
        u[self._order[self._split :]] = last
        return u
