"""A penalty on what violates the reduced constraints, by Newton's method."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Gt, Lt

from vibench import Array, Multiplier
from vibench_strategies.formulations.reduced_programs import ProgramFormulation
from vibench_strategies.formulations.whitened import Whitened, positive_solution

NEWTON_STEPS = 100
"""Of one penalty; a convex piecewise quadratic function needs finitely many."""


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
        ε, at which Newton's method starts.
    reduction
        Factor by which ε is reduced in each step from 1 on, where Newton's method runs in circles at ε itself.
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
        """Newton's method, for one penalty after the other where it fails at the last one."""
        z, nu, steps, converged = penalised(program, self.epsilon, self.reduction)
        return z, nu, steps, "" if converged else f"Newton's method has not converged in {NEWTON_STEPS} steps"


def penalised(program: Whitened, epsilon: float, reduction: float) -> tuple[Array, Array, int, bool]:
    """Minimise ½‖z‖² + ‖(Y z − g)₊‖² / (2ε); returns z, ν = (Y z − g)₊ / ε, Newton steps, whether they converged.

    Newton's method starts at ε itself, with full steps. Where these run in circles, ε falls from 1 by the factor
    `reduction`, each minimum being the start of the next one, with an exact line search, which converges always.
    """
    z, nu, steps, settled = _newton(program, np.zeros_like(program.y), epsilon, full=True)
    if settled:
        return z, nu, steps, True
    z, current = np.zeros_like(program.y), 1.0
    while True:
        current = max(epsilon, current)
        z, nu, count, settled = _newton(program, z, current, full=False)
        steps += count
        if current == epsilon or not settled:
            return z, nu, steps, settled
        current *= reduction


def _newton(program: Whitened, z: Array, epsilon: float, *, full: bool) -> tuple[Array, Array, int, bool]:
    """Newton's method from z for one ε, with full steps or a line search; z, ν, steps, and whether it has converged.

    Every step solves the quadratic piece of the present active set, the Newton step of a semismooth function, in its
    multipliers: (Y_S Y_Sᵀ + ε I) ν_S = −g_S, whose condition is that of the constraints and not of the penalty.
    """
    Y, g, multipliers = program.Y, program.g, np.zeros(len(program.g))
    active, settled, seen, count = Y @ z > g, False, set[bytes](), 0
    while count < NEWTON_STEPS:
        count += 1
        S = Y[active]
        matrix = S @ S.T
        matrix.flat[:: len(S) + 1] += epsilon
        nu = positive_solution(matrix, -g[active])
        following = -(S.T @ nu)
        before, active = active, Y @ following > g
        if settled := bool((active == before).all()):
            z = following
            break
        if full:
            # a full step depends on the active set alone: the second time it begins a circle
            if (known := active.tobytes()) in seen:
                break
            z, seen = following, seen | {known}
        else:
            z = z + _step(program, z, following - z, epsilon) * (following - z)
            active = Y @ z > g
    multipliers[before] = np.maximum(nu, 0.0)
    return z, multipliers, count, settled


def _step(program: Whitened, z: Array, d: Array, epsilon: float) -> float:
    """Minimiser t ∈ (0, 1] along z + t d, where the derivative of the penalised function, piecewise linear, is zero."""
    excess, slope = program.Y @ z - program.g, program.Y @ d
    curvature, start = d @ d, z @ d

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
