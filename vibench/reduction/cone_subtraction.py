"""Subtraction of the component of a multiplier in a cone: line 9 of Algorithm 2 of Niakh et al. (2022)."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from vibench.arrays import Array, Mask
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.inner_product import InnerProduct
from vibench.qp.scaling import peak, ratio
from vibench.qp.solve import solve_qp


def subtract_cone_component(
    theta: Annotated[Array, "m"], generators: Annotated[Array, "m", "r"], W: Annotated[InnerProduct, "m"]
) -> tuple[Array, str]:
    """Subtract from θ the closest Υ of the cone with θ − Υ ≥ 0 coefficientwise: line 9 of Algorithm 2 of Niakh et al.

    θ ≥ 0 (m,) is a snapshot, the generators of the cone are ν ≥ 0 (m×r). The result is θ − Υ (m,), without negative
    entries, and with exact zeros in place of round-off; and a note, empty where Υ is optimal.
    """
    # A generator that is positive where θ is zero must have the coefficient 0. Without such generators, and restricted
    # to the support of θ, the problem has strictly feasible points; otherwise it has none, and QP solvers break down.
    support = theta > 0.0
    usable = generators[:, ~np.any(generators[~support] > 0.0, axis=0)]
    if not usable.shape[1]:
        return theta.copy(), ""
    coefficients, note = _least_squares(theta, usable, support, W)
    part = usable @ coefficients
    over = part > theta
    # The solver may violate Υ ≤ θ. Scaling Υ down restores that and stays in the cone; round-off is clamped below.
    if np.any(over):
        shrink = float(np.min(theta[over] / part[over]))
        # By less than the residual that is accepted below it is round-off.
        part *= shrink if shrink < 1.0 - 1e-9 else 1.0
    rest = np.maximum(theta - part, 0.0)
    units = np.sqrt(W.matrix.diagonal())
    # Round-off left there would exclude generators later. Entries are compared in units of the norms of their basis
    # functions, so that the scaling of a row decides nothing.
    rest[units * rest < 1e-12 * (units * theta).max()] = 0.0
    return rest, note


def _least_squares(theta: Array, generators: Array, support: Mask, W: InnerProduct) -> tuple[Array, str]:
    """Coefficients α ≥ 0 (r,) that minimise ‖θ − Σ α_i ν_i‖_W with Σ α_i ν_i ≤ θ, and a note where they are inexact."""
    whitened, target = W.whiten(generators), W.whiten(theta)
    count, units = generators.shape[1], np.sqrt(W.matrix.diagonal())[support]
    A, f = whitened.T @ whitened, whitened.T @ target
    B = np.vstack([-np.eye(count), units[:, None] * generators[support]])
    g = np.concatenate([np.zeros(count), units * theta[support]])
    program = VariationalInequality(A, f, B, g)
    best, smallest = np.zeros(count), np.inf
    for solver in ("piqp", "proxqp"):
        solution = solve_qp(program, solver, 1e-12)
        if solution.x is None or solution.alpha is None:
            continue
        if not np.all(np.isfinite(np.append(solution.x, solution.alpha))):
            continue
        # Residuals are compared with their terms: A may be singular, and has no natural residuals.
        force, excess = B.T @ solution.alpha, B @ solution.x - g
        energies = float(solution.x @ A @ solution.x), abs(float(f @ solution.x))
        residual = max(
            ratio(float(np.max(excess, initial=0.0)), max(peak(g), peak(B @ solution.x))),
            ratio(peak(A @ solution.x - f + force), max(peak(f), peak(force))),
            ratio(abs(float(solution.alpha @ excess)), max(energies)),
        )
        if residual < smallest:
            best, smallest = np.maximum(solution.x, 0.0), residual
        # A larger residual is recorded as a fallback; Remark 4.1 holds for any feasible solution.
        if smallest <= 1e-9:
            return best, ""
    return best, f"line 9 solved only to {smallest:.0e}, made feasible"
