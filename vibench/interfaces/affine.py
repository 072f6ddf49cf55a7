"""Affine members Σ_q θ_q(mu) · terms_q: matrices or vectors whose dependence on the parameter is declared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.interfaces.expressions import Expression

Theta = float | str | Callable[[Array], float]
"""A coefficient: a number, an expression in the names of the parameters such as "load * sin(angle)", or a function."""


@dataclass(frozen=True)
class Thetas:
    """Coefficients given one by one; a call returns their values (Q,) at a parameter (d,)."""

    functions: tuple[float | Callable[[Array], float], ...]

    @property
    def constant(self) -> bool:
        """Whether all are numbers."""
        return not any(callable(theta) for theta in self.functions)

    def __call__(self, mu: Array) -> Array:
        """Evaluate all at mu (d,)."""
        return np.array([theta(mu) if callable(theta) else theta for theta in self.functions], float)


@dataclass(frozen=True)
class AffineSum:
    """A member Σ_q θ_q(mu) · terms_q of a variational inequality.

    Attributes
    ----------
    terms
        Vectors of one length, or sparse matrices of one shape; at least one.
    thetas
        Function from mu (d,) to θ (Q,). A problem can be copied to another process only if this function can: a lambda
        cannot.

    Raises
    ------
    NumericalError
        If there is no term, or the terms differ in their shapes.
    """

    terms: tuple[Any, ...]
    thetas: Callable[[Array], Any]

    def __post_init__(self) -> None:
        shapes = list(dict.fromkeys(np.shape(term) for term in self.terms))
        if len(shapes) != 1 or len({sp.issparse(term) for term in self.terms}) != 1:
            raise NumericalError(f"the terms of an affine sum have the shapes {shapes}; expected one shape for all")

    @classmethod
    def of(cls, pairs: Sequence[tuple[Theta, Any]], names: Sequence[str]) -> AffineSum:
        """The sum of pairs (θ_q, term_q); expressions are in these names of the parameters.

        Raises
        ------
        RequestError
            If an expression is not arithmetic on numbers and these names.
        NumericalError
            As the class itself.
        """
        thetas = tuple(Expression.parse(theta, names) if isinstance(theta, str) else theta for theta, _ in pairs)
        return cls(tuple(term for _, term in pairs), Thetas(thetas))

    def coefficients(self, mu: Array) -> Array:
        """θ(mu) (Q,).

        Raises
        ------
        NumericalError
            If they are not as many finite numbers as there are terms.
        """
        theta = np.asarray(self.thetas(mu), float)
        if theta.shape != (len(self.terms),) or not np.isfinite(theta).all():
            where = f"at mu = {mu.tolist()}: {theta.tolist()}"
            raise NumericalError(f"{len(self.terms)} terms need as many finite coefficients, found {where}")
        return theta

    def at(self, mu: Array) -> Any:
        """The sum at mu (d,); a matrix has the union of the patterns of the terms at every mu."""
        theta = self.coefficients(mu)
        if isinstance(self.terms[0], np.ndarray):
            return self._columns @ theta
        pattern, values = self._stacked
        return sp.csr_array((values @ theta, pattern.indices, pattern.indptr), shape=pattern.shape)

    @cached_property
    def _columns(self) -> Array:
        """The terms of a vector (n×Q)."""
        return np.stack(self.terms, axis=-1)

    @cached_property
    def _stacked(self) -> tuple[SparseMatrix, SparseMatrix]:
        """The union of the patterns, and the entries of the terms on it (k×Q)."""
        coo = [sp.coo_array(term) for term in self.terms]
        rows, columns = (np.concatenate([term.coords[axis] for term in coo]) for axis in (0, 1))
        shape = self.terms[0].shape
        pattern = sp.csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)
        keys = np.repeat(np.arange(shape[0]), np.diff(pattern.indptr)) * shape[1] + pattern.indices
        places = np.searchsorted(keys, rows.astype(np.int64) * shape[1] + columns)
        number = np.repeat(np.arange(len(coo)), [term.nnz for term in coo])
        data = np.concatenate([term.data for term in coo])
        return pattern, sp.csr_array((data, (places, number)), shape=(len(keys), len(coo)))

    def entries(self, rows: Indices, columns: Indices) -> Callable[[Array], Array]:
        """Function that evaluates these entries (k,) at mu; `columns` is not used for vectors."""
        values = np.stack([entries_of(term, rows, columns) for term in self.terms], axis=-1)
        return lambda mu: np.asarray(values @ self.coefficients(mu))

    def mapped(self, change: Callable[[Any], Any]) -> AffineSum:
        """The sum with a linear map applied to every term."""
        return AffineSum(tuple(change(term) for term in self.terms), self.thetas)


def entries_of(array: Any, rows: Indices, columns: Indices) -> Array:
    """Entries (k,) of a vector or a sparse matrix."""
    if isinstance(array, np.ndarray):
        return array[rows]
    return np.asarray(sp.csr_array(array)[rows, columns]).ravel()
