"""A-posteriori error bounds (Haasdonk, Salomon and Wohlmuth, 2012), derived for inexact reduced solutions.

They are bounds as far as α and γ_a are: these are estimated by Lanczos iterations and moved by a margin, not certified.

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
from scipy.sparse.linalg import LinearOperator, eigsh

from vibench.arrays import Array, SparseMatrix
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.linalg.inner_product import InnerProduct
from vibench.reduction import cones
from vibench.stability.infsup import InfSup

MARGIN = 1e-3
"""Lanczos approximates extreme eigenvalues from inside, to 1e-4; constants are moved outwards by this share."""


@dataclass(frozen=True)
class Stability:
    """Constants of the high-fidelity problem at one parameter: β_HF, and α and γ_a of A in the norm of V."""

    inf_sup: InfSup
    coercivity: float
    continuity: float


@dataclass(frozen=True)
class Bounds:
    """Δ_u and Δ_λ: absolute bounds on ‖u − u_N‖_V and ‖λ − λ_N‖_W."""

    u: float
    lam: float


def extreme_quotients(A: SparseMatrix, V: InnerProduct) -> tuple[float, float]:
    """Coercivity and continuity constants of A (n×n): extremes of vᵀAv / ‖v‖_V², moved outwards by `MARGIN`.

    Raises
    ------
    NumericalError
        If A is not symmetric positive definite.
    """
    if V.dim < 3:  # eigsh needs more dimensions than eigenvalues
        whitened = V.whiten_functional(V.whiten_functional(A.toarray()).T)
        values = np.linalg.eigvalsh(whitened)
        return (1.0 - MARGIN) * float(values[0]), (1.0 + MARGIN) * float(values[-1])
    shape, start = (V.dim, V.dim), np.random.default_rng(0).standard_normal(V.dim)
    inverse = LinearOperator(shape, matvec=InnerProduct(A, "A").riesz)
    riesz = LinearOperator(shape, matvec=V.riesz)
    settings = {"k": 1, "M": V.matrix, "v0": start, "tol": 1e-4, "return_eigenvectors": False}
    smallest = eigsh(A, sigma=0.0, OPinv=inverse, which="LM", **settings)[0]
    largest = eigsh(A, Minv=riesz, which="LA", **settings)[0]
    return (1.0 - MARGIN) * float(smallest), (1.0 + MARGIN) * float(largest)


def bounds(
    problem: Problem, vis: Sequence[VariationalInequality], constants: Sequence[Stability], u: Array, lam: Array
) -> list[Bounds | None]:
    """Δ_u and Δ_λ of reduced u (n×P), λ (m×P), column by column at the parameters of `vis`; see above.

    Infinite where β_HF over the span is zero; `None` where λ is not in W⁺ and nothing is certified.
    """
    residuals = np.column_stack([vi.f - vi.A @ u[:, k] - vi.B.T @ lam[:, k] for k, vi in enumerate(vis)])
    dual_norms = np.linalg.norm(problem.V.whiten_functional(residuals), axis=0)
    excesses = (vi.B @ u[:, k] - vi.g for k, vi in enumerate(vis))
    return [_bound(problem.W, s, lam[:, k], float(dual_norms[k]), constants[k]) for k, s in enumerate(excesses)]


def _bound(W: InnerProduct, excess: Array, lam: Array, residual: float, stability: Stability) -> Bounds | None:
    """The bounds from s (m,), λ_N (m,) and δ_r."""
    if np.min(lam, initial=0.0) < 0.0:
        return None
    alpha, gamma, beta = stability.coercivity, stability.continuity, stability.inf_sup.span
    if beta <= 0.0:
        return Bounds(float("inf"), float("inf"))
    penetration = cones.project_on_orthant(excess, W)
    penetration_norm = float(W.norm(penetration))
    complementarity = float(penetration @ W.apply(lam)) + max(0.0, -float(excess @ lam))
    c_1 = (residual + penetration_norm * gamma / beta) / (2.0 * alpha)
    c_2 = (penetration_norm * residual / beta + complementarity) / alpha
    bound = c_1 + float(np.sqrt(c_1**2 + c_2))
    return Bounds(bound, (residual + gamma * bound) / beta)
