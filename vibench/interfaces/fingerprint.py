"""Fingerprint of an assembled problem: equal for equal numbers, small enough to be stored with the solutions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.problem import MEMBERS, Problem, VariationalInequality

AGREEMENT_RTOL = 1e-9
"""Largest difference relative to the largest entry; other processors may round otherwise, other meshes differ by 1."""


@dataclass(frozen=True)
class Fingerprint:
    """Products M v of A, B, X_V and X_W with a fixed vector v, and f and g themselves; `scales` are largest entries.

    The entries of v are distinct, so that a permutation of unknowns changes the products.
    """

    products: Mapping[str, Array]
    scales: Mapping[str, float]

    def deviations(self, other: Fingerprint) -> Iterator[str]:
        """The arrays that differ from those of another assembly, each with its row that differs most."""
        for name, mine in self.products.items():
            theirs = other.products[name]
            if mine.shape != theirs.shape:
                yield f"{name} has {len(mine)} rows against {len(theirs)}"
                continue
            gap = np.abs(mine - theirs)
            if not np.max(gap, initial=0.0) <= AGREEMENT_RTOL * max(self.scales[name], other.scales[name]):
                yield f"row {int(np.argmax(np.where(np.isnan(gap), np.inf, gap)))} of {name} differs"


def fingerprint(problem: Problem, vi: VariationalInequality) -> Fingerprint:
    """The fingerprint of `vi`, an assembly of the problem, and of its inner products."""
    arrays = {name: getattr(vi, name) for name in MEMBERS}
    return _of(arrays | {"X_V": problem.V.matrix, "X_W": problem.W.matrix})


def _of(arrays: Mapping[str, Any]) -> Fingerprint:
    products = {name: _product(array) for name, array in arrays.items()}
    sizes = ((name, array.data if sp.issparse(array) else array) for name, array in arrays.items())
    return Fingerprint(products, {name: float(np.max(np.abs(size), initial=0.0)) for name, size in sizes})


def _product(array: Any) -> Array:
    """A copy of a vector; of a matrix its product with entries in [1, 2) that are the same in every process."""
    if array.ndim == 1:
        return np.array(array)
    return np.asarray(array @ (1.0 + np.random.default_rng(0).random(array.shape[1])))


class ReferenceAssembly:
    """The assembly at one parameter that those at others are compared with; it is kept as the problem returned it.

    Parameters
    ----------
    problem, vi
        A problem, and its assembly at some parameter.
    """

    def __init__(self, problem: Problem, vi: VariationalInequality) -> None:
        self._problem, self._vi = problem, vi
        self.fingerprint = fingerprint(problem, vi)

    def refuse_false_constants(self, mu: Array, vi: VariationalInequality) -> None:
        """Raise a `NumericalError` if a member declared `constant` is another one in the assembly at mu (d,)."""
        # The same object needs no product; `refuse_rewritten_constants` tells if its entries were replaced.
        names = [name for name in self._problem.constant if getattr(vi, name) is not getattr(self._vi, name)]
        for deviation in _of({name: getattr(vi, name) for name in names}).deviations(self.fingerprint):
            where = f"at mu = {mu.tolist()} from that at the first training parameter"
            raise NumericalError(f"a member declared `constant` depends on mu: {deviation} {where}")

    def refuse_rewritten_constants(self) -> None:
        """Raise a `NumericalError` if later assemblies have written other entries into a member declared `constant`."""
        constants = {name: getattr(self._vi, name) for name in self._problem.constant}
        for deviation in _of(constants).deviations(self.fingerprint):
            raise NumericalError(f"a member declared `constant` is overwritten by later assemblies: {deviation}")
