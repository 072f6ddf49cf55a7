"""Rows of B u ≤ g that constrain nothing: g is infinite, or the row of B is zero and g is not negative."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Mask, SparseMatrix
from vibench.errors import NumericalError

# The bound g of a row that constrains nothing: finite, so that no sum with it, and no product with zero, is NaN.
ABSENT = 1e100


def is_absent(g: Array) -> Mask:
    """Mask of the rows (m,) that constrain nothing: g is infinite, even with something finite added to it."""
    return np.asarray(g >= 0.5 * ABSENT)


def without_infinities(g: Any) -> Any:
    """A bound g (m,) with `ABSENT` in place of +inf."""
    if not isinstance(g, np.ndarray) or g.dtype.kind != "f" or not (infinite := g == np.inf).any():
        return g
    # Single precision has no number as large.
    return np.where(infinite, ABSENT, g.astype(float))


def zero_rows(B: SparseMatrix | Array) -> Mask:
    """Mask of the rows (m,) of B (m×n) without an entry other than zero."""
    if isinstance(B, np.ndarray):
        return np.asarray(~B.any(axis=1))
    B = B if B.format == "csr" else sp.csr_array(B)
    if not B.has_canonical_format:
        B = B.copy()
        B.sum_duplicates()
    if B.data.all():
        return np.asarray(np.diff(B.indptr) == 0)
    rows = np.repeat(np.arange(B.shape[0]), np.diff(B.indptr))
    return np.asarray(np.bincount(rows, B.data != 0.0, B.shape[0]) == 0.0)


def settled_bounds(B: SparseMatrix, g: Array, rays: Mask | bool = True) -> Array:
    """The bound g (m,), with 0 where it is below zero by round-off and the row of B (m×n), a ray, is zero.

    Raises a `NumericalError` that names a zero row whose bound is negative: no u satisfies 0 ≤ g there.
    """
    negative = (g < 0.0) & rays
    if not negative.any() or not len(wrong := np.flatnonzero(zero_rows(B) & negative)):
        return g
    row = int(wrong[np.argmin(g[wrong])])
    # The lift of Dirichlet data leaves round-off of the usual bounds.
    if g[row] < -1e-14 * float(np.median(np.abs(g[~is_absent(g)]))):
        raise NumericalError(f"row {row} of B is zero and g is {g[row]:.3g} there: no u satisfies 0 ≤ {g[row]:.3g}")
    settled = g.copy()
    settled[wrong] = 0.0
    return settled
