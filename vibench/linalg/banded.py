"""Definite matrices proved by a banded Cholesky factorisation: with a narrow band it is the fastest there is.

Of meshes in the plane with a few thousand nodes, numbered by the method of Cuthill and McKee, the band has a hundred
diagonals or less, and LAPACK factorises it in less time than a sparse method takes to order unknowns. If the
factorisation of the computed D⁻¹XD⁻¹ − cI ends, D² being about the diagonal of X, then X is definite, with c at least
the sum of the round-off of summing and scaling and of the factorisation, γ_k / (1 − γ_k) times the diagonal, about 1,
for each of the n columns, with γ_k = ku/(1 − ku) of k = b + 2 for b diagonals beside the main one (Rump, "Verification
of positive definiteness", BIT Numerical Mathematics 46, 2006, §2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dpbtrf
from scipy.sparse.csgraph import reverse_cuthill_mckee

from vibench.arrays import Array, SparseMatrix
from vibench.linalg.cholesky import UNIT

MOST_WORK = 1.5e8
"""Multiplications n b² up to which a band is taken for narrow."""


def is_proved_by_band(parts: Sequence[SparseMatrix]) -> bool | None:
    """Whether the sum of symmetric matrices (n×n) is proved to be positive definite; `None` where its band is wide.

    The sum is that of their symmetric parts.
    """
    total = sp.csr_array(sum(sp.csr_array(part) for part in parts))
    total = sp.csr_array(0.5 * (total + total.T))
    diagonal, size = total.diagonal(), total.shape[0]
    if not np.all(np.isfinite(total.data)) or not np.all(diagonal > 0.0):
        return False
    units = 1.0 / np.sqrt(diagonal)
    scaled = _band(total, units)
    if scaled is None:
        return None
    sizes = units * sum(abs(part) @ units + abs(part).T @ units for part in parts) / 2.0
    terms = (len(scaled) + 1) * UNIT
    error = (8.0 + 2.0 * len(parts)) * UNIT * float(np.max(sizes, initial=0.0)) + size * terms / (1.0 - 2.0 * terms)
    scaled[0] -= 1.01 * error
    return bool(dpbtrf(scaled, lower=1, overwrite_ab=1)[1] == 0)


def _band(matrix: SparseMatrix, units: Array) -> Array | None:
    """The lower half (b+1, n) of the band of S M S, S of `units` (n,), in another order; `None` if it is wide."""
    size = matrix.shape[0]
    place = np.empty(size, np.intp)
    place[reverse_cuthill_mckee(matrix, symmetric_mode=True)] = np.arange(size)
    rows, columns = np.repeat(np.arange(size), np.diff(matrix.indptr)), matrix.indices
    below = place[rows] - place[columns]
    width, lower = int(below.max(initial=0)), below >= 0
    if size * float(width) ** 2 > MOST_WORK:
        return None
    rows, columns, band = rows[lower], columns[lower], np.zeros((width + 1, size), order="F")
    band[below[lower], place[columns]] = units[rows] * matrix.data[lower] * units[columns]
    return band
