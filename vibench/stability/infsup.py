"""Inf-sup constants at one or many parameters: over the span of the generators exactly, over the cone as an interval.

With an orthonormal basis Z of the primal space and generators χ of unit norm, C = ZᵀBᵀχ, G = χᵀX_Wχ, M = CᵀC,

    β_span = min ‖Cα‖ / ‖χα‖_W over all α,    β_cone = the same minimum over α ≥ 0   (paper, (14), (18), (30)).

The second is NP-hard in general and is bounded from both sides. β_span is a singular value, never the square root of an
eigenvalue of M: that has a floor of √eps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from vibench.arrays import Array, Mask, SparseMatrix
from vibench.interfaces.strategies import no_free
from vibench.linalg.inner_product import RANK_RTOL, InnerProduct, singular_values, svd
from vibench.reduction.cones import LazyMaximum
from vibench.reduction.supremizers import ConstraintClasses, isometric_supremizers, projected_supremizers
from vibench.stability.conic_infsup import cone_interval

UNSIGNED = "span"
"""Name of the lower bound β_span in the intervals of cones with free generators; no other bound is valid for them."""

VANISHES = 1e-12
"""Constants below this are zero up to round-off."""


@dataclass(frozen=True)
class Multipliers:
    """A reduced cone with its span and Gram matrix.

    One instance serves every constant of a cone, so that all share one rank decision: constants of different primal
    spaces would not be comparable otherwise.
    """

    chi: Array
    """Generators (m×R), unit norm in W."""
    span: Array
    """W-orthonormal basis of span χ (m×rank): the leading left singular vectors."""
    gram: Array
    """G (R×R)."""
    free: Mask
    """Which generators may be used with either sign (R,)."""
    singular_values: Array
    """Singular values of χ in W, falling; those above `RANK_RTOL` of the largest count for the rank. Empty for the
    high-fidelity cone, whose generators are independent."""

    @property
    def rank(self) -> int:
        """Numerical rank of χ."""
        return int(self.span.shape[1])

    @property
    def gram_condition(self) -> float | None:
        """Condition number of G; `None` without singular values.

        From the singular values of χ: those of G itself have a floor of round-off, where it seems to be 1e16 at most.
        """
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


def multipliers(chi: Array, W: InnerProduct, free: Mask | None = None) -> Multipliers:
    """`Multipliers` of generators (m×R) of unit norm; `free` (R,) marks those without a sign, none by default."""
    whitened = W.whiten(chi)
    free = no_free(chi.shape[1]) if free is None else free
    vectors, s, _ = svd(whitened) if chi.size else (chi, np.zeros(0), None)
    span = W.unwhiten(vectors[:, s > RANK_RTOL * s.max(initial=0.0)])
    return Multipliers(chi, span, whitened.T @ whitened, free, s)


def inf_sup(on_span: Array, on_generators: Array, cone: Multipliers) -> InfSup:
    """Span constant and cone interval from coordinates of the supremizers projected on the primal space.

    The constants are zero without primal vectors and infinite without multipliers.

    Parameters
    ----------
    on_span
        ZᵀBᵀ times `cone.span` (N'×rank), Z orthonormal; or any isometric image of it.
    on_generators
        ZᵀBᵀχ (N'×R), likewise.
    cone
        The reduced cone.
    """
    span = beta_span(on_span)
    if np.any(cone.free) and np.all(cone.free):  # the cone is its span
        return InfSup(span, span, span, f"{UNSIGNED}/{UNSIGNED}")
    lower, upper, sharp = cone_interval(_with_few_rows(on_generators), cone.gram, span)
    if np.any(cone.free):  # α ≥ 0 is a subset of the cone: only upper bounds carry over
        return InfSup(span, min(span, upper), upper, f"{UNSIGNED}/{sharp.split('/')[1]}")
    return InfSup(span, lower, upper, sharp)


def _with_few_rows(projected: Array) -> Array:
    """An isometric image of the columns (k×R) with no more rows than columns."""
    return projected if projected.shape[0] <= projected.shape[1] else np.asarray(np.linalg.qr(projected, mode="r"))


def beta_span(on_span: Array) -> float:
    """Smallest singular value of ZᵀBᵀ on an orthonormal basis of span χ (N'×rank); 0 exactly when N' < rank."""
    rows, rank = on_span.shape
    if not rank:
        return float("inf")
    if rows < rank:
        return 0.0
    return float(singular_values(_with_few_rows(on_span))[-1])


def share(beta: float, reachable: float) -> float:
    """β_span as a share of that of the whole of V, which no primal space exceeds; 1 where that is 0 or infinite."""
    return beta / reachable if VANISHES < reachable < float("inf") else 1.0


def inf_sup_on(Z: Array, B: SparseMatrix, cone: Multipliers) -> InfSup:
    """Constants of a primal space with V-orthonormal basis Z (n×N') at the parameter of B (m×n)."""
    projected = projected_supremizers(Z, B, np.hstack([cone.span, cone.chi]))
    return inf_sup(projected[:, : cone.rank], projected[:, cone.rank :], cone)


def inf_sup_full(V: InnerProduct, B: SparseMatrix, cone: Multipliers) -> InfSup:
    """Constants of the whole of V, where T(mu)η attains the supremum: those of online supremizers."""
    on_span, on_generators = (V.whiten_functional(np.asarray(B.T @ eta)) for eta in (cone.span, cone.chi))
    return inf_sup(on_span, on_generators, cone)


def nodal_multipliers(W: InnerProduct) -> Multipliers:
    """The high-fidelity cone W⁺, generated by the normalised nodal or cell functions."""
    chi = np.eye(W.dim) / W.norm(np.eye(W.dim))
    # Independent without any doubt: a singular value decomposition of this size would cost seconds.
    return Multipliers(chi, W.unwhiten(np.eye(W.dim)), W.gram(chi, chi), no_free(W.dim), np.zeros(0))


def constants_full(V: InnerProduct, classes: ConstraintClasses, cone: Multipliers) -> list[InfSup]:
    """Constants of the whole of V at every B(mu) (m×n)."""
    image = isometric_supremizers(V, classes.representatives, cone.rank + cone.chi.shape[1])
    constants = [inf_sup(image(B, cone.span), image(B, cone.chi), cone) for B in classes.representatives]
    return everywhere(classes, constants)


def constants_on(Z: Array, classes: ConstraintClasses, cone: Multipliers) -> list[InfSup]:
    """Constants of one primal space with V-orthonormal basis Z (n×N') at every B(mu)."""
    return everywhere(classes, [inf_sup_on(Z, B, cone) for B in classes.representatives])


def everywhere(classes: ConstraintClasses, constants: Sequence[InfSup]) -> list[InfSup]:
    """Constants of all matrices from those of the representatives."""
    return [constants[k].scaled(c) for k, c in zip(classes.members, classes.factors, strict=True)]


@dataclass(frozen=True)
class ProjectedSupremizers:
    """Supremizers of an orthonormal multiplier basis η, projected on a nested primal basis Z.

    `of_classes` has one matrix ZᵀBᵀη (N'×k) for each of the classes of constraint matrices.
    """

    of_classes: Sequence[Array]
    classes: ConstraintClasses
    _known: dict[tuple[int, int], float] = field(default_factory=dict, repr=False, compare=False)
    """β_span of representatives that several histories need, by the number of vectors and of the class."""

    def first(self, count: int) -> ProjectedSupremizers:
        """The projections on the first `count` vectors of Z."""
        return ProjectedSupremizers([projected[:count] for projected in self.of_classes], self.classes)

    def beta_span(self) -> Array:
        """β_span at every parameter (P,)."""
        return self.classes.everywhere([beta_span(projected) for projected in self.of_classes])

    def over_steps(self, first: int) -> Array:
        """The smallest β_span over all parameters with the first `first`, … N' vectors (N' − first + 1,)."""
        factors = np.abs(self.classes.factors)
        weights = [float(np.min(factors[self.classes.members == k])) for k in range(len(self.of_classes))]
        return self._smallest(first, lambda beta, k: weights[k] * beta)

    def shares_over_steps(self, first: int, reachable: Array) -> Array:
        """The smallest `share` of `reachable` (P,), the β_span of the whole of V, likewise (N' − first + 1,)."""
        of_representatives = reachable[self.classes.firsts]
        return self._smallest(first, lambda beta, k: share(beta, of_representatives[k]))

    def _smallest(self, first: int, value: Callable[[float, int], float]) -> Array:
        """The smallest value over all classes, each from the β_span of its representative.

        β_span never decreases as Z grows, so values of earlier steps are lower bounds and the minimum is found lazily.
        """

        def negative(count: int, k: int) -> float:
            if (count, k) not in self._known:
                self._known[count, k] = beta_span(self.of_classes[k][:count])
            return -value(self._known[count, k], k)

        lazy, last = LazyMaximum(np.zeros(len(self.of_classes))), self.of_classes[0].shape[0]
        return np.array([-lazy.next(partial(negative, count))[1] for count in range(first, last + 1)])
