"""The inf-sup constant over a cone as a certified interval: cheap bounds first, then a semidefinite program.

With C the projected supremizers of the generators, M = CᵀC and G the Gram matrix of the generators, the constant is
min ‖Cα‖ / √(αᵀGα) over α ≥ 0. Lower bounds: L0, the constant over the span; L1, min_i yᵀc_i with y = Cα*/‖Cα*‖ and α*
the minimiser of ‖Cα‖ over the simplex, valid because ‖χα‖ ≤ Σα; L½, √min M_ij/G_ij; SDP, the semidefinite bound. Upper
bounds: U0, the best single generator; U1, the quotient at α*; U2, the quotient at a vector rounded from the
semidefinite program.

The semidefinite program: t is a lower bound of αᵀMα / αᵀGα exactly where M − tG is copositive. Deciding that is
NP-hard; a sum of a positive semidefinite and an entrywise nonnegative matrix is copositive (up to order 4 every
copositive matrix is one, by Diananda's theorem), and the largest such t is the value of a semidefinite program.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from vibench.arrays import Array

GAP = 0.01
"""Relative width below which an interval is narrow enough."""

RELATIVE = 1e-8
ABSOLUTE = 1e-12
"""Round-off of inf-sup constants: relative, and in units of the norm of C."""


def cone_interval(C: Array, G: Array, span: float) -> tuple[float, float, str]:
    """Certified lower and upper bounds on min ‖Cα‖/√(αᵀGα) over α ≥ 0, and the names of the sharpest ones, "L½/U0".

    The minimum is NP-hard in general, and the interval is reported as it is where it stays wider than `GAP`. The bounds
    are infinite without generators.

    Parameters
    ----------
    C
        Projected supremizers (N'×R) of the generators.
    G
        Gram matrix (R×R), unit diagonal. Only L0 and L1 are known to hold where it has negative entries.
    span
        The same minimum over all α: β_span.
    """
    if not len(G):
        return float("inf"), float("inf"), ""
    M, noise = C.T @ C, ABSOLUTE * float(np.linalg.norm(C, 2)) if C.size else 0.0
    lowers, uppers = _cheap_bounds(C, M, G, span)
    low, high = _sharpest(lowers, uppers)
    narrow = lowers[low] >= (1.0 - GAP) * uppers[high] or uppers[high] <= noise
    if not narrow and G.min() >= -ZERO_ATOL:
        squares = semidefinite_bounds(M, G, uppers[high] ** 2, share=(1.0 - 0.5 * GAP) ** 2)
        lowers["SDP"], uppers["U2"] = (float(np.sqrt(max(square, 0.0))) for square in squares)
        low, high = _sharpest(lowers, uppers)
    if uppers[high] < lowers[low] <= uppers[high] * (1.0 + RELATIVE) + noise:  # equal but for round-off
        return uppers[high], uppers[high], f"{low}/{high}"
    return lowers[low], uppers[high], f"{low}/{high}"


def _cheap_bounds(C: Array, M: Array, G: Array, span: float) -> tuple[dict[str, float], dict[str, float]]:
    """Lower and upper bounds by name that need no iteration but one nonnegative least squares problem."""
    alpha = simplex_minimiser(C)
    nearest = C @ alpha
    norm = float(np.linalg.norm(nearest))
    lowers = {"L0": span, "L1": max(0.0, float(np.min(nearest @ C)) / norm) if norm > 0.0 else 0.0}
    if G.min() >= -ZERO_ATOL:
        lowers["L½"] = float(np.sqrt(entrywise_bound(M, G)))
    # ‖Cα‖, not √(αᵀMα): the square would lose half of the digits; the denominator has no cancellation
    uppers = {"U0": float(np.sqrt(np.min(np.diag(M) / np.diag(G)))), "U1": norm / float(np.sqrt(alpha @ G @ alpha))}
    return lowers, uppers


def _sharpest(lowers: dict[str, float], uppers: dict[str, float]) -> tuple[str, str]:
    return max(lowers, key=lowers.__getitem__), min(uppers, key=uppers.__getitem__)


def simplex_minimiser(C: Array) -> Array:
    """Minimiser α (R,) of ‖Cα‖ over α ≥ 0, Σα = 1.

    The nonnegative least squares solution of [C; 1ᵀ]α ≈ [0; 1], with C in units of its largest column, is a multiple
    of it: at the optimum ‖Cα‖² = t²q and t minimises t²q + (t − 1)², so the sum t alone depends on the weight.
    """
    scale = float(np.linalg.norm(C, axis=0).max(initial=0.0)) or 1.0
    system = np.vstack([C / scale, np.ones(C.shape[1])])
    alpha, _ = nnls(system, np.append(np.zeros(len(C)), 1.0), maxiter=30 * C.shape[1])
    return np.asarray(alpha / alpha.sum())


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
