"""Empirical interpolation of parametrised vectors and of the non-zeros of parametrised matrices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from vibench.arrays import Array, Indices
from vibench.linalg.dense import svd


@dataclass(frozen=True)
class Interpolation:
    """Empirical interpolation v(mu) ≈ Σ_q v(mu)[points_q] · modes_q from a few entries of the vector.

    Attributes
    ----------
    points
        Interpolation points: entries (Q,), rising.
    modes
        Cardinal modes (k×Q): mode q is 1 at its own point and 0 at the others.
    error
        Largest relative Euclidean error over the snapshots.
    """

    points: Indices
    modes: Array
    error: float


def interpolate(snapshots: Array, tolerance: float) -> Interpolation:
    """Discrete empirical interpolation of vectors (k×P), not all zero, to a tolerance.

    The modes are those of a singular value decomposition, the points those of a pivoted QR factorisation of the modes
    (Q-DEIM, Drmač and Gugercin 2016; of matrices, matrix DEIM, Negri, Manzoni and Amsallem 2015). The tolerance bounds
    the error of every column, relative to the longest. The number of terms is found by bisection; errors are not
    monotone in it, so a smaller number may exist.
    """
    scale = float(np.linalg.norm(snapshots, axis=0).max())
    q, r = np.linalg.qr(snapshots)
    left, sigma, right = svd(r)
    # squared error of projecting every column on k modes
    squares = np.cumsum(((sigma[:, None] * right) ** 2)[::-1], axis=0)[::-1]
    projection = np.append(np.sqrt(squares.max(axis=1)), 0.0) / scale
    rank = max(1, int(np.count_nonzero(sigma > np.finfo(float).eps * sigma[0])))
    low = min(rank, max(1, int(np.argmax(projection <= tolerance))))  # interpolation is never better than projection

    def with_terms(count: int) -> Interpolation:
        modes = q @ left[:, :count]
        _, _, pivots = scipy.linalg.qr(modes.T, mode="economic", pivoting=True)
        points = np.sort(pivots[:count])
        cardinal = np.linalg.solve(modes[points].T, modes.T).T
        errors = np.linalg.norm(snapshots - cardinal @ snapshots[points], axis=0)
        return Interpolation(points, cardinal, float(errors.max()) / scale)

    found, step, high = with_terms(low), 1, low  # gallop upwards, since the projection error is a close guess
    while found.error > tolerance and high < rank:
        low, high, step = high + 1, min(high + step, rank), 2 * step
        found = with_terms(high)
    while found.error <= tolerance and low < high:
        middle = (low + high) // 2
        candidate = with_terms(middle)
        if candidate.error <= tolerance:
            found, high = candidate, middle
        else:
            low = middle + 1
    return found
