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


class Lanczos:
    """Lanczos iterations that continue where they ended.

    A more accurate eigenvalue costs only the missing iterations, and the other end of the spectrum often none. After 60
    vectors the iterations start again from the Ritz vector, at most 20 times. `apply` maps v (n,) to T v, self-adjoint
    in the inner product of a sparse symmetric positive definite M (n×n).
    """

    def __init__(self, apply: Callable[[Array], Array], M: SparseMatrix) -> None:
        self._apply, self._M, n = apply, M, M.shape[0]
        self._count = min(60, n)
        self._basis, self._images = np.empty((self._count, n)), np.empty((self._count, n))
        self._restarted = False
        self._begin(np.random.default_rng(0).standard_normal(n))

    def largest(self, accuracy: float) -> float:
        """Estimate of the largest |θ|, whose relative error is about `accuracy`; infinite where M is not definite."""
        theta = 0.0
        for _ in range(20):
            theta, error, vector = self._iterate(accuracy, smallest=False)
            if not error > accuracy * theta:
                break
            self._restarted = True
            self._begin(vector @ self._basis)
        return theta

    def smallest(self, accuracy: float) -> float | None:
        """Estimate of the smallest θ of a positive definite T; `None` where the first 60 vectors do not suffice."""
        if self._restarted:  # towards the other end
            return None
        theta, error, _ = self._iterate(accuracy, smallest=True)
        return theta if error <= accuracy * theta and 0.0 < theta < np.inf else None

    def _begin(self, start: Array) -> None:
        self._size, self._diagonal, self._beside = 0, np.empty(self._count), np.empty(self._count)
        self._follow(start)

    def _follow(self, w: Array) -> None:
        """The next vector w (n,) of the basis, and M w; its norm is NaN where wᵀMw < 0."""
        self._next, self._image = w, self._M @ w
        square = float(w @ self._image)
        self._norm = float(np.sqrt(square)) if square >= 0.0 else float("nan")

    def _iterate(self, accuracy: float, smallest: bool) -> tuple[float, float, Array]:
        """Value |θ|, its estimated error and the coefficients of its Ritz vector, once accurate or the basis full."""
        ritz = self._ritz(smallest)
        while ritz[1] > accuracy * ritz[0] and self._size < self._count:
            if not (np.isfinite(self._norm) and self._norm > 0.0):
                return float("inf"), 0.0, ritz[2]
            self._extend()
            if not (np.isfinite(self._norm) and np.isfinite(self._diagonal[self._size - 1])):
                return float("inf"), 0.0, ritz[2]
            # The span is invariant where the next vector is round-off.
            ended = self._norm <= 1e-12 * abs(self._diagonal[self._size - 1]) or self._size == self._count
            # An estimate costs a tenth of a solution with a few thousand unknowns.
            if ended or self._size % 3 == 0:
                ritz = self._ritz(smallest)
        return ritz

    def _extend(self) -> None:
        k = self._size
        self._basis[k], self._images[k] = self._next / self._norm, self._image / self._norm
        done, images, w = self._basis[: k + 1], self._images[: k + 1], self._apply(self._basis[k])
        # In exact arithmetic w has parts along the last two vectors only; the second pass removes round-off.
        last = slice(max(k - 1, 0), k + 1)
        along = images[last] @ w
        self._diagonal[k], w = along[-1], w - along @ done[last]
        w -= (images @ w) @ done
        self._follow(w)
        self._beside[k], self._size = self._norm, k + 1

    def _ritz(self, smallest: bool) -> tuple[float, float, Array]:
        """Value |θ| of the smallest or the largest Ritz value, its estimated error, and its vector in the basis."""
        k = self._size
        if not k:
            return 0.0, float("inf"), np.zeros(0)
        values, vectors, failed = dstev(self._diagonal[:k], self._beside[: max(k - 1, 1)])
        if failed:
            return float("inf"), 0.0, np.zeros(0)
        first, second = (0, 1) if smallest or -values[0] > values[-1] else (-1, -2)
        theta, residual = float(values[first]), float(self._norm * abs(vectors[-1, first]))
        theta = theta if smallest else abs(theta)
        gap = abs(float(values[first] - values[second])) if k > 1 else 0.0
        # The smaller of both bounds of Parlett, with the nearest Ritz value for the nearest eigenvalue.
        error = residual * min(1.0, residual / gap) if gap > 0.0 else residual
        return theta, 0.0 if k == self._M.shape[0] else error, vectors[:, first]
