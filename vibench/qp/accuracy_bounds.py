"""How far apart two solutions of one quadratic program can be when the KKT residuals of both meet an accuracy.

For two solutions k = 1, 2 of min ½xᵀAx − fᵀx, Bx ≤ g, with α_k ≥ 0, residuals r_k = Ax_k − f + Bᵀα_k, excesses
p_k = (Bx_k − g)₊ and gaps δ_k = x_kᵀAx_k − fᵀx_k + gᵀα_k, the difference d = x₁ − x₂ satisfies

    dᵀAd ≤ dᵀ(r₁ − r₂) + Σ_k (δ_k − x_kᵀr_k) + p₁ᵀα₂ + p₂ᵀα₁.

Where every relative residual is at most ε, each term is bounded by data of one solution alone. With the smallest
eigenvalue of A this gives ‖d‖² ≤ (l₁ + l₂)‖d‖ + c₁ + c₂. In a V-orthonormal basis ‖d‖ is the distance of the two
displacements in V. Solvers that are `ok` on the same reduced problem and farther apart reveal a bug.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality
from vibench.qp.scaling import row_norms
from vibench.qp.verification import scales


@dataclass(frozen=True)
class Slack:
    """The terms l and c of one solution in the bound above."""

    linear: float
    constant: float


def slack(program: VariationalInequality, x: Array, alpha: Array, accuracy: float) -> Slack:
    """Slack of a solution x (n,), α (m,) whose three relative residuals are at most `accuracy`."""
    scale = scales(program, x, alpha)
    smallest = float(np.min(np.linalg.eigvalsh(program.A), initial=np.inf))
    if not smallest > 0.0:
        return Slack(float("inf"), float("inf"))
    excess = scale.primal * float(row_norms(program.B) @ alpha)
    constant = accuracy * (scale.gap + float(np.abs(x).sum()) * scale.dual + excess)
    return Slack(accuracy * np.sqrt(len(x)) * scale.dual / smallest, constant / smallest)


def allowed(first: Slack, second: Slack) -> float:
    """The largest ‖x₁ − x₂‖ compatible with the slacks of both solutions."""
    half = 0.5 * (first.linear + second.linear)
    return float(half + np.sqrt(half**2 + first.constant + second.constant))
