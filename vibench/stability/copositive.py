"""Certified bounds on the minimum of αᵀMα / αᵀGα over α ≥ 0, for M positive semidefinite and G ≥ 0 with unit diagonal.

t is a lower bound exactly where M − tG is copositive. Deciding that is NP-hard; a sum of a positive semidefinite and an
entrywise nonnegative matrix is copositive (up to order 4 every copositive matrix is one, by Diananda's theorem), and
the largest such t is the value of a semidefinite program.
"""

from __future__ import annotations

import numpy as np

from vibench.arrays import Array

MAX_ITERATIONS = 1500
"""Iterations of the alternating direction method at most."""

CHECK_EVERY = 50
"""Iterations between two evaluations of the certified bounds, which cost an eigenvalue decomposition each."""

ZERO_ATOL = 1e-14
"""Entries of a Gram matrix of unit vectors below this are zeros that were rounded."""


def entrywise_bound(M: Array, G: Array) -> float:
    """The largest t ≥ 0 with M ≥ tG entrywise where G is positive, corrected for negative M where it is zero; or 0.

    Where G is zero but for round-off (`ZERO_ATOL`), with −n the smallest entry of M there,
    αᵀ(M − tG)α ≥ −n (Σα)² ≥ −n R αᵀGα.
    """
    positive = G > ZERO_ATOL
    negative = -float(np.min(M[~positive], initial=0.0))
    return max(0.0, float(np.min(M[positive] / G[positive])) - len(G) * negative)


def semidefinite_bounds(M: Array, G: Array, upper: float, share: float) -> tuple[float, float]:
    """Lower and upper bounds from the largest t with M − tG = P + N, P positive semidefinite and N ≥ 0 entrywise.

    The alternating direction method of multipliers of Wen, Goldfarb and Yin (2010) on max t: tG + P + N = M. Its
    iterates are not feasible, so they only propose N: with −δ the smallest eigenvalue of M − tG − N,
    αᵀ(M − tG)α ≥ −δ‖α‖² ≥ −δ αᵀGα certifies t − δ. The matrix of multipliers X is ααᵀ where the relaxation is exact;
    the quotient at the nonnegative part of its leading eigenvector is an upper bound in any case.

    Parameters
    ----------
    M, G
        Symmetric (R×R), M positive semidefinite; G ≥ 0 entrywise, unit diagonal.
    upper
        Known upper bound on the quotient.
    share
        Stop where the lower bound reaches this share of the upper one.
    """
    scale = float(np.diag(M).max(initial=0.0))
    if scale <= 0.0:
        return 0.0, upper
    M, upper, lower, penalty = M / scale, upper / scale, 0.0, 1.0
    G_squared = float(np.sum(G * G))
    X, P, N = np.zeros_like(M), np.zeros_like(M), np.zeros_like(M)
    for iteration in range(1, MAX_ITERATIONS + 1):
        t = (float(np.sum(G * (M - P - N))) - penalty * (float(np.sum(G * X)) - 1.0)) / G_squared
        P = _positive_semidefinite_part(M - t * G - N - penalty * X)
        N = np.maximum(M - t * G - P - penalty * X, 0.0)
        residual = t * G + P + N - M
        X += 1.6 / penalty * residual  # a step of up to (1 + √5)/2 converges
        if iteration % CHECK_EVERY:
            continue
        lower = max(lower, t + min(float(np.linalg.eigvalsh(M - t * G - N)[0]), 0.0))
        upper = min(upper, _rounded_quotient(X, M, G))
        if lower >= share * upper:
            break
        primal = abs(float(np.sum(G * X)) - 1.0) + float(np.linalg.norm(np.minimum(X, 0.0)))
        dual = float(np.linalg.norm(residual))
        penalty *= 0.6 if dual < 0.1 * primal else 1.6 if primal < 0.1 * dual else 1.0
    return scale * lower, scale * upper


def _positive_semidefinite_part(a: Array) -> Array:
    values, vectors = np.linalg.eigh(0.5 * (a + a.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _rounded_quotient(X: Array, M: Array, G: Array) -> float:
    """The quotient at the nonnegative part of the leading eigenvector of X."""
    leading = np.linalg.eigh(X)[1][:, -1]
    alpha = np.maximum(leading if leading.sum() >= 0.0 else -leading, 0.0)
    return float(alpha @ M @ alpha) / float(alpha @ G @ alpha)
