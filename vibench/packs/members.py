"""The members A, f, B, g of a model pack as functions of the parameter: constant, affine, or by listed parameter."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError
from vibench.interfaces.affine import AffineSum, Thetas, entries_of
from vibench.interfaces.expressions import Expression

SAME_RTOL = 1e-8
"""Largest distance between a parameter and a listed one that count as the same, relative to the widths of the box.

Far above round-off, since assemblies are timed next to a parameter, far below the distances of listed ones.
"""


@dataclass(frozen=True)
class Listing:
    """The listed parameters (P×d) of a pack, and the widths (d,) of its box."""

    parameters: Array
    widths: Array

    def number(self, mu: Array) -> int:
        """Number of the listed parameter that equals mu (d,).

        Raises
        ------
        NumericalError
            If there is none.
        """
        away = np.abs((self.parameters - mu) / self.widths).max(axis=1)
        nearest = int(away.argmin())
        if not away[nearest] <= SAME_RTOL:
            raise NumericalError(f"the pack has arrays at its listed parameters only; mu = {mu.tolist()} is not listed")
        return nearest


@dataclass(frozen=True)
class Table:
    """A coefficient tabulated (P,) at the listed parameters."""

    listing: Listing
    values: Array

    def __call__(self, mu: Array) -> float:
        """The value at mu (d,), one of the listed parameters."""
        return float(self.values[self.listing.number(mu)])


Theta = Expression | Table


class PackMember(ABC):
    """A matrix or vector that depends on the parameter."""

    @property
    def everywhere(self) -> bool:
        """Whether it can be evaluated at every mu of the box, and not only at listed ones."""
        return True

    @abstractmethod
    def at(self, mu: Array) -> Any:
        """The matrix or vector at mu (d,)."""

    @abstractmethod
    def entries(self, rows: Indices, columns: Indices) -> Callable[[Array], Array]:
        """Function that evaluates these entries (k,) at mu; `columns` is not used for vectors."""

    @property
    @abstractmethod
    def arrays(self) -> Sequence[Any]:
        """All arrays it is made of."""

    @abstractmethod
    def __str__(self) -> str: ...


@dataclass(frozen=True)
class Constant(PackMember):
    """A member that does not depend on the parameter."""

    array: Any

    def at(self, mu: Array) -> Any:  # noqa: ARG002
        """The array."""
        return self.array

    def entries(self, rows: Indices, columns: Indices) -> Callable[[Array], Array]:
        """These entries."""
        values = entries_of(self.array, rows, columns)
        return lambda _: values

    @property
    def arrays(self) -> Sequence[Any]:
        """The array."""
        return (self.array,)

    def __str__(self) -> str:
        return "constant"


@dataclass(frozen=True)
class Affine(PackMember):
    """Σ_q θ_q(µ) · terms_q."""

    thetas: tuple[Theta, ...]
    terms: tuple[Any, ...]

    @property
    def everywhere(self) -> bool:
        """Whether no coefficient is tabulated."""
        return not any(isinstance(theta, Table) for theta in self.thetas)

    @cached_property
    def sum(self) -> AffineSum:
        """The sum, as problems declare it."""
        return AffineSum(self.terms, Thetas(self.thetas))

    def at(self, mu: Array) -> Any:
        """The sum; matrices have the same sparsity pattern, the union of those of the terms, at every mu."""
        return self.sum.at(mu)

    def entries(self, rows: Indices, columns: Indices) -> Callable[[Array], Array]:
        """The sum of these entries of the terms."""
        return self.sum.entries(rows, columns)

    @property
    def arrays(self) -> Sequence[Any]:
        """The terms."""
        return self.terms

    def __str__(self) -> str:
        return f"affine, {len(self.terms)} term{'s' * (len(self.terms) > 1)}"


@dataclass(frozen=True)
class Listed(PackMember):
    """One array per listed parameter."""

    listing: Listing
    values: tuple[Any, ...]

    @property
    def everywhere(self) -> bool:
        """It cannot."""
        return False

    def at(self, mu: Array) -> Any:
        """The array of the listed parameter that equals mu."""
        return self.values[self.listing.number(mu)]

    def entries(self, rows: Indices, columns: Indices) -> Callable[[Array], Array]:
        """These entries, taken out of the array of every listed parameter."""
        values = [entries_of(value, rows, columns) for value in self.values]
        return lambda mu: values[self.listing.number(mu)]

    @property
    def arrays(self) -> Sequence[Any]:
        """The arrays."""
        return self.values

    def __str__(self) -> str:
        return f"one array for each of {len(self.values)} listed parameters"
