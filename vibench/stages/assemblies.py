"""What a problem assembles, kept for assessments that look at the same parameters again and again."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from cachetools import LRUCache

from vibench.arrays import Array
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly

LIMIT = 2**28
"""Bytes that are kept at most; what was used longest ago is dropped first."""


class Assemblies:
    """The assemblies of one problem, each made once while there is room for it; nothing that is timed uses them."""

    def __init__(self, problem: Problem, limit: int = LIMIT) -> None:
        self._problem = problem
        self._kept: LRUCache[bytes, VariationalInequality] = LRUCache(limit, getsizeof=_bytes)

    def at(self, mu: Array) -> VariationalInequality:
        """`checked_assembly` at mu (d,)."""
        vi = self._kept.get(_key(mu))
        if vi is None:
            vi = checked_assembly(self._problem, mu)
            self.keep(mu, vi)
        return vi

    def keep(self, mu: Array, vi: VariationalInequality) -> None:
        """Keep what was assembled at mu (d,) elsewhere, unless it is larger than the limit."""
        if _bytes(vi) <= self._kept.maxsize:
            self._kept[_key(mu)] = vi


@lru_cache(maxsize=1)
def assemblies(problem: Problem) -> Assemblies:
    """The assemblies of the present problem of this process."""
    return Assemblies(problem)


def _key(mu: Array) -> bytes:
    return np.ascontiguousarray(mu, float).tobytes()


def _bytes(vi: VariationalInequality) -> int:
    """Memory of the matrices, as if none were shared."""
    return int(12 * (vi.A.nnz + vi.B.nnz)) + vi.f.nbytes + vi.g.nbytes
