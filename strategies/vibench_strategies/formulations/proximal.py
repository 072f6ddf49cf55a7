"""The reduced program in a latent variable: entropic proximal points, a few Newton steps each."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Gt, Le

from vibench import Array
from vibench_strategies.formulations.reduced_programs import ProgramFormulation
from vibench_strategies.formulations.whitened import Whitened, positive_solution

PROXIMAL_STEPS = 200
NEWTON_STEPS = 15
"""Of one proximal step; each costs one Cholesky factorisation of the size of the constraints. A proximal step that
takes more is repeated with a smaller a_k, unless it is as small as at first."""

PATIENCE = 20
"""How many times as many Newton steps the smallest a_k may take."""

EASY = 5
"""Newton steps up to which a_k grows."""

RIDGE = 1e-12
"""Added to the unit diagonal of Y Yᵀ, which is singular where there are more active constraints than unknowns."""

INEXACT = 0.1
"""Accuracy of a proximal point relative to the residual of the one before, which it has to reduce."""

ROUND_OFF = 1e-14
"""Of the minimised function, relative."""

RISE = 3.0
"""Largest rise of a latent variable in a Newton step, beyond which exp is no longer what its linearisation says."""

CENTRE = 1e-4
"""Smallest slack from which a proximal step starts, relative to the tolerance: a constraint that has to open again
needs few steps then."""


class Proximal(ProgramFormulation):
    """Latent variable proximal point method (Keith and Surowiec 2024), for one reduced program.

    The proximal Galerkin method writes what a constraint leaves as exp(ψ) with a latent variable ψ, and a solution as
    the limit of entropic proximal points: smooth equations instead of inequalities, a few Newton steps each. Here it
    is that of the constraints g − B u = exp(ψ) which the generators of the cone test, and λ_k = (ψ_{k−1} − ψ_k)/a_k.
    The answers converge to the mixed ones; u satisfies the reduced constraints up to the accuracy all the way.

    Parameters
    ----------
    step, growth
        a_1, in units of the program, and the factor by which a_k grows as long as Newton's method takes few steps.
    """

    def __init__(
        self, step: Annotated[float, Gt(0.0), Le(1e3)] = 1.0, growth: Annotated[float, Gt(1.0), Le(10.0)] = 2.0
    ) -> None:
        self.step, self.growth = step, growth

    def algorithm(self, program: Whitened, accuracy: float) -> tuple[Array, Array, int, str]:
        """Proximal points until the natural residual is as small as asked for."""
        z, nu, steps, residual = latent_proximal(program, accuracy, self.step, self.growth)
        short = f"the residual is {residual:.1e} after {PROXIMAL_STEPS} proximal steps, for {accuracy:g} asked for"
        return z, nu, steps, "" if residual <= accuracy else short


def latent_proximal(program: Whitened, tolerance: float, step: float, growth: float) -> tuple[Array, Array, int, float]:
    """Entropic proximal points of a program; returns z, ν ≥ 0, Newton steps, and the natural residual reached.

    With slacks g − Y z = exp(ψ) the k-th one solves z + Yᵀν = 0 for ν = (ψ_{k−1} − ψ)/a_k: in ν alone

        exp(ψ_{k−1} − a_k ν) = g + Y Yᵀν,

    the stationarity of a convex function, by Newton's method with backtracking. a_k grows geometrically. Up to the
    accuracy of the steps every z is strictly feasible. ν may be negative where a constraint is not active, until
    it converges to zero there; it is cut off, which the residual contains.
    """
    Y, b, steps = program.Y, -program.g, 0
    C = Y @ Y.T
    # Slacks of one unit: that of the program, by which the worst constraint is violated at first.
    psi, nu, a, residual = np.log(np.maximum(1.0, -b)), np.zeros(len(b)), step, 1.0
    lowest, z, positive = np.log(CENTRE * tolerance), np.zeros_like(program.y), nu
    for _ in range(PROXIMAL_STEPS):
        most = NEWTON_STEPS * (1 if a > step else PATIENCE)
        found, count = _newton(C, b, psi, nu, a, INEXACT * max(tolerance, min(residual, 1.0)), most)
        steps += count
        if found is None:
            a = max(a / growth, step)
            continue
        nu, psi, positive = found, psi - a * found, np.maximum(found, 0.0)
        a *= growth if count <= EASY else 1.0
        z, pressed = -(Y.T @ nu), Y.T @ positive
        size, gap = program.size(pressed), float(positive @ np.exp(psi))
        off = float(np.linalg.norm(pressed + z)), float(np.max(Y @ z - program.g, initial=0.0))
        residual = max(max(off) / size, gap / size**2)
        if residual <= tolerance:
            break
        psi = np.maximum(psi, lowest)
    return z, positive, steps, residual


def _newton(
    C: Array, b: Array, psi: Array, nu: Array, a: float, tolerance: float, most: int
) -> tuple[Array | None, int]:
    """Minimise Σ exp(ψ_i − a ν_i)/a + ½νᵀCν − bᵀν, from what is positive of ν (k,).

    Returns the minimiser, or `None` where `most` steps are not enough, and the number of steps.
    """
    nu = np.maximum(nu, 0.0)
    pressed, slack = C @ nu, np.exp(psi - a * nu)
    matrix, present = np.empty_like(C), float(slack.sum() / a + nu @ (0.5 * pressed - b))
    diagonal = np.einsum("ii->i", matrix)
    for count in range(1, most + 1):
        gradient = pressed - b - slack
        matrix[:] = C
        diagonal += a * slack + RIDGE
        direction = -positive_solution(matrix, gradient)
        slope, rise, along = float(gradient @ direction), -a * float(direction.min()), C @ direction
        t = RISE / max(RISE, rise)
        while True:
            following, at = pressed + t * along, nu + t * direction
            slack = np.exp(psi - a * at)
            value = float(slack.sum() / a + at @ (0.5 * following - b))
            if value <= present + 1e-4 * t * slope + ROUND_OFF * abs(present):
                break
            t *= 0.5
        nu, pressed, present = at, following, value
        if rise <= RISE and -slope <= tolerance**2 * float(nu @ pressed):
            return nu, count
    return None, most
