"""Inf-sup constants: over the span of the generators exactly, over the cone as a certified interval.

With an orthonormal basis Z of the primal space and generators χ of unit norm, C = ZᵀBᵀχ, G = χᵀX_Wχ, M = CᵀC,

    β_span = min ‖Cα‖ / ‖χα‖_W over all α,    β_cone = the same minimum over α ≥ 0   (paper, (14), (18), (30)).

The second is NP-hard in general; it is bounded from both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from vibench.arrays import Array, SparseMatrix
from vibench.linalg import singular_values
from vibench.space import InnerProduct


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
    """

    chi: Array
    span: Array
    gram: Array

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


def multipliers(chi: Array, W: InnerProduct) -> Multipliers:
    """Prepare generators (m×R) of unit norm."""
    whitened = W.whiten(chi)
    return Multipliers(chi, W.orthonormalise(chi), whitened.T @ whitened)


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
    lower, upper, sharp = cone_interval(on_generators, cone.gram, span)
    return InfSup(span, lower, upper, sharp)


def beta_span(on_span: Array) -> float:
    """Smallest singular value of ZᵀBᵀ on an orthonormal basis of span χ (N'×rank); 0 exactly when N' < rank."""
    rows, rank = on_span.shape
    if not rank:
        return float("inf")
    if rows < rank:
        return 0.0
    return float(singular_values(on_span)[-1])


def cone_interval(C: Array, G: Array, span: float) -> tuple[float, float, str]:
    """Certified bounds on min ‖Cα‖/√(αᵀGα) over α ≥ 0, for G with unit diagonal.

    Upper: U0, the best single generator, and U1, the quotient at the minimiser of ‖Cα‖ over the simplex. Lower: L0,
    the span constant; L1, min_i yᵀc_i with y the direction of that minimiser's image, valid because ‖χα‖ ≤ Σα; L½,
    √min M_ij/G_ij over pairs, valid when M and G are entrywise nonnegative.

    Parameters
    ----------
    C
        Images (N'×R) of the generators.
    G
        Gram matrix (R×R), unit diagonal.
    span
        β_span of the same pair.

    Returns
    -------
    tuple
        Lower bound, upper bound, and the names of those that were sharpest, "L½/U0".
    """
    count = G.shape[0]
    if not count:
        return float("inf"), float("inf"), ""
    M = C.T @ C
    alpha = simplex_minimiser(C)
    image, weight = C @ alpha, float(alpha @ G @ alpha)
    norm = float(np.linalg.norm(image))
    uppers = {
        "U0": float(np.sqrt(np.min(np.diag(M) / np.diag(G)))),
        "U1": norm / np.sqrt(weight),
    }
    lowers = {"L0": span, "L1": max(0.0, float(np.min(image @ C)) / norm) if norm > 0.0 else 0.0}
    if M.min() >= 0.0 and G.min() >= 0.0:
        pairs = G > 0.0
        lowers["L½"] = float(np.sqrt(np.min(M[pairs] / G[pairs])))
    low, high = max(lowers, key=lambda k: lowers[k]), min(uppers, key=lambda k: uppers[k])
    return min(lowers[low], uppers[high]), uppers[high], f"{low}/{high}"


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


def inf_sup_on(Z: Array, B: SparseMatrix, cone: Multipliers) -> InfSup:
    """Constants of a primal space with V-orthonormal basis Z (n×N') at the parameter of B (m×n)."""
    return inf_sup(Z.T @ np.asarray(B.T @ cone.span), Z.T @ np.asarray(B.T @ cone.chi), cone)


def inf_sup_full(V: InnerProduct, B: SparseMatrix, cone: Multipliers) -> InfSup:
    """Constants of the whole of V: what online supremizers reach; the supremum is attained at T(mu)η."""
    return inf_sup(
        V.whiten_functional(np.asarray(B.T @ cone.span)), V.whiten_functional(np.asarray(B.T @ cone.chi)), cone
    )


def nodal_multipliers(W: InnerProduct) -> Multipliers:
    """The high-fidelity cone W⁺ itself: nodal or cell functions, normalised."""
    identity = np.eye(W.dim)
    return multipliers(identity / W.norm(identity), W)
