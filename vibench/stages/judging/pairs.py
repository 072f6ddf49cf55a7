"""What is measured of the answer of a query, u_N and λ_N: the same for every model, however it was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.model.certificates.base import Guarantee
from vibench.model.certificates.bounds import OnlineBound
from vibench.model.error_bounds import ErrorBounds, error_bounds
from vibench.model.errors import (
    UNMEASURABLE,
    Errors,
    ReferenceSolutions,
    energy_norms,
    errors,
    high_fidelity_residuals,
    of_stiffness,
    output_errors,
)
from vibench.model.hsw_bounds import HSWBounds, hsw_bounds
from vibench.offline.assemblies import assemblies
from vibench.qp.scaling import ratio
from vibench.stability.coercivity import Stability
from vibench.stages.base import Row

VIOLATION = 1e-10
"""An error above its bound by more than this share of the solution violates it; less is round-off."""


def pair_columns(
    problem: Problem,
    mus: Array,
    vis: Sequence[VariationalInequality],
    u: Array,
    lam: Array,
    reference: ReferenceSolutions,
    constants: Sequence[Stability],
) -> list[Row]:
    """Columns of answers u (n×P), λ (m×P) at parameters (P×d): errors, their bounds, residuals and outputs."""
    energies = [assemblies(problem).energy_at(mu) for mu in mus]
    forces = of_stiffness(energies, u)
    residuals = [vi.f - force - vi.B.T @ of_lam for vi, force, of_lam in zip(vis, forces.T, lam.T, strict=True)]
    bounds = error_bounds(vis, energies, constants, u, lam, reference.lam > 0.0, residuals)
    measured = zip(
        errors(problem, vis, energies, reference, u, lam),
        bounds,
        hsw_bounds(problem, vis, constants, u, lam, residuals),
        strict=True,
    )
    rows = [_columns(*one) for one in measured]
    sizes = energy_norms(u, forces)
    pairs = zip(rows, bounds, sizes.tolist(), vis, energies, u.T, lam.T, strict=True)
    for row, bound, size, vi, energy, of_u, of_lam in pairs:
        found = high_fidelity_residuals(vi, energy, of_u, of_lam, bound.rho, size)
        row |= {"hf_primal_residual": found.primal, "hf_dual_residual": found.dual, "hf_gap": found.gap}
    for row, of_query in zip(rows, output_errors(problem.outputs, mus, (u, lam), reference), strict=True):
        row["outputs"] = of_query
    return rows


def _columns(error: Errors, bounds: ErrorBounds, hsw: HSWBounds | None) -> Row:
    """The columns of one pair."""
    row: Row = asdict(error) | {"bound_note": bounds.note}
    of_u = _measured(error.error_u, error.error_u_scaled) > UNMEASURABLE
    of_lam = _measured(error.error_lambda, error.error_lambda_scaled) > UNMEASURABLE
    checked: dict[str, tuple[float, bool, float]] = {}  # a bound, the error, and whether that is measurable
    if np.isfinite(bounds.u_energy):
        row |= {f"bound_{name}": getattr(bounds, name) for name in ("rho", "rho_range", "omega", "kappa")}
        checked |= {
            "u_energy": (bounds.u_energy, of_u, error.error_u_energy_absolute),
            "u": (bounds.u, of_u, error.error_u_absolute),
            "lambda_natural": (bounds.lambda_natural, of_lam, error.error_lambda_natural_absolute),
            "lambda": (bounds.lam, of_lam, error.error_lambda_absolute),
        }
    if hsw is not None:
        checked["hsw_u"] = hsw.u, of_u, error.error_u_absolute
        checked["hsw_lambda"] = hsw.lam, of_lam, error.error_lambda_absolute
    for name, (bound, measurable, absolute) in checked.items():
        row[f"bound_{name}"] = bound
        if measurable:
            row[f"effectivity_{name}"] = ratio(bound, absolute)
    return row


def online_columns(bound: OnlineBound, error: Row) -> Row:
    """The bounds at online cost, and the effectivities of those whose bounds at high-fidelity cost have one."""
    row: Row = {"certificate": bound.guarantee.value, "bound_online_note": bound.note}
    if bound.guarantee is Guarantee.NONE:
        return row
    violated, bounds = False, {"u_energy": bound.u_energy, "lambda_natural": bound.lambda_natural}
    if bound.inf_sup > 0.0:
        bounds["lambda"] = bound.lam
    for name, value in bounds.items():
        absolute, relative = error[f"error_{name}_absolute"], error[f"error_{name}"]
        row[f"bound_online_{name}"] = value
        if f"effectivity_{name}" in error:
            row[f"effectivity_online_{name}"] = ratio(value, absolute)
        size = absolute / relative if relative else value
        violated |= not absolute <= value + VIOLATION * size
    row |= {"bound_online_rho": bound.rho, "bound_online_omega": bound.omega, "bound_online_kappa": bound.kappa}
    row |= {"beta_energy_online": bound.inf_sup, "beta_energy_online_note": bound.inf_sup_note}
    return row | {"coercivity_online": bound.coercivity, "bound_online_violated": int(violated)}


def _measured(relative: float | None, scaled: float) -> float:
    """An error relative to its solution, or where that is zero to the largest training solution."""
    return scaled if relative is None else relative
