"""Solutions of QP solvers, and their verification: residuals recomputed, and a status from them alone.

How far apart can two solutions of one program be when the KKT residuals of both meet an accuracy? For two solutions
k = 1, 2 of min ½xᵀAx − fᵀx, Bx ≤ g, with α_k ≥ 0, residuals r_k = Ax_k − f + Bᵀα_k, excesses p_k = (Bx_k − g)₊ and
gaps δ_k = x_kᵀAx_k − fᵀx_k + gᵀα_k, the difference d = x₁ − x₂ satisfies

    dᵀAd ≤ dᵀ(r₁ − r₂) + Σ_k (δ_k − x_kᵀr_k) + p₁ᵀα₂ + p₂ᵀα₁.

Where every relative residual is at most ε, each term is bounded by data of one solution alone. With the smallest
eigenvalue of A this gives ‖d‖² ≤ (l₁ + l₂)‖d‖ + c₁ + c₂. In a V-orthonormal basis ‖d‖ is the distance of the two
displacements in V. Solvers that are `ok` on the same reduced problem and farther apart reveal a bug.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.optimize import nnls

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality
from vibench.qp.scaling import peak, prescribed, ratio, row_norms, size
from vibench.qp.status import Status
from vibench.text import above

ENERGY_FLOOR = 1e-4
"""Share of the energy of load or constraints below which the scale of the gap never falls."""

FORCE_FLOOR = 1e-4
"""Share of the prescribed force that the scale of the dual residual keeps; nodal forces decrease with mesh width."""


@dataclass(frozen=True)
class QPSolution:
    """Unverified result of a solver: x (n,), multipliers α (m,) with A x + Bᵀα = f, its status and iteration count.

    `solve_qp` sets negative multipliers to zero; `negative` is the largest absolute value among them. It makes the
    status one printable line, and leaves out iterations that are no number of them.
    """

    x: Array | None
    alpha: Array | None
    solver_status: str
    iterations: int | None = None
    negative: float = 0.0


class QPSolver(Protocol):
    """A solver registered through the entry point group `vibench.qp_solvers`."""

    def __call__(self, program: VariationalInequality, accuracy: float) -> QPSolution:
        """Solve to a relative accuracy."""


@dataclass(frozen=True)
class Residuals:
    """Relative KKT residuals, recomputed from the solution.

    Attributes
    ----------
    primal
        max (B x − g)₊ with every row in units of its own norm, over max(1, ‖g‖∞).
    dual
        ‖A x − f + Bᵀα‖∞ over max(‖A x‖∞, ‖f‖∞, ‖Bᵀα‖∞).
    gap
        |xᵀA x − fᵀx + gᵀα| over max(|½ xᵀA x|, |fᵀx|, |gᵀα|, `ENERGY_FLOOR` (fᵀf)² / 2fᵀA f). The last term is a share
        of the energy gained by one step of steepest descent from 0: where the constraints admit almost no displacement,
        the other terms are round-off.

    A program without load has no length but the one that its constraints prescribe: the primal residual is over that.
    Where they barely act, or not at all, x and α are round-off: the scales of dual residual and gap are at least the
    shares `FORCE_FLOOR` of the prescribed force and `ENERGY_FLOOR` of its product with that length; see `prescribed`.
    """

    primal: float
    dual: float
    gap: float

    @property
    def worst(self) -> float:
        """The largest of the three."""
        return max(self.primal, self.dual, self.gap)


@dataclass(frozen=True)
class Scales:
    """Denominators of the residuals of a solution; the primal one in units of each row's own norm."""

    primal: float
    dual: float
    gap: float


def kkt_residuals(program: VariationalInequality, x: Array, alpha: Array) -> Residuals:
    """Relative residuals of x (n,), α (m,) ≥ 0; see `Residuals`."""
    return residuals_and_scales(program, x, alpha)[0]


def residuals_and_scales(program: VariationalInequality, x: Array, alpha: Array) -> tuple[Residuals, Scales]:
    """Relative residuals of x (n,), α (m,) ≥ 0, and their denominators; see `Residuals`."""
    A, f, B, g = program.A, program.f, program.B, program.g
    norms, Ax, force = row_norms(B), A @ x, B.T @ alpha
    energy, work, bound = float(x @ Ax), float(f @ x), float(g @ alpha)
    least = _smallest_scales(program, norms)
    scale = Scales(
        primal=least.primal,
        dual=max(peak(Ax), peak(f), peak(force), least.dual),
        gap=max(abs(0.5 * energy), abs(work), abs(bound), least.gap),
    )
    residuals = Residuals(
        primal=float(np.max((B @ x - g) / norms, initial=0.0)) / scale.primal,
        dual=ratio(peak(Ax - f + force), scale.dual),
        gap=ratio(abs(energy - work + bound), scale.gap),
    )
    return residuals, scale


def _smallest_scales(program: VariationalInequality, norms: Array) -> Scales:
    """What the denominators never fall below, `norms` (m,) being those of B's rows."""
    driven = prescribed(program, norms)
    if driven is not None:
        return Scales(driven.length, FORCE_FLOOR * driven.force, ENERGY_FLOOR * driven.force * driven.length)
    f = program.f
    curvature = float(f @ (program.A @ f))
    # gained by the best multiple of f, a lower bound on the energy gained by A⁻¹f
    descent = 0.5 * float(f @ f) ** 2 / curvature if curvature > 0.0 else 0.0
    return Scales(max(1.0, peak(program.g / norms)), 0.0, ENERGY_FLOOR * descent)


def verify(program: VariationalInequality, answer: QPSolution, accuracy: float) -> tuple[Status, str, Residuals | None]:
    """Classify a solution by recomputed residuals: status, reason ("" when ok), residuals if they exist."""
    if answer.x is None or answer.alpha is None:
        if infeasibility_certificate(program) is not None:
            return Status.INFEASIBLE, "no point satisfies the constraints (certified)", None
        return Status.FAILED, f"the solver returned nothing: {answer.solver_status}", None
    # before any residual: max(0, nan) is 0 and would hide it
    if not (np.all(np.isfinite(answer.x)) and np.all(np.isfinite(answer.alpha))):
        return Status.NONFINITE, f"the solution is not finite: {answer.solver_status}", None
    residuals = kkt_residuals(program, answer.x, answer.alpha)
    if residuals.worst <= accuracy:
        return Status.OK, "", residuals
    if residuals.primal > accuracy and infeasibility_certificate(program) is not None:
        return Status.INFEASIBLE, "no point satisfies the constraints (certified)", residuals
    name = max(("primal", "dual", "gap"), key=lambda key: getattr(residuals, key))
    clipped = f" after setting multipliers down to -{answer.negative:.0e} to zero" if answer.negative else ""
    reason = f"{name} residual {above(getattr(residuals, name), accuracy)}{clipped}: {answer.solver_status}"
    return Status.INACCURATE, reason, residuals


def infeasibility_certificate(program: VariationalInequality, tolerance: float = 1e-10) -> Array | None:
    """α ≥ 0 with Bᵀα = 0 and gᵀα = −1 (Farkas), or `None` if no such α is found; dense programs only."""
    if not isinstance(program.B, np.ndarray) or not len(program.g):
        return None
    rows = row_norms(program.B)
    system = np.vstack([(program.B / rows[:, None]).T, program.g / rows / size(program.g / rows)])
    target = np.append(np.zeros(len(system) - 1), -1.0)
    try:
        alpha, distance = nnls(system, target, maxiter=30 * system.shape[1])
    except RuntimeError:  # nnls did not converge, which certifies nothing
        return None
    if distance > tolerance * max(1.0, float(alpha.max(initial=0.0))):
        return None
    return np.asarray(alpha / rows)


@dataclass(frozen=True)
class Slack:
    """The terms l and c of one solution in the bound of how far two are apart."""

    linear: float
    constant: float


def slack(program: VariationalInequality, x: Array, alpha: Array, accuracy: float) -> Slack:
    """Slack of a solution x (n,), α (m,) whose three relative residuals are at most `accuracy`."""
    _, scale = residuals_and_scales(program, x, alpha)
    smallest = float(np.min(np.linalg.eigvalsh(program.A), initial=np.inf))
    if not smallest > 0.0:
        return Slack(float("inf"), float("inf"))
    excess = scale.primal * float(row_norms(program.B) @ alpha)
    constant = accuracy * (scale.gap + float(np.abs(x).sum()) * scale.dual + excess)
    return Slack(accuracy * np.sqrt(len(x)) * scale.dual / smallest, constant / smallest)


def allowed(first: Slack, second: Slack) -> float:
    """The largest ‖x₁ − x₂‖ compatible with the slacks of both solutions."""
    half = 0.5 * (first.linear + second.linear)
    return float(half + np.sqrt(half**2 + first.constant + second.constant))
