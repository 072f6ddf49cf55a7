"""Linear complementarity problems of corrections: ν = ν₀ + M v ≥ 0, v ≥ 0, νᵀv = 0, with M symmetric positive definite.

They have one solution. The primal-dual active set method exchanges all unknowns with the wrong sign at once and takes
few steps, but it may cycle where M is no M-matrix. Then v is found as the minimiser of ½ vᵀM v + ν₀ᵀv over v ≥ 0 by the
method of Lawson and Hanson for nonnegative least squares (Solving Least Squares Problems, 1974, chapter 23). Its
objective falls in every step, so that it meets no set twice and ends. What decides here is round-off where ν and v are
both zero: ν counts as negative beyond its round-off alone, and an unknown that would not become positive is passed
over. SciPy's own method, which has no such bounds, returns wrong solutions in such cases (1.17.1).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg.lapack import dposv

from vibench.arrays import Array, Indices, Mask

STEPS = 30
"""Steps of the primal-dual active set method."""

MOST = 20
"""Steps of the other one, as a multiple of the number of unknowns; about as many as unknowns are usual."""

UNIT = float(np.finfo(float).eps)


def complementary(fixed: Array, rows_of: Callable[[Indices], Array], released: Mask) -> Array:
    """ν (i,) of the problem above up to round-off; whether what it is for is feasible has to be verified in any case.

    Parameters
    ----------
    fixed, released
        ν₀ (i,), and where v may be positive at first (i,); the systems that are solved have the size of such sets.
    rows_of
        Gives rows of M (·×i) from their numbers.
    """
    for _ in range(STEPS):
        rows = released.nonzero()[0]
        nu, wrong = fixed, fixed < 0.0
        if len(rows):
            among = rows_of(rows)
            _, v, singular = dposv(among[:, rows], -fixed[rows])
            if singular:
                break
            nu = fixed + v @ among
            nu[rows] = 0.0
            wrong = nu < 0.0
            wrong[rows] = v < 0.0
        if not wrong.any():
            return nu
        released = released != wrong
    return fixed + descent(rows_of(np.arange(len(fixed))), fixed)


def descent(M: Array, fixed: Array) -> Array:
    """M v (i,) for the minimiser v ≥ 0 of ½ vᵀM v + ν₀ᵀv, up to round-off.

    Lawson and Hanson's `w` is −ν here, their `z` is the solution on the set of positive unknowns.
    """
    size, unit = len(fixed), 1.0 / np.sqrt(M.diagonal())
    v, positive, passed = np.zeros(size), np.zeros(size, bool), np.zeros(size, bool)
    for _ in range(MOST * size):
        nu = fixed + M @ v + UNIT * size * (np.abs(fixed) + np.abs(M) @ v)
        nu[positive | passed] = 0.0
        entering = int(np.argmin(nu * unit))
        if nu[entering] >= 0.0:
            break
        positive[entering], first = True, True
        while (rows := positive.nonzero()[0]).size:
            z = np.zeros(size)
            _, z[rows], singular = dposv(M[np.ix_(rows, rows)], -fixed[rows])
            if singular:
                return np.asarray(M @ v)
            if first and not z[entering] > 0.0:  # NaN is not
                positive[entering], passed[entering] = False, True
                break
            blocking, first = positive & (z <= 0.0), False
            if not blocking.any():
                v, passed = z, np.zeros(size, bool)
                break
            steps = np.full(size, np.inf)
            steps[blocking] = v[blocking] / (v[blocking] - z[blocking])
            v = v + steps.min() * (z - v)
            positive &= ~(blocking & (steps <= steps.min())) & (v > 0.0)
            v[~positive] = 0.0
    return np.asarray(M @ v)
