"""A cache of assembled matrices for assessments, which use the same parameters repeatedly."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from cachetools import LRUCache

from vibench.arrays import Array
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly

LIMIT = 2**28
"""Size limit of the cache in bytes; the least recently used assembly is dropped first."""


class Assemblies:
    """Cached assemblies of one problem; timed code must not use them."""

    def __init__(self, problem: Problem, limit: int = LIMIT) -> None:
        self._problem = problem
        self._kept: LRUCache[bytes, VariationalInequality] = LRUCache(limit, getsizeof=_bytes)

    def at(self, mu: Array) -> VariationalInequality:
        """A copy of `checked_assembly` at mu (d,), which later assemblies leave as it is."""
        vi = self._kept.get(_key(mu))
        if vi is None:
            vi = checked_assembly(self._problem, mu).copy()
            if _bytes(vi) <= self._kept.maxsize:
                self._kept[_key(mu)] = vi
        return vi


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
