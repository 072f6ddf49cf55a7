"""Inf-sup constants: over the span of the generators exactly, over the cone as a certified interval.

With an orthonormal basis Z of the primal space and generators χ of unit norm, C = ZᵀBᵀχ, G = χᵀX_Wχ, M = CᵀC,

    β_span = min ‖Cα‖ / ‖χα‖_W over all α,    β_cone = the same minimum over α ≥ 0   (paper, (14), (18), (30)).

The second is NP-hard in general; it is bounded from both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array, Mask, SparseMatrix
from vibench.interfaces.strategies import no_free
from vibench.linalg.dense import singular_values
from vibench.linalg.inner_product import InnerProduct
from vibench.reduction.supremizers import projected_supremizers
from vibench.stability.conic_infsup import cone_interval

UNSIGNED = "span"
"""Name of the lower bound of a cone with free generators, β_span; no other is known to hold for it."""


VANISHES = 1e-12
"""Constants below this are zero in floating point."""


@dataclass(frozen=True)
class Multipliers:
    """A reduced cone prepared once for every constant computed on it.

    Attributes
    ----------
    chi
        Generators (m×R), unit norm in W.
    span
        W-orthonormal basis of span χ (m×rank), from a rank-revealing factorisation.
    gram
        G (R×R).
    free
        Which generators may be used with either sign (R,).
    """

    chi: Array
    span: Array
    gram: Array
    free: Mask

    @property
    def rank(self) -> int:
        """Numerical rank of χ."""
        return int(self.span.shape[1])


@dataclass(frozen=True)
class InfSup:
    """Inf-sup constants of one pair of spaces at one parameter; `sharp` names the bounds that gave the interval."""

    span: float
    cone_lower: float
    cone_upper: float
    sharp: str

    def scaled(self, factor: float) -> InfSup:
        """The constants of the form multiplied by a number."""
        size = abs(factor)
        return InfSup(size * self.span, size * self.cone_lower, size * self.cone_upper, self.sharp)


def multipliers(chi: Array, W: InnerProduct, free: Mask | None = None) -> Multipliers:
    """Prepare generators (m×R) of unit norm; `free` says which may be used with either sign (R,), none by default."""
    whitened = W.whiten(chi)
    free = no_free(chi.shape[1]) if free is None else free
    return Multipliers(chi, W.orthonormalise(chi), whitened.T @ whitened, free)


def inf_sup(on_span: Array, on_generators: Array, cone: Multipliers) -> InfSup:
    """Span constant and cone interval from coordinates of the supremizers projected on the primal space.

    Parameters
    ----------
    on_span
        ZᵀBᵀ times `cone.span` (N'×rank), Z orthonormal; or any isometric image of it.
    on_generators
        ZᵀBᵀχ (N'×R), likewise.
    cone
        The prepared multipliers.

    Returns
    -------
    InfSup
        All zeros when there is no primal vector, infinite when there is no multiplier.
    """
    span = beta_span(on_span)
    if np.any(cone.free) and np.all(cone.free):  # the cone is its span
        return InfSup(span, span, span, f"{UNSIGNED}/{UNSIGNED}")
    lower, upper, sharp = cone_interval(compressed(on_generators), cone.gram, span)
    if np.any(cone.free):  # nonnegative coefficients are some of those allowed: only upper bounds hold
        return InfSup(span, span, upper, f"{UNSIGNED}/{sharp.split('/')[1]}")
    return InfSup(span, lower, upper, sharp)


def compressed(images: Array) -> Array:
    """An isometric image of the columns (k×R) with no more rows than columns."""
    return images if images.shape[0] <= images.shape[1] else np.asarray(np.linalg.qr(images, mode="r"))


def beta_span(on_span: Array) -> float:
    """Smallest singular value of ZᵀBᵀ on an orthonormal basis of span χ (N'×rank); 0 exactly when N' < rank."""
    rows, rank = on_span.shape
    if not rank:
        return float("inf")
    if rows < rank:
        return 0.0
    return float(singular_values(compressed(on_span))[-1])


def inf_sup_on(Z: Array, B: SparseMatrix, cone: Multipliers) -> InfSup:
    """Constants of a primal space with V-orthonormal basis Z (n×N') at the parameter of B (m×n)."""
    images = projected_supremizers(Z, B, np.hstack([cone.span, cone.chi]))
    return inf_sup(images[:, : cone.rank], images[:, cone.rank :], cone)


def inf_sup_full(V: InnerProduct, B: SparseMatrix, cone: Multipliers) -> InfSup:
    """Constants of the whole of V: what online supremizers reach; the supremum is attained at T(mu)η."""
    return inf_sup(
        V.whiten_functional(np.asarray(B.T @ cone.span)), V.whiten_functional(np.asarray(B.T @ cone.chi)), cone
    )


def nodal_multipliers(W: InnerProduct) -> Multipliers:
    """The high-fidelity cone W⁺ itself: nodal or cell functions, normalised."""
    identity = np.eye(W.dim)
    return multipliers(identity / W.norm(identity), W)
