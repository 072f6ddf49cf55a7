"""A-posteriori error bounds (Haasdonk, Salomon and Wohlmuth, 2012), derived for inexact reduced solutions.

Recorded for comparison with those of `vibench.model.error_bounds`. β is computed to round-off by a dense singular value
decomposition, which proves nothing: the bounds are estimates as far as β is.

Let (u, λ) solve (7), and let u_N be any vector and λ_N any element of W⁺. With e = u − u_N, ε = λ − λ_N, the residual
r = f − A u_N − Bᵀλ_N and s = B u_N − g, subtracting the equations gives A e + Bᵀε = r. Tested with e,

    α‖e‖_V² ≤ eᵀA e = rᵀe − (B e)ᵀε.

Since (Bu − g)ᵀλ = 0 and (Bu − g)ᵀλ_N ≤ 0, the last term is at most sᵀλ − sᵀλ_N. Let ŝ = X_W⁻¹s and π its W-projection
on W⁺. What is left of ŝ lies in the polar cone, so sᵀλ ≤ ⟨π, λ⟩ = ⟨π, ε⟩ + ⟨π, λ_N⟩. With

    δ_r = ‖r‖_V',    δ_s1 = ‖π‖_W,    δ_s2 = ⟨π, λ_N⟩_W + max(0, −sᵀλ_N)

(the last term vanishes where λ_N and u_N are exactly complementary, which an inexact QP solution is not):

    α‖e‖² ≤ δ_r‖e‖ + δ_s1‖ε‖ + δ_s2.

The inf-sup condition over the span and Bᵀε = r − A e give β‖ε‖ ≤ δ_r + γ_a‖e‖. Together, with
c₁ = (δ_r + δ_s1 γ_a/β)/(2α) and c₂ = (δ_s1 δ_r/β + δ_s2)/α,

    ‖e‖_V ≤ Δ_u = c₁ + √(c₁² + c₂),        ‖ε‖_W ≤ Δ_λ = (δ_r + γ_a Δ_u)/β.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import Problem, VariationalInequality, is_absent
from vibench.linalg.inner_product import InnerProduct
from vibench.qp.verification import norms_by_solutions
from vibench.reduction import cones
from vibench.stability.coercivity import Stability


@dataclass(frozen=True)
class HSWBounds:
    """Δ_u and Δ_λ: absolute bounds on ‖u − u_N‖_V and ‖λ − λ_N‖_W."""

    u: float
    lam: float


def hsw_bounds(
    problem: Problem,
    vis: Sequence[VariationalInequality],
    constants: Sequence[Stability],
    u: Array,
    lam: Array,
    residuals: Sequence[Array] | None = None,
) -> list[HSWBounds | None]:
    """Δ_u and Δ_λ of reduced u (n×P), λ (m×P), column by column at the parameters of `vis`; see above.

    Infinite where β_HF over the span is zero; `None` where λ is not in W⁺ and nothing is certified, and where rows are
    absent: the distance of B u_N − g from the cone is one in W of all rows. `residuals` are those of the pairs (n,),
    where known.
    """
    residuals = residuals or [vi.f - vi.A @ u[:, k] - vi.B.T @ lam[:, k] for k, vi in enumerate(vis)]
    columns = np.column_stack(residuals)
    dual_norms = norms_by_solutions(columns, problem.V.riesz(columns))
    excesses = (vi.B @ u[:, k] - vi.g for k, vi in enumerate(vis))
    return [
        None if is_absent(vis[k].g).any() else _bound(problem.W, s, lam[:, k], float(dual_norms[k]), constants[k])
        for k, s in enumerate(excesses)
    ]


def _bound(W: InnerProduct, excess: Array, lam: Array, residual: float, stability: Stability) -> HSWBounds | None:
    """The bounds from s (m,), λ_N (m,) and δ_r."""
    if np.min(lam, initial=0.0) < 0.0:
        return None
    alpha, gamma, beta = stability.coercivity.value, stability.continuity.value, stability.inf_sup.span
    if beta <= 0.0:
        return HSWBounds(float("inf"), float("inf"))
    penetration = cones.project_on_orthant(excess, W)
    penetration_norm = float(W.norm(penetration))
    complementarity = float(penetration @ W.apply(lam)) + max(0.0, -float(excess @ lam))
    c_1 = (residual + penetration_norm * gamma / beta) / (2.0 * alpha)
    c_2 = (penetration_norm * residual / beta + complementarity) / alpha
    bound = c_1 + float(np.sqrt(c_1**2 + c_2))
    return HSWBounds(bound, (residual + gamma * bound) / beta)
