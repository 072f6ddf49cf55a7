"""What a problem assembles, kept for assessments that look at the same parameters again and again."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly


class Assemblies:
    """What a problem assembles, kept for assessments that look at the same parameters again and again.

    Parameters
    ----------
    problem
        The problem.
    limit
        Bytes to keep at most; what was asked for longest ago goes first.
    """

    def __init__(self, problem: Problem, limit: int = 2**28) -> None:
        self._problem, self._limit = problem, limit
        self._kept: dict[bytes, VariationalInequality] = {}
        self._size = 0

    def at(self, mu: Array) -> VariationalInequality:
        """`checked_assembly` at mu (d,)."""
        vi = self._kept.get(_key(mu))
        return self.keep(mu, checked_assembly(self._problem, mu) if vi is None else vi)

    def keep(self, mu: Array, vi: VariationalInequality) -> VariationalInequality:
        """Take in what was assembled at mu (d,), or asked for once more; gives it back."""
        before = self._kept.pop(_key(mu), None)
        self._size += _bytes(vi) - (0 if before is None else _bytes(before))
        while self._kept and self._size > self._limit:
            self._size -= _bytes(self._kept.pop(next(iter(self._kept))))
        self._kept[_key(mu)] = vi
        return vi


def _key(mu: Array) -> bytes:
    return np.ascontiguousarray(mu, float).tobytes()


def _bytes(vi: VariationalInequality) -> int:
    """Memory of the matrices, as if none were shared."""
    return int(12 * (vi.A.nnz + vi.B.nnz)) + vi.f.nbytes + vi.g.nbytes


@lru_cache(maxsize=1)
def assemblies(problem: Problem) -> Assemblies:
    """What the problem in hand assembles, kept in this process; for whatever is not timed."""
    return Assemblies(problem)
