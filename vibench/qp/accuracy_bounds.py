"""The disagreement audit: solvers that are both `ok` on the same reduced problem must agree as far as accuracy says.

For two solutions k = 1, 2 of min ½xᵀAx − fᵀx, Bx ≤ g, with α_k ≥ 0, residuals r_k = Ax_k − f + Bᵀα_k, excesses
p_k = (Bx_k − g)₊ and gaps δ_k = x_kᵀAx_k − fᵀx_k + gᵀα_k, the difference d = x₁ − x₂ satisfies

    dᵀAd ≤ dᵀ(r₁ − r₂) + Σ_k (δ_k − x_kᵀr_k) + p₁ᵀα₂ + p₂ᵀα₁.

Where every relative residual is at most ε, each term has a bound that belongs to one of the two solutions; with the
smallest eigenvalue of A they give ‖d‖² ≤ (l₁ + l₂)‖d‖ + c₁ + c₂. In a V-orthonormal basis ‖d‖ is the distance of the
two displacements in V.
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
    """What an accuracy leaves open around one solution: its shares l and c of the bound above."""

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
    """The largest ‖x₁ − x₂‖ that two slacks allow."""
    half = 0.5 * (first.linear + second.linear)
    return float(half + np.sqrt(half**2 + first.constant + second.constant))
