"""What a cone can take out of a multiplier without making it negative (paper, Algorithm 2, line 9)."""

from __future__ import annotations

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.inner_product import InnerProduct
from vibench.qp import verification
from vibench.qp.solve import solve_qp

SOLVERS = ("piqp", "proxqp")
ACCURACY = 1e-12
ACCEPTED = 1e-9
"""A solution of line 9 with a larger residual is recorded as a fallback; any feasible one keeps Remark 4.1."""


def removable_part(theta: Array, generators: Array, W: InnerProduct) -> tuple[Array, str]:
    """Υ ∈ K closest to θ with θ − Υ ≥ 0 coefficientwise (Algorithm 2, line 9), and a note if it is only feasible.

    A generator that is positive where θ is zero cannot take part; on the support of θ the rest of the problem has
    strictly feasible points, which is what interior-point solvers need.

    Parameters
    ----------
    theta
        Snapshot θ ≥ 0 (m,).
    generators
        Generators ν ≥ 0 of the cone (m×r).
    W
        Inner product of the multiplier space.

    Returns
    -------
    tuple
        Υ (m,) such that θ − Υ has no negative entry and exact zeros where round-off would leave 1e-12 of its maximum,
        and a note, empty when Υ is optimal to `ACCEPTED`.
    """
    support = theta > 0.0
    usable = generators[:, ~np.any(generators[~support] > 0.0, axis=0)]
    if not usable.shape[1]:
        return np.zeros_like(theta), ""
    whitened, target = W.whiten(usable), W.whiten(theta)
    count = usable.shape[1]
    program = VariationalInequality(
        A=whitened.T @ whitened,
        f=whitened.T @ target,
        B=np.vstack([-np.eye(count), usable[support]]),
        g=np.concatenate([np.zeros(count), theta[support]]),
    )
    best, worst = np.zeros(count), np.inf
    for solver in SOLVERS:
        answer = solve_qp(program, solver, ACCURACY)
        if answer.x is None or answer.alpha is None or not np.all(np.isfinite(np.append(answer.x, answer.alpha))):
            continue
        found = verification.kkt_residuals(program, answer.x, answer.alpha).worst
        if found < worst:
            best, worst = np.maximum(answer.x, 0.0), found
        if worst <= ACCEPTED:
            break
    part = usable @ best
    over = part > theta
    if np.any(over):  # round-off of the solver; a shorter multiple is feasible exactly, up to the clamp below
        shrink = float(np.min(theta[over] / part[over]))
        part *= shrink if shrink < 1.0 - ACCEPTED else 1.0
    rest = np.maximum(theta - part, 0.0)
    rest[rest < 1e-12 * theta.max()] = 0.0
    note = "" if worst <= ACCEPTED else f"line 9 solved only to {worst:.0e}, made feasible"
    return theta - rest, note
