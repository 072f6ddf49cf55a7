"""Factorisations of sparse symmetric positive definite matrices: one interface, and who implements it.

A factor solves; an elimination condenses a matrix on some unknowns. Whether a matrix is positive definite is proved by
any implementation that factorises: see `is_proved_definite`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError, RequestError, unknown_name
from vibench.linalg import UNIT_ROUND_OFF
from vibench.linalg.banded import is_proved_by_band
from vibench.linalg.cholesky import PartialCholesky, SparseCholesky, elimination_order
from vibench.linalg.definite import BlockDiagonal
from vibench.linalg.inertia import ATTEMPTS, first_shift, proved_positive
from vibench.provenance import distribution_version
from vibench.text import brief

COLUMNS = 128
"""Columns of a Schur complement that are solved for at once, where an implementation has no better way to it."""


class Factor(ABC):
    """A factor of a sparse symmetric positive definite X (n×n)."""

    @abstractmethod
    def solve(self, right: Array) -> Array:
        """X⁻¹ r for right-hand sides (n,) or (n, k)."""

    def entries(self, n: int) -> float:
        """At most how many entries the triangular factor of a matrix (n×n) has."""
        return n * (n + 1.0) / 2.0


class Elimination(ABC):
    """A sparse symmetric positive definite X (n×n) of which all unknowns i but the last ones c are eliminated."""

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Memory of the factors."""

    @abstractmethod
    def schur_blocks(self) -> BlockDiagonal:
        """The Schur complement S = X_cc − X_ci X_ii⁻¹ X_ic (c×c), body by body."""

    @abstractmethod
    def eliminate(self, right: Array) -> tuple[Array, Array]:
        """For r (n,) or (n, k), X_ii⁻¹ r_i and the load of the Schur complement, r_c − X_ci X_ii⁻¹ r_i."""

    @abstractmethod
    def extend(self, last: Array) -> Array:
        """Solution (n,) or (n, k) of X u = 0 in the rows of i, with u (c,) or (c, k) given on the last unknowns."""


class FactoredElimination(Elimination):
    """An elimination with a factor F of X = FᵀF that is upper triangular in its order; the last unknowns end that."""

    @property
    @abstractmethod
    def trailing_factor(self) -> Array:
        """The trailing block F_cc (c×c) of F, upper triangular, with F_ccᵀF_cc = S.

        Raises a `NumericalError` if S, and with it X, is not positive definite.
        """

    @abstractmethod
    def apply_factor(self, u: Array) -> Array:
        """F u, for u (n,) or (n, k): first the entries of i."""

    @abstractmethod
    def solve_factor_transposed(self, right: Array) -> Array:
        """F⁻ᵀ r, for r (n,) or (n, k); of a functional on the last unknowns only the last entries are not zero."""


class _Empty(Factor):
    """The factor of a matrix without unknowns."""

    def solve(self, right: Array) -> Array:
        return np.zeros_like(right, dtype=float)


FactoredElimination.register(PartialCholesky)
Factor.register(SparseCholesky)


@dataclass(frozen=True)
class Implementation:
    """Who factorises.

    Attributes
    ----------
    name
        Its name in studies.
    summary
        What it is, in a line.
    module
        Defines `factorise(matrix, name)`, and `eliminate(matrix, order, last, name)`, a `FactoredElimination`, if there
        is a better one than by solutions with X_ii. Both raise a `NumericalError` that calls the matrix by `name` if it
        is not positive definite.
    distribution
        The distribution it needs; "" if vibench needs that anyway.
    is_direct
        Whether it factorises, without pivoting: then a factorisation proves that a matrix is definite.
    """

    name: str
    summary: str
    module: str
    distribution: str = ""
    is_direct: bool = True

    @property
    def is_installed(self) -> bool:
        """Whether it can be used here."""
        return not self.distribution or bool(distribution_version(self.distribution))

    def factorise(self, matrix: SparseMatrix, name: str) -> Factor:
        """A factor of a sparse symmetric matrix (n×n), which messages call by `name`.

        Raises a `NumericalError` if it is not positive definite, or has an entry that is not finite.
        """
        if not self.module:
            return SparseCholesky(checked(matrix, name), name)  # type: ignore[return-value]
        return self._own.factorise(checked(matrix, name), name) if matrix.shape[0] else _Empty()

    def eliminate(self, matrix: SparseMatrix, order: Indices, last: int, name: str) -> Elimination:
        """`matrix` (n×n) in an `order` (n,) with all unknowns but the last ones eliminated; raises as `factorise`."""
        if not self.module:
            return PartialCholesky(matrix, order, last, name)  # type: ignore[return-value]
        if self._has_factor(len(order), last):
            return self._own.eliminate(matrix, order, last, name)
        return EliminationBySolutions(self, matrix, order, last, name)

    def eliminate_with_factor(self, matrix: SparseMatrix, last: Indices, name: str) -> FactoredElimination:
        """`matrix` (n×n) with all unknowns but `last` (c,) eliminated; by the default where this one shows no factor.

        Raises as `factorise`.
        """
        chosen = self if self._has_factor(matrix.shape[0], len(last)) else IMPLEMENTATIONS[DEFAULT]
        return chosen.eliminate(matrix, chosen.order(matrix, last), len(last), name)  # type: ignore[return-value]

    def _has_factor(self, n: int, last: int) -> bool:
        return not self.module or (0 < last < n and hasattr(self._own, "eliminate"))

    def order(self, matrix: SparseMatrix, last: Indices) -> Indices:
        """An order (n,) for `eliminate` that ends with the unknowns `last` (c,); of others each has its own."""
        if self.module:
            return np.concatenate([np.setdiff1d(np.arange(matrix.shape[0]), last), last])
        return elimination_order(matrix, last)

    @cached_property
    def _own(self) -> _Module:
        return import_module(self.module)  # type: ignore[return-value]


class _Module:
    """What a module of an implementation has."""

    factorise: Callable[[SparseMatrix, str], Factor]
    eliminate: Callable[[SparseMatrix, Indices, int, str], FactoredElimination]


IMPLEMENTATIONS = {
    one.name: one
    for one in (
        Implementation("superlu", "SuperLU of SciPy", ""),
        Implementation("pardiso", "PARDISO of the Intel MKL", "vibench.linalg.pardiso", "pypardiso"),
        Implementation("cholmod", "CHOLMOD, supernodal", "vibench.linalg.cholmod", "kvxopt"),
        Implementation(
            "conjugate-gradients",
            "conjugate gradients with smoothed aggregation, for matrices whose factors do not fit in memory",
            "vibench.linalg.conjugate_gradients", "pyamg", is_direct=False,
        ),
    )
}  # fmt: skip
"""All implementations by name, the default first."""

DEFAULT: str = next(iter(IMPLEMENTATIONS))

AVAILABLE = "available"
"""Asks for the first of `PREFERRED` that is installed."""

PREFERRED = ("pardiso", "cholmod", "superlu")


def implementation(name: str) -> Implementation:
    """The implementation of a name; raises a `RequestError` if there is none."""
    if not isinstance(name, str):
        raise RequestError(f"the factorisation is {brief(repr(name), 80)}, expected the name of one")
    if name == AVAILABLE:
        return next(IMPLEMENTATIONS[one] for one in PREFERRED if IMPLEMENTATIONS[one].is_installed)
    if name not in IMPLEMENTATIONS:
        raise unknown_name("factorisation", name, [*IMPLEMENTATIONS, AVAILABLE])
    return IMPLEMENTATIONS[name]


def checked(matrix: SparseMatrix, name: str) -> SparseMatrix:
    """The matrix (CSC); a `NumericalError` if an entry is not finite, or a pivot at sight not positive."""
    matrix = sp.csc_array(matrix)
    if not np.all(np.isfinite(matrix.data)):
        raise NumericalError(f"{name} has entries that are not finite")
    if not np.all(matrix.diagonal() > 0.0):
        raise NumericalError(f"{name} is not positive definite")
    return matrix


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
        """Memory of the matrix; that of the factors is not known."""
        return 12 * int(self._matrix.nnz)

    def schur_blocks(self) -> BlockDiagonal:
        """The Schur complement, body by body."""
        split, bodies = self._split, connected_components(self._matrix, directed=False)[1]
        blocks = []
        for body in np.unique(bodies[split:]):
            inside = np.flatnonzero(bodies == body)
            unknowns = inside[inside >= split] - split
            blocks.append((unknowns, self._schur(sp.csc_array(self._matrix[inside][:, inside]), len(unknowns))))
        return BlockDiagonal(len(self._order) - split, tuple(blocks))

    def _schur(self, matrix: SparseMatrix, count: int) -> Array:
        split = matrix.shape[0] - count
        schur = matrix[split:, split:].toarray(order="F")
        if split:
            factor, coupling = self._chosen.factorise(matrix[:split, :split], self._name), matrix[:split, split:]
            for columns in _slices(count):
                schur[:, columns] -= coupling.T @ factor.solve(coupling[:, columns].toarray())
        return np.asarray(0.5 * (schur + schur.T))

    def eliminate(self, right: Array) -> tuple[Array, Array]:
        """The solution in i and the load on c."""
        first, last = np.asarray(right[self._order[: self._split]], float), right[self._order[self._split :]]
        if self._factor is None or not first.any():
            return np.zeros_like(first), np.asarray(last, float)
        solved = self._factor.solve(first)
        return solved, last - self._coupling @ solved

    def extend(self, last: Array) -> Array:
        """All unknowns from the last ones."""
        u = np.empty((len(self._order), *last.shape[1:]))
        if self._factor is not None:
            u[self._order[: self._split]] = -self._factor.solve(np.asarray(self._coupling.T @ last))
        u[self._order[self._split :]] = last
        return u


def _slices(count: int) -> Iterator[slice]:
    return (slice(first, first + COLUMNS) for first in range(0, count, COLUMNS))


def is_proved_definite(parts: Sequence[SparseMatrix], chosen: Implementation, order: Indices | None = None) -> bool:
    """Whether the sum of symmetric matrices (n×n) is proved to be positive definite, whatever the round-off.

    By default a narrow band is factorised (`vibench.linalg.banded`), or factors of SuperLU, which stands in for what
    factorises nothing, are looked at (`vibench.linalg.inertia`), in an `order` (n,) if given. Of the others nothing is
    known but that they compute a Cholesky factorisation. If it ends for the computed D⁻¹XD⁻¹ − cI, D² being the
    diagonal of X, then X is definite, with c the sum of the round-off of summing and scaling and of the factorisation,
    Σ_j γ / (1 − γ) with γ_k of k = t_j + 1 and t_j entries in column j of the factor (Rump, "Verification of positive
    definiteness", BIT Numerical Mathematics 46, 2006, §2): about u times the number of all entries. An LU factorisation
    has no such bound, since its two factors differ by round-off.
    """
    if not chosen.module or not chosen.is_direct:
        if (found := is_proved_by_band(parts)) is not None:
            return found
        diagonal = np.asarray(sum(part.diagonal() for part in parts))
        return bool(np.all(diagonal > 0.0)) and proved_positive(parts, np.sqrt(diagonal), order) == len(diagonal)
    try:
        matrix = checked(sum(sp.csc_array(part) for part in parts), "")
        scale = sp.diags_array(1.0 / np.sqrt(matrix.diagonal()), format="csc")
        sizes = scale @ sum(abs(sp.csc_array(part)) for part in parts) @ scale
        scaled = sp.csc_array(scale @ (0.5 * (matrix + matrix.T)) @ scale)
        rounded = (8.0 + 2.0 * len(parts)) * UNIT_ROUND_OFF * float(np.max(sizes.sum(axis=0), initial=0.0))
        shift, identity = first_shift(scaled), sp.eye_array(matrix.shape[0], format="csc")
        for _ in range(ATTEMPTS):
            factor = chosen.factorise(sp.csc_array(scaled - shift * identity), "")
            error = 1.01 * (2.0 * UNIT_ROUND_OFF * (factor.entries(matrix.shape[0]) + matrix.shape[0]) + rounded)
            if error <= shift:
                return True
            shift = 1.01 * error
    except NumericalError:
        pass
    return False
