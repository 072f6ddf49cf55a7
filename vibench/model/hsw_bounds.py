"""A-posteriori error bounds (Haasdonk, Salomon and Wohlmuth, 2012), derived for inexact reduced solutions.

Recorded for comparison with those of `vibench.model.error_bounds`; their formulas are in docs/mathematics.md, "Error
bounds". β is computed to round-off by a dense singular value decomposition, which proves nothing: the bounds are
estimates as far as β is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.absent_rows import is_absent
from vibench.interfaces.problem import Problem, VariationalInequality
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
    problem: Problem, vis: Sequence[VariationalInequality], constants: Sequence[Stability], u: Array, lam: Array,
    residuals: Sequence[Array] | None = None,
) -> list[HSWBounds | None]:  # fmt: skip
    """Δ_u and Δ_λ of reduced u (n×P), λ (m×P), column by column at the parameters of `vis`; see above.

    Infinite where β_HF over the span is zero; `None` where λ is not in W⁺ and nothing is certified, where K has more
    than rays, and where rows are absent: the distance of B u_N − g from the cone is one in W of all rows. `residuals`
    are those of the pairs (n,), where known.
    """
    residuals = residuals or [vi.f - vi.A @ u[:, k] - vi.B.T @ lam[:, k] for k, vi in enumerate(vis)]
    # All representers in one block: the factor of X_V is read once.
    columns = np.column_stack(residuals)
    dual_norms = norms_by_solutions(columns, problem.V.riesz(columns))
    excesses = (vi.B @ u[:, k] - vi.g for k, vi in enumerate(vis))
    return [
        None
        if is_absent(vis[k].g).any() or problem.K.blocks or not problem.K.contains(lam[:, k])
        else _bound(problem.W, s, lam[:, k], float(dual_norms[k]), constants[k])
        for k, s in enumerate(excesses)
    ]


def _bound(W: InnerProduct, excess: Array, lam: Array, residual: float, stability: Stability) -> HSWBounds:
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
