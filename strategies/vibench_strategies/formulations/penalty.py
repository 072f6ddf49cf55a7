"""A penalty on what violates the reduced constraints, with continuation."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
import scipy.linalg
from annotated_types import Ge, Gt, Lt

from vibench import Array, Multiplier
from vibench_strategies.formulations.reduced_programs import ProgramFormulation
from vibench_strategies.formulations.whitened import Whitened

NEWTON_STEPS = 100
"""Of one penalty; a convex piecewise quadratic function needs finitely many, in practice one to five."""


class Penalty(ProgramFormulation):
    """Penalty method: min ½uᵀA u − fᵀu + Σ_i (b_i u − g_i)₊² / (2ε c_i) over V_N and its enrichment, no constraints.

    b_i u ≤ g_i are the constraints that the generators of the cone test, c_i = b_i A⁻¹ b_iᵀ their compliance: ε says
    which share of it the penalty adds, in any units. The multipliers are recovered as α_i = (b_i u − g_i)₊ / (ε c_i).
    Reduced basis methods of penalised variational inequalities are those of Bader, Zhang and Veroy (2016), who
    interpolate the penalty empirically; the cone does so here. As ε falls the answers converge to the mixed ones from
    outside of the constraints, errors being proportional to ε where no multiplier vanishes on an active constraint.

    Parameters
    ----------
    epsilon
        ε, from 1 to it by continuation.
    reduction
        Factor by which the continuation reduces ε in each step.
    """

    uses: ClassVar[tuple[str, ...]] = ("pod", "dual", "primal", "assembly")
    multiplier = Multiplier.RECOVERED

    def __init__(
        self,
        epsilon: Annotated[float, Ge(1e-12), Lt(1.0)] = 1e-6,
        reduction: Annotated[float, Gt(0.0), Lt(1.0)] = 0.1,
    ) -> None:
        self.epsilon, self.reduction = epsilon, reduction

    def algorithm(self, program: Whitened, accuracy: float) -> tuple[Array, Array, int, str]:  # noqa: ARG002
        """Newton's method for one penalty after the other."""
        z, nu, steps, converged = penalised(program, self.epsilon, self.reduction)
        return z, nu, steps, "" if converged else f"Newton's method has not converged in {NEWTON_STEPS} steps"


def penalised(program: Whitened, epsilon: float, reduction: float) -> tuple[Array, Array, int, bool]:
    """Minimise ½‖z − y‖² + ‖(Y z − g)₊‖² / (2ε); returns z, ν = (Y z − g)₊ / ε, Newton steps, whether they converged.

    ε falls from 1 by the factor `reduction`, each minimum being the start of the next one. Every step solves the
    quadratic piece of the present active set, the Newton step of a semismooth function, in its multipliers:
    (Y_S Y_Sᵀ + ε I) ν_S = Y_S y − g_S, whose condition is that of the constraints and not of the penalty. An exact line
    search makes it converge from everywhere.
    """
    Y, y, g, steps = program.Y, program.y, program.g, 0
    z, current = y, 1.0
    while True:
        current, settled = max(epsilon, current), False
        for _ in range(NEWTON_STEPS):
            steps += 1
            active = Y @ z > g
            S = Y[active]
            matrix = S @ S.T
            matrix[np.diag_indices_from(matrix)] += current
            nu = scipy.linalg.solve(matrix, S @ y - g[active], assume_a="pos") if len(S) else np.zeros(0)
            following = y - S.T @ nu
            if settled := np.array_equal(Y @ following > g, active):
                z = following
                break
            z = z + _step(program, z, following - z, current) * (following - z)
        if current == epsilon or not settled:
            multipliers = np.zeros(len(g))
            multipliers[active] = np.maximum(nu, 0.0)
            return z, multipliers, steps, bool(settled)
        current *= reduction


def _step(program: Whitened, z: Array, d: Array, epsilon: float) -> float:
    """Minimiser t ∈ (0, 1] along z + t d, where the derivative of the penalised function, piecewise linear, is zero."""
    excess, slope = program.Y @ z - program.g, program.Y @ d
    curvature, start = d @ d, (z - program.y) @ d

    def derivative(t: Array) -> Array:
        violations = np.maximum(excess[:, None] + slope[:, None] * t, 0.0)
        return np.asarray(start + t * curvature + slope @ violations / epsilon)

    with np.errstate(divide="ignore", invalid="ignore"):
        kinks = -excess / slope
    kinks = np.sort(np.concatenate([[0.0], kinks[(kinks > 0.0) & (kinks < 1.0)], [1.0]]))
    values = derivative(kinks)
    after = int(np.argmax(values >= 0.0))
    if values[-1] < 0.0 or not after:
        return 1.0
    (a, b), (low, high) = kinks[after - 1 : after + 1], values[after - 1 : after + 1]
    return float(b if high == low else a - low * (b - a) / (high - low))
