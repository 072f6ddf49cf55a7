"""Bounds of u and of λ from one step of defect correction, at online cost.

The identity (i) of `vibench.model.error_bounds` bounds the sum of both errors by the residual. Where one error is much
smaller than the other, its bound is that of the larger one. They are told apart by a better pair, which solves the
inequality with c X in place of A(µ), c > 0, for the residual r = f − A u_N − Bᵀλ_N,

    c X (û − u_N) + Bᵀ(ν − λ_N) = r,     B û ≤ g,    ν ≥ 0,    νᵀ(B û − g) = 0.

Its residual is f − A û − Bᵀν = (c X − A)(û − u_N), it violates nothing, and (i) gives, with c = ½ (α + γ) and
α X ≼ A ≼ γ X, hence |c X − A| ≼ ½ (γ − α) X,

    max(‖u − û‖_A, ‖Bᵀ(λ − ν)‖_{A⁻¹}) ≤ δ = ½ (γ − α)/√α ‖û − u_N‖_X,
    ‖u − u_N‖_A ≤ √γ ‖û − u_N‖_X + δ,         ‖Bᵀ(λ − λ_N)‖_{A⁻¹} ≤ ‖Bᵀ(ν − λ_N)‖_{X⁻¹}/√α + δ.

What of r is orthogonal to all Bᵀη moves û alone. Where A is constant, δ = 0 and the pair is the high-fidelity solution.

With z = X⁻¹r, û = u_N + z/c − w and c X w = Bᵀ(ν − λ_N): w is the correction of `contact_correction` for u_N + z/c in
place of u_N. Of r only the part r_U in the span of the basis of residuals is used; the rest, and what is not known of
r, adds its norm to that of the residual. Then z has the coordinates of r_U, and its values on the contact unknowns are
the products of these with the coordinates of the functionals that act on one unknown each.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import Contact
from vibench.model.certificates.contact_correction import ContactCompliance, find_contact_correction

UNIT = float(np.finfo(float).eps)


def defect_corrected_bounds(
    compliance: ContactCompliance,
    directions: Array,
    contact: Contact,
    solution: tuple[Array, Array, Array],
    residual: tuple[Array, float],
    spectrum: tuple[float, float],
) -> tuple[float, float]:
    """Bounds of ‖u − u_N‖_A and of ‖Bᵀ(λ − λ_N)‖_{A⁻¹}; infinite where no correction was found.

    Parameters
    ----------
    compliance, directions
        C, and the coordinates (k×K) of the contact unknowns, as functionals, in the basis of residuals.
    contact
        B (m×k) and g (m,).
    solution
        u_N (k,) on the contact unknowns, a bound (k,) of its round-off, and λ_N ≥ 0 (m,).
    residual
        Its coordinates (K,), and the norm of what they lack.
    spectrum
        α > 0 and γ.
    """
    (on_contact, uncertain, lam), (coordinates, outside), (lower, upper) = solution, residual, spectrum
    middle = 0.5 * (lower + upper)
    moved = coordinates / middle  # z/c
    shift, terms = directions @ moved, len(moved) + 4.0
    uncertain = uncertain + terms * UNIT * (np.linalg.norm(directions, axis=1) * np.linalg.norm(moved) + np.abs(shift))
    found = find_contact_correction(compliance, contact, on_contact + shift, uncertain, lam, middle)
    if found is None or found.nu is None:
        return inf, inf
    along = found.load @ directions[found.unknowns]  # the coordinates of X w, whose rest is orthogonal to z
    beside = max(0.0, found.norm**2 - float(along @ along))
    round_off = terms * UNIT * (float(np.linalg.norm(moved)) + found.norm)
    distance = float(np.linalg.norm(moved - along)) + round_off
    distance = sqrt(distance**2 + beside + terms * UNIT * found.norm**2)
    left = (outside + 0.5 * (upper - lower) * distance + middle * (found.eta + round_off)) / sqrt(lower)
    delta = sqrt(left**2 + 2.0 * found.gap) + found.eta * sqrt(upper)
    return sqrt(upper) * distance + delta, middle * found.norm / sqrt(lower) + delta
