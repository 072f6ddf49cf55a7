"""Which rows of B u ≤ g matter: of parallel ones the tightest, of opposite ones without room between them one equality.

Rows b u ≤ g and −c b u ≤ g', c > 0, with c g + g' = 0 are the equality b u = g. No u satisfies both by a margin, and
they are linearly dependent. An equality in their place, with a multiplier of any sign, has neither defect: its positive
part belongs to the one row, its negative part to the other. Rows that are absent constrain nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.interfaces.problem import VariationalInequality, is_absent
from vibench.linalg import EPS
from vibench.qp.scaling import row_norms

PARALLEL = 8.0 * EPS
"""Largest difference of entries of two parallel rows of length 1, which were scaled with a rounding."""

CLOSE = 1e-12
"""Rows of length 1 with the same product with a random vector, but for this, may be parallel."""


@dataclass(frozen=True)
class Rows:
    """The rows that matter.

    Attributes
    ----------
    kept
        Their numbers (k,), rising.
    equal
        Which of them are equalities (k,).
    opposite, ratio
        Of equalities the row on the other side (k,), and the length of this row over that of the other.
    implied
        Rows (m,) that need no look of their own: equalities, those parallel to them, and absent ones.
    """

    kept: Indices
    equal: Mask
    opposite: Indices
    ratio: Array
    implied: Mask

    @property
    def equalities(self) -> Indices:
        """The numbers (e,) of equalities."""
        return self.kept[self.equal]

    def program(self, vi: VariationalInequality) -> VariationalInequality:
        """`vi` with these rows alone."""
        if len(self.kept) == len(vi.g):
            return vi
        return replace(vi, B=sp.csr_array(vi.B)[self.kept], g=vi.g[self.kept])

    def multipliers(self, forces: Array, count: int) -> Array:
        """λ ≥ 0 (m,) from multipliers (k,) of the rows that are kept, of any sign on equalities."""
        lam = np.zeros(count)
        lam[self.kept] = np.where(self.equal, np.maximum(forces, 0.0), forces)
        lam[self.opposite[self.equal]] = (self.ratio * np.maximum(-forces, 0.0))[self.equal]
        return lam


@dataclass(frozen=True)
class Directions:
    """Rows of one matrix that are parallel.

    Attributes
    ----------
    lengths
        Euclidean norms (m,) of all rows.
    members, group, side
        The rows (p,) that are parallel to others, the number of the direction of each, and its sign in it.
    """

    lengths: Array
    members: Indices
    group: Indices
    side: Array

    @classmethod
    def of(cls, B: SparseMatrix, present: Mask) -> Directions:
        """Of the rows of B (m×n) that are `present` (m,)."""
        lengths = row_norms(B)
        return cls(lengths, *_parallel(B, lengths, present))


def rows_that_matter(
    B: SparseMatrix, g: Array, room: Array, preferred: Array | None = None, directions: Directions | None = None
) -> Rows:
    """The rows of B (m×n) and g (m,) that matter.

    Parameters
    ----------
    room
        Opposite rows are an equality where there is at most this room (m,) between them, in the unit of g.
    preferred
        Of an equality the row with the larger of these (m,) is kept, in units of its length.
    directions
        Those of the rows that are not absent, where they are known.
    """
    m = len(g)
    dropped, equal, opposite, ratio = is_absent(g), np.zeros(m, bool), np.arange(m), np.ones(m)
    implied = dropped.copy()
    directions = directions or Directions.of(sp.csr_array(B), ~dropped)
    if not len(directions.members):
        kept = np.flatnonzero(~dropped)
        return Rows(kept, equal[kept], kept, ratio[kept], implied)
    lengths, members, group, side = directions.lengths, directions.members, directions.group, directions.side
    bounds = g[members] / lengths[members]
    order = np.lexsort((members, bounds, side, group))
    members, group, side, bounds = members[order], group[order], side[order], bounds[order]
    tightest = np.flatnonzero((np.diff(group, prepend=-1) != 0) | (np.diff(side, prepend=0) != 0))
    dropped[members] = True
    dropped[members[tightest]] = False
    both, of_equalities = np.flatnonzero(np.diff(group[tightest]) == 0), []  # a group has a tightest row on either side
    for low, high in zip(tightest[both], tightest[both + 1], strict=True):
        i, j = int(members[low]), int(members[high])
        if abs(bounds[low] + bounds[high]) <= max(room[i] / lengths[i], room[j] / lengths[j]):
            if preferred is not None and preferred[j] * lengths[j] > preferred[i] * lengths[i]:
                i, j = j, i
            dropped[j], equal[i], opposite[i], ratio[i] = True, True, j, lengths[i] / lengths[j]
            of_equalities.append(group[low])
    implied[members[np.isin(group, of_equalities)]] = True
    kept = np.flatnonzero(~dropped)
    return Rows(kept, equal[kept], opposite[kept], ratio[kept], implied)


@lru_cache(maxsize=4)
def _random(count: int) -> Array:
    """A random vector (count,)."""
    return np.random.default_rng(0).standard_normal(count)


def _parallel(B: SparseMatrix, lengths: Array, present: Mask) -> tuple[Indices, Indices, Array]:
    """The rows (p,) that are parallel to others, the number of the direction of each, and its sign in it."""
    probes = B @ _random(B.shape[1]) / lengths
    rows = np.flatnonzero(present & (probes != 0.0))
    rows = rows[np.argsort(np.abs(probes[rows]), kind="stable")]
    sizes = np.abs(probes[rows])
    group = np.cumsum(np.diff(sizes, prepend=-1.0) > CLOSE * (1.0 + sizes)) - 1
    first = np.flatnonzero(np.diff(group, prepend=-1))
    shared = np.bincount(group, minlength=len(first))[group] > 1
    rows, first, group = rows[shared], rows[first][group][shared], group[shared]
    if not len(rows):
        return rows, group, np.zeros(0)
    side = np.sign(probes)
    unit = sp.csr_array(sp.diags_array(side / lengths) @ B)
    gaps = abs(unit[rows] - unit[first]).max(axis=1)
    same = np.asarray(gaps.todense()).ravel() <= PARALLEL
    return rows[same], group[same], side[rows[same]]
