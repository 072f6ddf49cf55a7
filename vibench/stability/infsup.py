"""Inf-sup constants at one or many parameters: over the span of the generators exactly, over the cone as an interval.

With an orthonormal basis Z of the primal space and generators χ of unit norm, C = ZᵀBᵀχ, G = χᵀX_Wχ, M = CᵀC,

    β_span = min ‖Cα‖ / ‖χα‖_W over all α,    β_cone = the same minimum over α ≥ 0   (paper, (14), (18), (30)).

The second is NP-hard in general and is bounded from both sides, see docs/mathematics.md, "Inf-sup constants". β_span is
a singular value, never the square root of an eigenvalue of M, which has a floor of √eps.

A t is a lower bound of αᵀMα / αᵀGα exactly where M − tG is copositive. Deciding that is NP-hard; a sum of a positive
semidefinite and an entrywise nonnegative matrix is copositive, and the largest such t is the value of a semidefinite
program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

import numpy as np
from scipy.optimize import nnls

from vibench.arrays import Array, Mask, SparseMatrix
from vibench.interfaces.strategies import no_free
from vibench.linalg.inner_product import RANK_RTOL, InnerProduct, singular_values, svd
from vibench.reduction.cones import LazyMaximum
from vibench.reduction.supremizers import ConstraintClasses, isometric_supremizers, projected_supremizers

# Constants below this are zero up to round-off.
VANISHES = 1e-12

# Round-off of inf-sup constants: relative, and in units of the norm of C.
RELATIVE, ABSOLUTE = 1e-8, 1e-12


@dataclass(frozen=True)
class ConeBasis:
    """A reduced cone with its span and Gram matrix.

    One instance serves every constant of a cone, so that all share one rank decision: constants of different primal
    spaces would not be comparable otherwise.
    """

    # Generators (m×R), unit norm in W.
    chi: Annotated[Array, "m", "R"]
    # W-orthonormal basis of span χ (m×rank): the leading left singular vectors.
    span: Array
    # G (R×R), and which generators may be used with either sign (R,).
    gram: Array
    free: Mask
    # Those of χ in W, falling; those above `RANK_RTOL` of the largest count for the rank. Empty for the high-fidelity
    # cone, whose generators are independent.
    singular_values: Array

    @property
    def rank(self) -> int:
        """Numerical rank of χ."""
        return int(self.span.shape[1])

    @property
    def gram_condition(self) -> float | None:
        """Condition number of G; `None` without singular values."""
        # Use the singular values of χ: those of G have a floor of round-off, and its condition would be 1e16 at most.
        s, R = self.singular_values, self.chi.shape[1]
        if not len(s):
            return None
        return float((s[0] / s[-1]) ** 2) if len(s) == R and s[-1] > 0.0 else float("inf")

    @property
    def rank_gap(self) -> float:
        """The last singular value that counts for the rank over what is below it: the next one, or the threshold.

        A value near one says that the rank depends on the threshold; infinite without singular values.
        """
        s, rank = self.singular_values, self.rank
        if not rank or not len(s):
            return float("inf")
        below = s[rank] if rank < len(s) else RANK_RTOL * s[0]
        return float(s[rank - 1] / below) if below > 0.0 else float("inf")


@dataclass(frozen=True)
class InfSup:
    """Inf-sup constants of one pair of spaces at one parameter; `sharp` names the bounds of the cone interval."""

    span: float
    cone_lower: float
    cone_upper: float
    sharp: str

    def scaled(self, factor: float) -> InfSup:
        """The constants for the bilinear form b multiplied by a number."""
        size = abs(factor)
        return InfSup(size * self.span, size * self.cone_lower, size * self.cone_upper, self.sharp)


def cone_basis(
    chi: Annotated[Array, "m", "R"], W: Annotated[InnerProduct, "m"], free: Annotated[Mask, "R"] | None = None
) -> ConeBasis:
    """`ConeBasis` of generators (m×R) of unit norm; `free` (R,) marks those without a sign, none by default."""
    whitened = W.whiten(chi)
    free = no_free(chi.shape[1]) if free is None else free
    vectors, s, _ = svd(whitened) if chi.size else (chi, np.zeros(0), None)
    span = W.unwhiten(vectors[:, s > RANK_RTOL * s.max(initial=0.0)])
    return ConeBasis(chi, span, whitened.T @ whitened, free, s)


def inf_sup(on_span: Array, on_generators: Array, cone: ConeBasis) -> InfSup:
    """Span constant and cone interval from coordinates of the supremizers projected on the primal space.

    The coordinates are ZᵀBᵀ times `cone.span` (N'×rank), Z orthonormal, and ZᵀBᵀχ (N'×R), or any isometric image of
    both. The constants are zero without primal vectors and infinite without multipliers.
    """
    span = beta_span(on_span)
    # A generator without forces, as on a zero row of B alone, would leave round-off.
    if not on_generators.any(axis=0).all():
        span = 0.0
    if np.any(cone.free) and np.all(cone.free):  # the cone is its span
        return InfSup(span, span, span, "span/span")
    lower, upper, sharp = cone_interval(_with_few_rows(on_generators), cone.gram, span)
    # α ≥ 0 is a subset of a cone with free generators: only upper bounds carry over, and β_span bounds from below.
    if np.any(cone.free):
        return InfSup(span, min(span, upper), upper, f"span/{sharp.split('/')[1]}")
    return InfSup(span, lower, upper, sharp)


def _with_few_rows(projected: Array) -> Array:
    return projected if projected.shape[0] <= projected.shape[1] else np.asarray(np.linalg.qr(projected, mode="r"))


def beta_span(on_span: Annotated[Array, "N", "rank"]) -> float:
    """Smallest singular value of ZᵀBᵀ on an orthonormal basis of span χ (N'×rank); 0 exactly when N' < rank."""
    rows, rank = on_span.shape
    if not rank:
        return float("inf")
    return 0.0 if rows < rank else float(singular_values(_with_few_rows(on_span))[-1])


def stability_ratio(beta: float, reachable: float) -> float:
    """Ratio of β_span to that of the whole of V, which no primal space exceeds; 1 where that is 0 or infinite."""
    return beta / reachable if VANISHES < reachable < float("inf") else 1.0


def inf_sup_on(Z: Annotated[Array, "n", "N'"], B: Annotated[SparseMatrix, "m", "n"], cone: ConeBasis) -> InfSup:
    """Constants of a primal space with V-orthonormal basis Z (n×N') at the parameter of B (m×n)."""
    projected = projected_supremizers(Z, B, np.hstack([cone.span, cone.chi]))
    return inf_sup(projected[:, : cone.rank], projected[:, cone.rank :], cone)


def inf_sup_full(V: Annotated[InnerProduct, "n"], B: Annotated[SparseMatrix, "m", "n"], cone: ConeBasis) -> InfSup:
    """Constants of the whole of V, where T(mu)η attains the supremum: those of online supremizers."""
    on_span, on_generators = (V.whiten_functional(np.asarray(B.T @ eta)) for eta in (cone.span, cone.chi))
    return inf_sup(on_span, on_generators, cone)


def nodal_cone(W: InnerProduct) -> ConeBasis:
    """The high-fidelity cone W⁺, generated by the normalised nodal or cell functions."""
    chi = np.eye(W.dim) / W.norm(np.eye(W.dim))
    # They are independent; a singular value decomposition of this size would cost seconds.
    return ConeBasis(chi, W.unwhiten(np.eye(W.dim)), W.gram(chi, chi), no_free(W.dim), np.zeros(0))


def constants_full(V: InnerProduct, classes: ConstraintClasses, cone: ConeBasis) -> list[InfSup]:
    """Constants of the whole of V at every B(mu) (m×n)."""
    image = isometric_supremizers(V, classes.representatives, cone.rank + cone.chi.shape[1])
    constants = [inf_sup(image(B, cone.span), image(B, cone.chi), cone) for B in classes.representatives]
    return expand_classes(classes, constants)


def constants_on(Z: Array, classes: ConstraintClasses, cone: ConeBasis) -> list[InfSup]:
    """Constants of one primal space with V-orthonormal basis Z (n×N') at every B(mu)."""
    return expand_classes(classes, [inf_sup_on(Z, B, cone) for B in classes.representatives])


def expand_classes(classes: ConstraintClasses, constants: Sequence[InfSup]) -> list[InfSup]:
    """Expand the constants of the representatives to all matrices."""
    return [constants[k].scaled(c) for k, c in zip(classes.members, classes.factors, strict=True)]


@dataclass(frozen=True)
class ProjectedSupremizers:
    """Supremizers of an orthonormal multiplier basis η, projected on a nested primal basis Z.

    `of_classes` has one matrix ZᵀBᵀη (N'×k) for each of the classes of constraint matrices.
    """

    of_classes: Sequence[Array]
    classes: ConstraintClasses
    # Cached β_span by the numbers of vectors and of the class: several histories need the same.
    _known: dict[tuple[int, int], float] = field(default_factory=dict, repr=False, compare=False)

    def first(self, count: int) -> ProjectedSupremizers:
        """The projections on the first `count` vectors of Z."""
        return ProjectedSupremizers([projected[:count] for projected in self.of_classes], self.classes)

    def beta_span(self) -> Array:
        """The constant β_span at every parameter (P,)."""
        return self.classes.expand_classes([beta_span(projected) for projected in self.of_classes])

    def over_steps(self, first: int) -> Array:
        """The smallest β_span over all parameters with the first `first`, … N' vectors (N' − first + 1,)."""
        factors = np.abs(self.classes.factors)
        weights = [float(np.min(factors[self.classes.members == k])) for k in range(len(self.of_classes))]
        return self._smallest(first, lambda beta, k: weights[k] * beta)

    def stability_ratios(self, first: int, reachable: Array) -> Array:
        """The smallest `stability_ratio` to `reachable` (P,), the β_span of the whole of V, likewise."""
        of_representatives = reachable[self.classes.firsts]
        return self._smallest(first, lambda beta, k: stability_ratio(beta, of_representatives[k]))

    def _smallest(self, first: int, value: Callable[[float, int], float]) -> Array:
        """The smallest value over all classes, each from the β_span of its representative."""

        def negative(count: int, k: int) -> float:
            if (count, k) not in self._known:
                self._known[count, k] = beta_span(self.of_classes[k][:count])
            return -value(self._known[count, k], k)

        # β_span never decreases as Z grows: values of earlier steps are lower bounds, and most are never updated.
        lazy, last = LazyMaximum(np.zeros(len(self.of_classes))), self.of_classes[0].shape[0]
        return np.array([-lazy.next(partial(negative, count))[1] for count in range(first, last + 1)])


def cone_interval(C: Array, G: Array, span: float) -> tuple[float, float, str]:
    """Certified lower and upper bounds on min ‖Cα‖/√(αᵀGα) over α ≥ 0, and the names of the sharpest ones, "L½/U0".

    The interval is reported as it is where it stays wider than one percent. The bounds are infinite without generators.
    C (N'×R) are the projected supremizers of the generators, G (R×R) has a unit diagonal. Only L0 and L1 are known to
    hold where G has negative entries. `span` is the same minimum over all α: β_span.
    """
    if not len(G):
        return float("inf"), float("inf"), ""
    M, noise = C.T @ C, ABSOLUTE * float(np.linalg.norm(C, 2)) if C.size else 0.0
    alpha = simplex_minimiser(C)
    nearest = C @ alpha
    norm = float(np.linalg.norm(nearest))
    lowers = {"L0": span, "L1": max(0.0, float(np.min(nearest @ C)) / norm) if norm > 0.0 else 0.0}
    if _is_nonnegative(G):
        lowers["L½"] = float(np.sqrt(entrywise_bound(M, G)))
    # Use ‖Cα‖, not √(αᵀMα), which would lose half of the digits; the denominator has no cancellation.
    uppers = {"U0": float(np.sqrt(np.min(np.diag(M) / np.diag(G)))), "U1": norm / float(np.sqrt(alpha @ G @ alpha))}
    low, high = max(lowers, key=lowers.__getitem__), min(uppers, key=uppers.__getitem__)
    narrow = lowers[low] >= 0.99 * uppers[high] or uppers[high] <= noise
    if not narrow and _is_nonnegative(G):
        squares = semidefinite_bounds(M, G, uppers[high] ** 2, fraction=0.995**2)
        lowers["SDP"], uppers["U2"] = (float(np.sqrt(max(square, 0.0))) for square in squares)
        low, high = max(lowers, key=lowers.__getitem__), min(uppers, key=uppers.__getitem__)
    if uppers[high] < lowers[low] <= uppers[high] * (1.0 + RELATIVE) + noise:  # equal but for round-off
        return uppers[high], uppers[high], f"{low}/{high}"
    return lowers[low], uppers[high], f"{low}/{high}"


def simplex_minimiser(C: Array) -> Array:
    """Minimiser α (R,) of ‖Cα‖ over α ≥ 0, Σα = 1.

    The nonnegative least squares solution of [C; 1ᵀ]α ≈ [0; 1], with C in units of its largest column, is a multiple
    of it: at the optimum ‖Cα‖² = t²q and t minimises t²q + (t − 1)², so the sum t alone depends on the weight.
    """
    scale = float(np.linalg.norm(C, axis=0).max(initial=0.0)) or 1.0
    system = np.vstack([C / scale, np.ones(C.shape[1])])
    alpha, _ = nnls(system, np.append(np.zeros(len(C)), 1.0), maxiter=30 * C.shape[1])
    return np.asarray(alpha / alpha.sum())


def _is_nonnegative(G: Array) -> bool:
    return bool(G.min() >= -1e-14)  # zeros of the Gram matrix of unit vectors may be rounded


def entrywise_bound(M: Array, G: Array) -> float:
    """The largest t ≥ 0 with M ≥ tG entrywise where G is positive, corrected for negative M where it is zero; or 0.

    Where G is zero but for round-off, with −n the smallest entry of M there, αᵀ(M − tG)α ≥ −n (Σα)² ≥ −n R αᵀGα.
    """
    positive = G > 1e-14  # as in `_is_nonnegative`
    negative = -float(np.min(M[~positive], initial=0.0))
    return max(0.0, float(np.min(M[positive] / G[positive])) - len(G) * negative)


def semidefinite_bounds(M: Array, G: Array, upper: float, fraction: float) -> tuple[float, float]:
    """Lower and upper bounds from the largest t with M − tG = P + N, P positive semidefinite and N ≥ 0 entrywise.

    The alternating direction method of multipliers of Wen, Goldfarb and Yin (2010) on max t: tG + P + N = M. Its
    iterates are not feasible, so they only propose N: with −δ the smallest eigenvalue of M − tG − N,
    αᵀ(M − tG)α ≥ −δ‖α‖² ≥ −δ αᵀGα certifies t − δ. The matrix of multipliers X is ααᵀ where the relaxation is exact;
    the quotient at the nonnegative part of its leading eigenvector is an upper bound in any case.

    M and G are symmetric (R×R), M positive semidefinite; G ≥ 0 entrywise has a unit diagonal. `upper` is a known bound
    of the quotient. Iterations end where the lower bound reaches a `fraction` of the upper one.
    """
    scale = float(np.diag(M).max(initial=0.0))
    if scale <= 0.0:
        return 0.0, upper
    M, upper, lower, penalty = M / scale, upper / scale, 0.0, 1.0
    G_squared = float(np.sum(G * G))
    X, P, N = np.zeros_like(M), np.zeros_like(M), np.zeros_like(M)
    for iteration in range(1, 1501):  # most programs need a few hundred
        t = (float(np.sum(G * (M - P - N))) - penalty * (float(np.sum(G * X)) - 1.0)) / G_squared
        rest = M - t * G - N - penalty * X
        values, vectors = np.linalg.eigh(0.5 * (rest + rest.T))
        P = (vectors * np.maximum(values, 0.0)) @ vectors.T  # the positive semidefinite part
        N = np.maximum(M - t * G - P - penalty * X, 0.0)
        residual = t * G + P + N - M
        X += 1.6 / penalty * residual  # a step of up to (1 + √5)/2 converges
        if iteration % 50:  # the certified bounds cost an eigenvalue decomposition each
            continue
        lower = max(lower, t + min(float(np.linalg.eigvalsh(M - t * G - N)[0]), 0.0))
        leading = np.linalg.eigh(X)[1][:, -1]
        alpha = np.maximum(leading if leading.sum() >= 0.0 else -leading, 0.0)
        upper = min(upper, float(alpha @ M @ alpha) / float(alpha @ G @ alpha))
        if lower >= fraction * upper:
            break
        primal = abs(float(np.sum(G * X)) - 1.0) + float(np.linalg.norm(np.minimum(X, 0.0)))
        dual = float(np.linalg.norm(residual))
        # Balance the residuals: neither may lag far behind the other.
        penalty *= 0.6 if dual < 0.1 * primal else 1.6 if primal < 0.1 * dual else 1.0
    return scale * lower, scale * upper
