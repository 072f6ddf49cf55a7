"""How well a pair solves the high-fidelity problem: its natural KKT residuals, in matrices of contact size.

They are those of `vibench.qp.verification` of the high-fidelity program, whatever the model was that found the pair: a
quadratic program, a penalty or a regression. With S² = ‖u‖²_A + ‖Bᵀλ‖²_{A⁻¹} and s = B u − g,

    primal max_i (s_i)₊ / ‖B_i‖_{A⁻¹} / S,    dual ‖f − A u − Bᵀλ‖_{A⁻¹} / S,    gap |λᵀs| / S².
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.highfidelity.active_set import solve_unverified
from vibench.interfaces.problem import VariationalInequality, is_absent
from vibench.model.errors import Energy
from vibench.model.on_contact import OnContact, representers
from vibench.qp.scaling import ratio
from vibench.qp.verification import Residuals, accurate_residuals, round_off_of_terms

BLOCK = 8
"""Rows whose norms in A⁻¹ are computed at once where there is no compliance of all."""


def high_fidelity_residuals(
    vi: VariationalInequality,
    energy: Energy,
    u: Array,
    lam: Array,
    rho: float = np.inf,
    u_energy: float | None = None,
) -> Residuals:
    """Residuals of u (n,) and λ (m,).

    `rho` is ‖f − A u − Bᵀλ‖_{A⁻¹} where that is known, and finite, `u_energy` is ‖u‖_A where that is.
    """
    on = energy.on_contact(vi)
    values = on.values(u)
    if not np.isfinite(rho):
        residual, _ = accurate_residuals(vi, u, lam)
        rho = representers(energy.stiffness, residual[:, None])[0].norm
    excess = np.asarray(on.in_extended_precision @ values.astype(np.longdouble) - vi.g, dtype=float)
    size = float(np.hypot(energy.norm(u) if u_energy is None else u_energy, on.force_norm(lam)))
    violated = np.flatnonzero(excess > round_off_of_terms(on.entries, on.sizes @ np.abs(values) + np.abs(vi.g)))
    pressed = lam > 0.0  # elsewhere s may be infinite
    gap = abs(float(lam[pressed] @ excess[pressed]))
    return Residuals(
        primal=ratio(_largest_step(on, energy, violated, excess[violated]), size),
        dual=ratio(rho, size),
        gap=ratio(gap, size * size),
    )


def _largest_step(on: OnContact, energy: Energy, rows: Indices, excess: Array) -> float:
    """The largest s_i / ‖B_i‖_{A⁻¹} over violated rows (k,), whose s are given.

    ‖B_i‖⁻¹ is bounded from above without A⁻¹, so that the rows with the largest bounds are enough.
    """
    if on.is_dense:
        return float(np.max(excess / np.sqrt(on.squares[rows]), initial=0.0))
    bounds = excess * np.sqrt(on.stiffnesses[rows])
    largest, order = 0.0, np.argsort(-bounds, kind="stable")
    for start in range(0, len(order), BLOCK):
        block = order[start : start + BLOCK]
        if bounds[block[0]] <= largest:
            break
        loads = sp.csr_array(on.B)[rows[block]].toarray().T
        squares = np.einsum("ik,ik->k", loads, energy.stiffness.compliance(loads))
        largest = max(largest, float(np.max(excess[block] / np.sqrt(squares))))
    return largest


def residual_multiplier(vi: VariationalInequality, energy: Energy, u: Array) -> Array:
    """The λ ≥ 0 (m,) whose residual f − A u − Bᵀλ is the smallest in the norm of A⁻¹.

    Its KKT conditions are those of the variational inequality with the load f − A u and g = 0 where it is finite:
    A w + Bᵀλ = f − A u, B w ≤ 0, λ ≥ 0 and λᵀB w = 0.

    Raises
    ------
    NumericalError
        If none is found.
    """
    g = np.where(is_absent(vi.g), vi.g, 0.0)
    homogeneous = VariationalInequality(vi.A, vi.f - vi.A @ u, vi.B, g)
    return np.asarray(np.maximum(solve_unverified(homogeneous, energy.stiffness).lam, 0.0))
