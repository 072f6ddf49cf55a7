"""Extreme eigenvalues of self-adjoint operators by Lanczos iterations that stop at an accuracy of the eigenvalue.

With r the residual of a Ritz value θ and g its distance from the other eigenvalues, θ errs by at most min(r, r²/g)
(Parlett, "The Symmetric Eigenvalue Problem", §11.7). ARPACK stops where r is small, which takes twice the iterations
that r² needs. Here g is the distance from the nearest Ritz value, so that the accuracy is an estimate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg.lapack import dstev

from vibench.arrays import Array, SparseMatrix

VECTORS = 60
"""After so many vectors iterations start again from the Ritz vector, at most `RESTARTS` times."""

RESTARTS = 20

BREAKDOWN = 1e-12
"""Vectors whose part beyond all others is below this share are the last ones: their span is invariant."""

LOOKED_AT = 3
"""The accuracy is estimated after every so many iterations: that takes as long as a tenth of a solution of a few
thousand unknowns."""


def largest_eigenvalue(apply: Callable[[Array], Array], M: SparseMatrix, accuracy: float) -> float:
    """Estimate of the largest |θ| with T v = θ v; infinite where M is seen not to be positive definite.

    Parameters
    ----------
    apply
        From v (n,) to T v, self-adjoint in the inner product of M.
    M
        Sparse symmetric positive definite (n×n).
    accuracy
        Estimated relative error of θ at which iterations end.
    """
    start, theta = np.random.default_rng(0).standard_normal(M.shape[0]), 0.0
    for _ in range(RESTARTS):
        theta, error, start = _iterate(apply, M, accuracy, start)
        if not error > accuracy * theta:
            break
    return theta


def _iterate(apply: Callable[[Array], Array], M: SparseMatrix, accuracy: float, w: Array) -> tuple[float, float, Array]:
    """|θ|, its estimated error and the Ritz vector (n,) of iterations from w (n,); the vector only if it is needed."""
    count, norm = min(VECTORS, len(w)), _norm(M, w)
    basis, diagonal, beside = np.empty((count, len(w))), np.empty(count), np.empty(count)
    theta, error, vector = float("inf"), 0.0, w
    for k in range(count):
        if not (np.isfinite(norm) and norm > 0.0):
            return float("inf"), 0.0, w
        basis[k] = w / norm
        done, w = basis[: k + 1], apply(basis[k])
        along = done @ (M @ w)
        diagonal[k], w = along[k], w - along @ done
        w -= (done @ (M @ w)) @ done  # again, against round-off
        norm = beside[k] = _norm(M, w)
        if not (np.isfinite(norm) and np.isfinite(diagonal[k])):
            return float("inf"), 0.0, w
        if (k + 1) % LOOKED_AT and norm > BREAKDOWN * abs(diagonal[k]) and k + 1 < count:
            continue
        values, vectors, failed = dstev(diagonal[: k + 1], beside[: max(k, 1)])
        if failed:
            return float("inf"), 0.0, w
        first, second = (0, 1) if -values[0] > values[-1] else (-1, -2)
        theta, residual = abs(float(values[first])), float(norm * abs(vectors[-1, first]))
        gap = abs(float(values[first] - values[second])) if k else 0.0
        error = residual * min(1.0, residual / gap) if gap > 0.0 else residual
        if error <= accuracy * theta or k + 1 == len(w):
            return theta, 0.0, w
        vector = vectors[:, first]
    return theta, error, vector @ basis


def _norm(M: SparseMatrix, w: Array) -> float:
    """‖w‖ in M; NaN where wᵀMw < 0."""
    square = float(w @ (M @ w))
    return float(np.sqrt(square)) if square >= 0.0 else float("nan")
