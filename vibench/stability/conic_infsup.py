"""The inf-sup constant over a cone as a certified interval: a ladder of bounds, climbed as far as the gap asks for.

With images C of the generators and their Gram matrices M = CᵀC and G, the constant is min ‖Cα‖ / √(αᵀGα) over α ≥ 0.
Upper bounds: U0, the best single generator; U1, the quotient at the minimiser of ‖Cα‖ over the simplex; U2, an
active-set descent on the quotient from several starts; UB, what branch and bound came upon. Lower bounds: L0, the
constant over the span; L1, min_i yᵀc_i with y the direction of the image of that minimiser, valid because
‖χα‖ ≤ Σα; L½, √min M_ij/G_ij; SDP, the semidefinite bound; BB, branch and bound (`vibench.stability.copositive`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.linalg
from scipy.optimize import nnls

from vibench.arrays import Array
from vibench.stability.copositive import ROUNDED, entrywise_bound, semidefinite_bound, split_bound

GAP = 0.01
"""Relative width below which an interval is narrow enough."""

RELATIVE = 1e-8
ABSOLUTE = 1e-12
"""Round-off of inf-sup constants: relative, and in units of the norm of the images."""


def cone_interval(C: Array, G: Array, span: float) -> tuple[float, float, str]:
    """Certified bounds on min ‖Cα‖/√(αᵀGα) over α ≥ 0.

    Parameters
    ----------
    C
        Images (N'×R) of the generators.
    G
        Gram matrix (R×R), unit diagonal. Only L0 and L1 are known to hold where it has negative entries.
    span
        The same minimum over all α: β_span.

    Returns
    -------
    tuple
        Lower bound, upper bound, and the names of those that were sharpest, "L½/U0". Infinite without generators.
    """
    if not len(G):
        return float("inf"), float("inf"), ""
    lowers: dict[str, float] = {"L0": span}
    uppers: dict[str, float] = {}
    noise = ABSOLUTE * float(np.linalg.norm(C, 2)) if C.size else 0.0
    for bounds in _ladder(C, G, uppers):
        for name, value in bounds.items():
            (uppers if name.startswith("U") else lowers)[name] = value
        low, high = max(lowers, key=lambda k: lowers[k]), min(uppers, key=lambda k: uppers[k])
        if lowers[low] >= (1.0 - GAP) * uppers[high] or uppers[high] <= noise:
            break
    if uppers[high] < lowers[low] <= uppers[high] * (1.0 + RELATIVE) + noise:  # equal but for round-off
        return uppers[high], uppers[high], f"{low}/{high}"
    return lowers[low], uppers[high], f"{low}/{high}"


def _ladder(C: Array, G: Array, uppers: dict[str, float]) -> Iterator[dict[str, float]]:
    """Rungs from cheap to dear; `uppers` holds the upper bounds of the rungs so far."""
    M = C.T @ C
    alpha = simplex_minimiser(C)
    image = C @ alpha
    norm = float(np.linalg.norm(image))
    nonnegative = bool(G.min() >= -ROUNDED)
    yield {
        "U0": float(np.sqrt(np.min(np.diag(M) / np.diag(G)))),
        "U1": _quotient(C, G, alpha),
        "L1": max(0.0, float(np.min(image @ C)) / norm) if norm > 0.0 else 0.0,
    } | ({"L½": float(np.sqrt(entrywise_bound(M, G)))} if nonnegative else {})
    yield {"U2": min(_quotient(C, G, descend(M, G, start)) for start in _starts(M, G, alpha))}
    if nonnegative:
        target = ((1.0 - 0.5 * GAP) * min(uppers.values())) ** 2
        yield {"SDP": float(np.sqrt(max(semidefinite_bound(M, G, target), 0.0)))}
        lower, upper = split_bound(M, G, min(uppers.values()) ** 2, (1.0 - 0.5 * GAP) ** 2)
        yield {"BB": float(np.sqrt(max(lower, 0.0))), "UB": float(np.sqrt(upper))}


def _quotient(C: Array, G: Array, alpha: Array) -> float:
    """‖Cα‖ / √(αᵀGα); nothing cancels in the denominator for nonnegative α and G."""
    return float(np.linalg.norm(C @ alpha) / np.sqrt(alpha @ G @ alpha))


def _starts(M: Array, G: Array, alpha: Array) -> list[Array]:
    """Where the descent starts: the simplex minimiser, the best generator, the pair of smallest entrywise quotient."""
    best, pair = np.zeros(len(G)), np.zeros(len(G))
    best[np.argmin(np.diag(M) / np.diag(G))] = 1.0
    touching = G > ROUNDED
    quotients = np.where(touching, M / np.where(touching, G, 1.0), np.inf)
    pair[list(np.unravel_index(int(np.argmin(quotients)), G.shape))] = 1.0
    return [alpha, best, pair, np.ones(len(G))]


def simplex_minimiser(C: Array) -> Array:
    """Minimiser α (R,) of ‖Cα‖ over α ≥ 0, Σα = 1.

    The nonnegative least squares solution of [C; 1ᵀ]α ≈ [0; 1], with C in units of its largest column, is a multiple
    of it: at the optimum ‖Cα‖² = t²q and t minimises t²q + (t − 1)², so the sum t alone depends on the weight.
    """
    size = float(np.linalg.norm(C, axis=0).max(initial=0.0)) or 1.0
    system = np.vstack([C / size, np.ones(C.shape[1])])
    target = np.zeros(system.shape[0])
    target[-1] = 1.0
    alpha, _ = nnls(system, target, maxiter=30 * C.shape[1])
    return np.asarray(alpha / alpha.sum())


def descend(M: Array, G: Array, start: Array) -> Array:
    """Active-set descent on αᵀMα / αᵀGα over α ≥ 0 to a local minimiser (R,).

    On the face of the present support the minimum is the smallest generalised eigenvector; the quotient falls all the
    way towards it, as far as α stays nonnegative. At the minimum of a face the generator along which the quotient
    falls fastest enters.

    Parameters
    ----------
    M, G
        Symmetric positive semidefinite (R×R), G with unit diagonal.
    start
        α ≥ 0 (R,), not zero.
    """
    alpha = start / np.sqrt(start @ G @ start)
    value = float(alpha @ M @ alpha)
    for _ in range(20 * len(G)):
        alpha = _to_minimum_of_face(M, G, alpha)
        gradient = M @ alpha - float(alpha @ M @ alpha) * (G @ alpha)
        entering = int(np.argmin(np.where(alpha > 0.0, np.inf, gradient)))
        if alpha[entering] == 0.0 and gradient[entering] < 0.0:
            alpha = _along(M, G, alpha, entering)
        reached = float(alpha @ M @ alpha)
        if reached >= value * (1.0 - 1e-12):
            break
        value = reached
    return alpha


def _to_minimum_of_face(M: Array, G: Array, alpha: Array) -> Array:
    """Follow the smallest eigenvectors of ever smaller faces until one is inside its face."""
    alpha = alpha.copy()
    while True:
        face = np.flatnonzero(alpha)
        pick = np.ix_(face, face)
        _, vectors = scipy.linalg.eigh(M[pick], G[pick] + 1e-12 * np.eye(len(face)))
        target = vectors[:, 0]
        target = target if target @ G[pick] @ alpha[face] >= 0.0 else -target
        leaving = target < 0.0
        if not leaving.any():
            alpha[face] = target
            return np.asarray(alpha / np.sqrt(alpha @ G @ alpha))
        steps = np.where(leaving, alpha[face] / np.where(leaving, alpha[face] - target, 1.0), np.inf)
        first = int(np.argmin(steps))
        alpha[face] = np.maximum(alpha[face] + steps[first] * (target - alpha[face]), 0.0)
        alpha[face[first]] = 0.0
        alpha /= np.sqrt(alpha @ G @ alpha)


def _along(M: Array, G: Array, alpha: Array, k: int) -> Array:
    """α + s e_k with the s > 0 that minimises the quotient, or e_k where that is s = ∞; the quotient falls at s = 0."""
    m0, m1, m2 = float(alpha @ M @ alpha), float(M[k] @ alpha), float(M[k, k])
    g0, g1, g2 = 1.0, float(G[k] @ alpha), float(G[k, k])
    # derivative: (m2 g1 − m1 g2) s² + (m2 g0 − m0 g2) s + (m1 g0 − m0 g1) = 0, its value at s = 0 negative
    roots = np.roots([m2 * g1 - m1 * g2, m2 * g0 - m0 * g2, m1 * g0 - m0 * g1])
    ahead = [float(s.real) for s in roots if abs(s.imag) <= 1e-9 * abs(s) and s.real > 0.0]
    moved = alpha.copy() if ahead else np.zeros_like(alpha)
    moved[k] = min(ahead, default=1.0)
    return np.asarray(moved / np.sqrt(moved @ G @ moved))
