"""Projected greedy algorithm: one enrichment for all parameters, built offline."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from vibench import Array, NestedStrategy, Offline, Step
from vibench.linalg import orthonormal_range, project_out, svd
from vibench.reduction import TIE, LazyMaximum
from vibench_strategies.supremizer_greedy import Shares, SupremizerSpace, canonical

SMALL = 1e-10
"""Squares of sines below this are computed from residual vectors, not from the downdated Gram matrix."""


class OfflinePGA(NestedStrategy):
    """PGA, Algorithm 1 of Niakh, Drouet, Ehrlacher and Ern (2022).

    With `stop = "sigma"` the tolerance δ bounds σ_S(mu), (21), over the training set: β_S(mu) ≥ √(1 − δ²)·β_on(mu).
    With "beta" the same vectors are added until β_S(mu) ≥ ρ·β_on(mu): the tolerance is ρ, and a larger one is tighter.
    Stability by (23) requires δ < β₀/C₀ (the paper also prints β₀⁻¹C₀), which is sufficient but not necessary.
    """

    def __init__(self, stop: Literal["sigma", "beta"] = "sigma") -> None:
        self.stop, self.larger_is_tighter = stop, stop == "beta"

    def steps(self, offline: Offline) -> Iterator[Step]:
        """Algorithm 1, one vector per step."""
        space = SupremizerSpace(offline)  # lines 1 and 2: S_R(mu) of every training parameter; S = {0}
        angles = [Angles(images, space.plain) for images in space.supremizers]
        shares = [Shares(images) for images in space.supremizers] if self.stop == "beta" else []
        # σ and the missing share of β_on do not increase with S (Lemma 3.2): old values are upper bounds of new ones.
        largest, missing = LazyMaximum(np.ones(len(angles))), LazyMaximum(np.ones(len(shares)))
        history: dict[str, list[float]] = {"sigma": []}
        while True:
            # Lines 3 and 4: the parameter whose supremizer space is approximated worst by V_N + S.
            p, sigma = largest.next(lambda p: angles[p].sigma(space.basis))
            history["sigma"].append(sigma)
            if shares:
                share = 1.0 - missing.next(lambda p: shares[p].missing(space.basis))[1]
                history.setdefault("beta_share", []).append(share)
            yield space.step(history["beta_share"][-1] if shares else sigma, history)
            # Lines 5 to 7: the direction of that space farthest from V_N + S is orthonormalised and added to S.
            space.add(angles[p].worst_direction(space.basis), f"σ = {sigma:.0e}")


class Angles:
    """One supremizer space S_R(mu): an orthonormal basis and the Gram matrix of its residual outside V_N + S.

    The Gram matrix is downdated by a rank-one term for every vector added to S, but only when it is used. Its
    eigenvalues are squared sines, so that half the digits of small sines are lost: these are computed from residuals.

    Parameters
    ----------
    supremizers
        Coordinates (d×k) of vectors that span S_R(mu).
    plain
        Orthonormal coordinates (d×N) of V_N.
    """

    def __init__(self, supremizers: Array, plain: Array) -> None:
        # T(mu)χ is numerically singular where generators nearly coincide: its null directions are dropped.
        self._basis = orthonormal_range(supremizers)
        self._known = plain.shape[1]
        outside = project_out(plain, self._basis)
        self._gram = outside.T @ outside

    def sigma(self, space: Array) -> float:
        """σ_S(mu): the largest sine of the principal angles between S_R(mu) and V_N + S (d×k, orthonormal)."""
        if not self._basis.size:
            return 0.0
        if space.shape[1] < self._basis.shape[1]:  # a direction of S_R(mu) is orthogonal to the smaller V_N + S
            return 1.0
        square = float(np.linalg.eigvalsh(self._residual_gram(space))[-1])
        return float(np.sqrt(square)) if square >= SMALL else float(self._sines(space)[0][0])

    def worst_direction(self, space: Array) -> Array:
        """The unit vector v (d,) of S_R(mu) that makes the largest angle with V_N + S.

        Several sines equal 1 while V_N + S is smaller than S_R(mu); `canonical` then makes the choice unique.
        """
        sines, right = self._sines(space)
        return np.asarray(self._basis @ canonical(right[sines >= sines[0] - TIE]))

    def _residual_gram(self, space: Array) -> Array:
        """Gram matrix (r×r) of the residual of the basis outside V_N + S; its eigenvalues are squared sines."""
        rows = space[:, self._known :].T @ self._basis
        self._gram = self._gram - rows.T @ rows
        self._known = space.shape[1]
        return self._gram

    def _sines(self, space: Array) -> tuple[Array, Array]:
        """Sines (r,), descending, and their directions in S_R(mu) as rows (r×r)."""
        # The full symmetric eigensolver: solvers for a part of the spectrum fail on clusters near 1.
        squares, vectors = np.linalg.eigh(self._residual_gram(space))
        if squares[-1] < SMALL:
            _, sines, right = svd(project_out(space, self._basis))
            return sines, right
        return np.sqrt(np.maximum(squares[::-1], 0.0)), vectors.T[::-1]
