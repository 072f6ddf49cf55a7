"""Definite matrices proved by a banded Cholesky factorisation: with a narrow band it is the fastest there is.

Of meshes in the plane with a few thousand nodes, numbered by the method of Cuthill and McKee, the band has a hundred
diagonals or less, and LAPACK factorises it in less time than a sparse method takes to order unknowns. If the
factorisation of the computed D⁻¹XD⁻¹ − cI ends, D² being about the diagonal of X, then X is definite, with c at least
the sum of the round-off of summing and scaling and of the factorisation, γ_k / (1 − γ_k) times the diagonal, about 1,
for each of the n columns, with γ_k = ku/(1 − ku) of k = b + 2 for b diagonals beside the main one (Rump, "Verification
of positive definiteness", BIT Numerical Mathematics 46, 2006, §2).
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpbtrf
from scipy.sparse.csgraph import reverse_cuthill_mckee

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.linalg import UNIT_ROUND_OFF
from vibench.linalg.cholesky import have_one_pattern

MOST_WORK = 1.5e8
"""Multiplications n b² up to which a band is taken for narrow."""


def is_proved_by_band(parts: Sequence[SparseMatrix]) -> bool | None:
    """Whether the sum of symmetric matrices (n×n) is proved to be positive definite; `None` where its band is wide.

    The sum is that of their symmetric parts.
    """
    # of columns the transpose, whose symmetric part is the same: a conversion takes longer than the factorisation
    rows = [part.T if part.format == "csc" else sp.csr_array(part) for part in parts]
    total, magnitude = _sum(rows), _sum([abs(part) for part in rows])
    diagonal, size = total.diagonal(), total.shape[0]
    if not np.all(np.isfinite(total.data)) or not np.all(diagonal > 0.0):
        return False
    units = 1.0 / np.sqrt(diagonal)
    scaled = _band(total, units)
    if scaled is None:
        return None
    sizes = units * (magnitude @ units + magnitude.T @ units) / 2.0
    terms = (len(scaled) + 1) * UNIT_ROUND_OFF
    error = (8.0 + 2.0 * len(parts)) * UNIT_ROUND_OFF * float(np.max(sizes, initial=0.0)) + size * terms / (
        1.0 - 2.0 * terms
    )
    scaled[0] -= 1.01 * error
    return bool(dpbtrf(scaled, lower=1, overwrite_ab=1)[1] == 0)


def _sum(parts: Sequence[SparseMatrix]) -> SparseMatrix:
    """The sum of matrices (CSR), entry by entry where all have one pattern, as A and X_V of one mesh have."""
    first, *others = parts
    if not all(have_one_pattern(first, other) for other in others):
        return sp.csr_array(reduce(operator.add, parts))
    values = reduce(operator.add, (part.data for part in parts))
    return sp.csr_array((values, first.indices.copy(), first.indptr.copy()), shape=first.shape)


@dataclass(frozen=True)
class _Order:
    """Where the entries of matrices (n×n) of one symmetric sparsity pattern are in a band.

    Of those of the lower half of the band, which has `width` diagonals beside the main one: positions among all
    entries, those of the entries opposite the diagonal, rows, columns, and places in the band (width+1, n), column by
    column.
    """

    width: int
    entries: Indices
    opposite: Indices
    rows: Indices
    columns: Indices
    places: Indices

    @cached_property
    def band(self) -> Array:
        """Memory of a band (n, width+1), which every matrix overwrites: to allocate it takes longer than to fill it."""
        return np.empty((int(self.rows.max(initial=-1)) + 1, self.width + 1))


@lru_cache(maxsize=2)
def _order(pointers: bytes, indices: bytes, kind: str) -> _Order | None:
    """The order for a sorted pattern (CSR), given as bytes of index arrays of a kind; `None` if it is not symmetric.

    Proofs ask for the same few patterns again and again.
    """
    starts, columns = np.frombuffer(pointers, kind), np.frombuffer(indices, kind)
    size = len(starts) - 1
    pattern = sp.csr_array((np.arange(len(columns)), columns, starts), shape=(size, size))
    transposed = pattern.T.tocsr()
    if not (np.array_equal(transposed.indptr, starts) and np.array_equal(transposed.indices, columns)):
        return None
    place = np.empty(size, np.intp)
    place[reverse_cuthill_mckee(pattern, symmetric_mode=True)] = np.arange(size)
    rows = np.repeat(np.arange(size), np.diff(starts))
    below = place[rows] - place[columns]
    width, lower = int(below.max(initial=0)), np.flatnonzero(below >= 0)
    rows, columns = rows[lower], columns[lower].astype(np.intp)
    places = below[lower] + (width + 1) * place[columns]
    return _Order(width, lower, transposed.data[lower], rows, columns, places)


def _band(matrix: SparseMatrix, units: Array) -> Array | None:
    """The lower half (b+1, n) of the band of ½ S (M + Mᵀ) S, S of `units` (n,), reordered; `None` if it is wide."""
    matrix.sort_indices()
    order = _order(matrix.indptr.tobytes(), matrix.indices.tobytes(), matrix.indices.dtype.str)
    if order is None:
        return _band(sp.csr_array(0.5 * (matrix + matrix.T)), units)
    if matrix.shape[0] * float(order.width) ** 2 > MOST_WORK:
        return None
    band = order.band
    band.fill(0.0)
    values = 0.5 * (matrix.data[order.entries] + matrix.data[order.opposite])
    band.ravel()[order.places] = units[order.rows] * values * units[order.columns]
    return band.T
