"""Certified lower bounds on a quotient of quadratic forms over nonnegative vectors, where cheap bounds leave a gap.

For M positive semidefinite and G entrywise nonnegative with unit diagonal, t bounds αᵀMα / αᵀGα over α ≥ 0 from below
exactly where M − tG is copositive. A sum of a positive semidefinite and an entrywise nonnegative matrix is copositive
(up to order 4 every copositive matrix is one, by Diananda's theorem); the largest such t is a semidefinite program.
Where that is not enough, the cone is split and every part is bounded by itself (Bundfuss and Dür, 2008).
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from itertools import count

import numpy as np

from vibench.arrays import Array

SWEEPS = 1500
"""Iterations of the alternating direction method for one semidefinite program, at most."""

ROUNDED = 1e-14
"""Entries of a Gram matrix of unit vectors below this are zeros that were rounded."""

CHECK = 50
"""Iterations between two looks at the bound they lead to."""

PARTS = 300
"""Parts a cone is split into, at most."""

SPLIT_ORDER = 32
"""Largest number of generators of a cone that is split: the parts would be too many beyond."""


def semidefinite_bound(M: Array, G: Array, target: float) -> float:
    """The largest t found with M − tG = P + N, P positive semidefinite and N ≥ 0 entrywise.

    The alternating direction method of multipliers of Wen, Goldfarb and Yin (2010) on max t: tG + P + N = M. Its
    iterates only propose N; the bound is what they prove: with −δ the smallest eigenvalue of M − tG − N,
    αᵀ(M − tG)α ≥ −δ‖α‖² ≥ −δ αᵀGα, hence t − δ.

    Parameters
    ----------
    M, G
        Symmetric (R×R); G ≥ 0 entrywise, unit diagonal.
    target
        A bound that is good enough to stop at.
    """
    size = float(np.diag(M).max(initial=0.0))
    if size <= 0.0:
        return 0.0
    M, target, mu = M / size, target / size, 1.0
    weight = float(np.sum(G * G))
    X, P, N = np.zeros_like(M), np.zeros_like(M), np.zeros_like(M)
    best = 0.0
    for sweep in range(1, SWEEPS + 1):
        t = (float(np.sum(G * (M - P - N))) - mu * (float(np.sum(G * X)) - 1.0)) / weight
        P = _semidefinite_part(M - t * G - N - mu * X)
        N = np.maximum(M - t * G - P - mu * X, 0.0)
        excess = t * G + P + N - M
        X += 1.6 / mu * excess
        if sweep % CHECK:
            continue
        smallest = float(np.linalg.eigvalsh(M - t * G - N)[0])
        best = max(best, t + min(smallest, 0.0))
        if best >= target:
            break
        primal, dual = abs(float(np.sum(G * X)) - 1.0) + _below(X), float(np.linalg.norm(excess))
        mu *= 0.6 if dual < 0.1 * primal else 1.6 if primal < 0.1 * dual else 1.0
    return size * best


def _semidefinite_part(a: Array) -> Array:
    values, vectors = np.linalg.eigh(0.5 * (a + a.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _below(x: Array) -> float:
    return float(np.linalg.norm(np.minimum(x, 0.0)))


def entrywise_bound(M: Array, G: Array) -> float:
    """The largest t ≥ 0 with M ≥ tG entrywise where G is positive, corrected for negative M where it is zero; or 0.

    Where G is zero but for round-off (`ROUNDED`), with −n the smallest entry of M there,
    αᵀ(M − tG)α ≥ −n (Σα)² ≥ −n R αᵀGα.
    """
    touching = G > ROUNDED
    negative = -float(np.min(M[~touching], initial=0.0))
    return max(0.0, float(np.min(M[touching] / G[touching])) - len(G) * negative)


@dataclass(order=True)
class _Part:
    """A part of the cone: its bound, and both forms on its generators (unit norm)."""

    bound: float
    number: int
    M: Array = field(compare=False)
    G: Array = field(compare=False)


def split_bound(M: Array, G: Array, upper: float, target: float) -> tuple[float, float]:
    """Lower and upper bounds by branch and bound: the part with the smallest bound is split until `target` is met.

    A part is split along the edge whose entry limits its entrywise bound, at the minimum of the quotient on that edge
    if that is well inside; the quotient there bounds the minimum from above. Deterministic.

    Parameters
    ----------
    M, G
        As in `semidefinite_bound`.
    upper
        Known upper bound on the quotient.
    target
        Share of the upper bound the lower one shall reach.
    """
    numbers = count()

    def part(M: Array, G: Array, inherited: float) -> _Part:
        bound = max(inherited, entrywise_bound(M, G))
        if bound < target * upper:
            bound = max(bound, semidefinite_bound(M, G, target * upper))
        return _Part(bound, next(numbers), M, G)

    parts = [part(M, G, 0.0)]
    while parts[0].bound < target * upper and len(parts) < PARTS and len(G) <= SPLIT_ORDER:
        worst = heapq.heappop(parts)
        i, j = _edge(worst)
        s = _edge_minimum(worst, i, j)
        first, second = (_replaced(worst, i, j, s, at) for at in (i, j))
        upper = min(upper, float(first[0][i, i]))
        for forms in (first, second):
            heapq.heappush(parts, part(*forms, worst.bound))
    return min(parts[0].bound, upper), upper


def _edge(part: _Part) -> tuple[int, int]:
    """The two generators whose forms are farthest from what the bound needs."""
    quotients = part.M - np.where(part.G > ROUNDED, part.G, 0.0) * np.diag(part.M).min()
    np.fill_diagonal(quotients, np.inf)
    i, j = np.unravel_index(int(np.argmin(quotients)), quotients.shape)
    return int(min(i, j)), int(max(i, j))


def _edge_minimum(part: _Part, i: int, j: int) -> float:
    """Where in [0.2, 0.8] the quotient of (1 − s)v_i + s v_j is smallest, to the grid that splitting needs."""
    s = np.linspace(0.2, 0.8, 25)
    ends = np.vstack([1.0 - s, s])
    pair = np.ix_([i, j], [i, j])
    quotient = np.sum(ends * (part.M[pair] @ ends), axis=0) / np.sum(ends * (part.G[pair] @ ends), axis=0)
    return float(s[int(np.argmin(quotient))])


def _replaced(part: _Part, i: int, j: int, s: float, at: int) -> tuple[Array, Array]:
    """Both forms with generator `at` replaced by the normalised (1 − s)v_i + s v_j."""
    change = np.eye(len(part.G))
    change[:, at] = 0.0
    change[i, at], change[j, at] = 1.0 - s, s
    M, G = change.T @ part.M @ change, change.T @ part.G @ change
    scale = np.ones(len(G))
    scale[at] = 1.0 / np.sqrt(G[at, at])
    return scale[:, None] * M * scale, scale[:, None] * G * scale
