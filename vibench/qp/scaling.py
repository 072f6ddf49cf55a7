"""Norms by which quadratic programs and their residuals are scaled."""

from __future__ import annotations

import numpy as np

from vibench.arrays import Array, SparseMatrix


def row_norms(B: SparseMatrix | Array) -> Array:
    """Euclidean norms (m,) of the rows, 1 where a row is zero."""
    squares = (B * B).sum(axis=1) if isinstance(B, np.ndarray) else B.multiply(B).sum(axis=1)
    norms = np.sqrt(np.asarray(squares, float).ravel())
    return np.where(norms > 0.0, norms, 1.0)


def peak(vector: Array) -> float:
    """Largest entry in absolute value; 0 of an empty vector."""
    return float(np.max(np.abs(vector), initial=0.0))


def size(vector: Array) -> float:
    """Largest entry in absolute value, or 1 for the zero vector: a safe divisor."""
    return peak(vector) or 1.0


def ratio(value: float, scale: float) -> float:
    """A value relative to a scale, or as it is where the scale is zero."""
    return value / scale if scale > 0.0 else value
