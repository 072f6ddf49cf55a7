"""A cache of assembled matrices and their factors for assessments, which use the same parameters repeatedly."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from cachetools import LRUCache

from vibench.arrays import Array
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly
from vibench.model.errors import Energy

LIMIT = 2**28
"""Size limit of the assemblies in bytes; the least recently used one is dropped first."""

FACTORS = 3 * 2**28
"""The same of factors of A and of compliances. Cells use the same parameters in the same order: too small a cache is
none."""


class Assemblies:
    """Cached assemblies of one problem; timed code must use none of it but `energy_of`."""

    def __init__(self, problem: Problem, limit: int = LIMIT) -> None:
        self._problem = problem
        self._kept: LRUCache[bytes, VariationalInequality] = LRUCache(limit, getsizeof=_bytes)
        self._energies: LRUCache[bytes, Energy] = LRUCache(FACTORS, getsizeof=self._own_bytes)
        self._solver = HighFidelitySolver(problem)

    def at(self, mu: Array) -> VariationalInequality:
        """A copy of `checked_assembly` at mu (d,), which later assemblies leave as it is."""
        vi = self._kept.get(_key(mu))
        if vi is None:
            vi = checked_assembly(self._problem, mu).copy()
            if _bytes(vi) <= self._kept.maxsize:
                self._kept[_key(mu)] = vi
        return vi

    def energy_at(self, mu: Array) -> Energy:
        """Factorisations of A at mu (d,) and what errors and bounds at mu share; a constant A is factorised once."""
        vi, found = self.at(mu), self._energies.get(_key(mu))
        if found is None:
            found = replace(self.energy_of(vi), shared=True)
            found.on_contact(vi)  # is of its size
            if self._own_bytes(found) <= self._energies.maxsize:
                self._energies[_key(mu)] = found
        return found

    def energy_of(self, vi: VariationalInequality) -> Energy:
        """Factorisations of an assembled A, which are not kept unless it is constant: this may be timed."""
        return Energy(vi.A, self._solver.condensed(vi))

    def _own_bytes(self, energy: Energy) -> int:
        """Memory of what is of one parameter alone."""
        return energy.nbytes if "A" not in self._problem.constant else energy.nbytes_on_contact


@lru_cache(maxsize=1)
def assemblies(problem: Problem) -> Assemblies:
    """The cache of the problem that this process works on; another problem replaces it."""
    return Assemblies(problem)


def _key(mu: Array) -> bytes:
    return np.ascontiguousarray(mu, float).tobytes()


def _bytes(vi: VariationalInequality) -> int:
    """Memory of the matrices, as if none were shared."""
    # A value of 8 bytes and an index of 4 per nonzero.
    return int(12 * (vi.A.nnz + vi.B.nnz)) + vi.f.nbytes + vi.g.nbytes
