"""KKT verification: residuals recomputed from the solution, and a status from them alone, not from the solver.

A residual means something only in the norms of the program. With r = f − A x − Bᵀα, s = B x − g and the energy
S² = ‖x‖²_A + ‖Bᵀα‖²_{A⁻¹} of the solution, the *natural* residuals

    dual ‖r‖_{A⁻¹} / S,    primal max_i (s_i)₊ / ‖B_i‖_{A⁻¹} / S,    gap |αᵀs| / S²,    ‖B_i‖²_{A⁻¹} = B_i A⁻¹ B_iᵀ,

are the same in all units of x and f, in any basis of x, and for any scaling of rows of B with g. They are the terms of
the error bound of `vibench.model.error_bounds`: (s_i)₊ / ‖B_i‖_{A⁻¹} is the energy norm of the smallest correction that
row i needs alone. Whether a row is violated is decided row by row, against the round-off of its own s_i: a far row, as
one with g_i = ∞, says nothing of the others.

Two solutions of one program whose residuals meet an accuracy have a bounded distance. For solutions k = 1, 2 with
α_k ≥ 0, residuals r_k = f − Ax_k − Bᵀα_k and excesses s_k = Bx_k − g, the difference d = x₁ − x₂ satisfies

    ‖d‖²_A = dᵀ(r₂ − r₁) − (α₁ − α₂)ᵀ(s₁ − s₂) ≤ ‖d‖_A (‖r₁‖ + ‖r₂‖) + |α₁ᵀs₁| + |α₂ᵀs₂| + α₁ᵀ(s₂)₊ + α₂ᵀ(s₁)₊

in the norm of A⁻¹. Where every natural residual is at most ε, ‖r_k‖ ≤ ε S_k, |α_kᵀs_k| ≤ ε S_k² and
(s_k)_i ≤ ε S_k ‖B_i‖; with p_k = Σ_i ‖B_i‖ (α_k)_i the last terms are at most ε S_k p_l ≤ ε (S_k² + p_l²)/2. This
gives ‖d‖²_A ≤ (l₁ + l₂)‖d‖_A + c₁ + c₂, each term from data of one solution alone, and the smallest eigenvalue of A
the distance ‖d‖. In a V-orthonormal basis ‖d‖ is the distance of the two displacements in V. Solvers that are `ok` on
the same reduced problem and farther apart reveal a bug.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.optimize import nnls

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg import EPS
from vibench.linalg.cholesky import SparseCholesky
from vibench.qp.scaling import row_norms
from vibench.qp.status import Status
from vibench.text import above

# From functionals, the columns of an array (n×k), to their norms (k,) in A⁻¹.
DualNorms = Callable[[Array], Array]


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
    negative: float | None = None


class QPSolver(Protocol):
    """A solver registered through the entry point group `vibench.qp_solvers`."""

    def __call__(self, program: VariationalInequality, accuracy: float) -> QPSolution:
        """Solve to a relative accuracy."""


@dataclass(frozen=True)
class Residuals:
    """Natural KKT residuals, recomputed from the solution; see above.

    The solution 0 of a program without load, whose constraints are satisfied there, has the residuals 0.
    """

    primal: float
    dual: float
    gap: float

    @property
    def worst(self) -> float:
        """The largest of the three; not a number if one of them is."""
        return float(np.max([self.primal, self.dual, self.gap]))


def kkt_residuals(program: VariationalInequality, x: Array, alpha: Array, norms: DualNorms | None = None) -> Residuals:
    """Natural residuals of x (n,), α (m,) ≥ 0.

    Parameters
    ----------
    program
        A, f, B, g, dense or sparse; g may be infinite in rows that constrain nothing.
    x, alpha
        The solution.
    norms
        Norms in A⁻¹ where A is factorised already.

    Raises
    ------
    NumericalError
        If A is not positive definite.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # a diverging solver returns infinite residuals
        return _residuals(program, x, alpha, norms or dual_norms(program.A))


def _residuals(program: VariationalInequality, x: Array, alpha: Array, norms: DualNorms) -> Residuals:
    B, g = program.B, program.g
    residual, excess = accurate_residuals(program, x, alpha)
    violated = np.flatnonzero(excess > round_off(B, x, g))
    rows = B[violated].T if isinstance(B, np.ndarray) else sp.csr_array(B)[violated].toarray().T
    lengths = norms(np.column_stack([rows, B.T @ alpha, residual]))  # one solve for all costs the least
    reach, energy = lengths[:-2], _energy(program, x, float(lengths[-2]))
    steps = np.divide(excess[violated], reach, out=np.full(len(violated), np.inf), where=reach > 0.0)
    pressed = alpha > 0.0  # elsewhere s may be infinite
    gap = abs(float(alpha[pressed] @ excess[pressed]))
    return Residuals(
        primal=_over(float(np.max(steps, initial=0.0)), energy),
        dual=_over(float(lengths[-1]), energy),
        gap=_over(gap, energy * energy),
    )


def accurate_residuals(program: VariationalInequality, x: Array, alpha: Array) -> tuple[Array, Array]:
    """The residuals f − A x − Bᵀα (n,) and B x − g (m,), summed in extended precision where the machine has one.

    For a stiff A, double precision would leave round-off times the condition number in the norm of A⁻¹.
    """
    A, B, u, lam = map(_extended, (program.A, program.B, x, alpha))
    residual, excess = program.f - A @ u - B.T @ lam, B @ u - program.g
    return residual.astype(float), excess.astype(float)


def _extended(array: Any) -> Any:
    if not sp.issparse(array) or array.format not in ("csr", "csc"):
        return array.astype(np.longdouble)
    return type(array)((array.data.astype(np.longdouble), array.indices, array.indptr), shape=array.shape)


def _energy(program: VariationalInequality, x: Array, force: float) -> float:
    """The energy S of a solution x (n,) from the norm ‖Bᵀα‖ of its forces in A⁻¹."""
    return float(np.hypot(np.sqrt(max(float(x @ (program.A @ x)), 0.0)), force))


def dual_norms(A: SparseMatrix | Array) -> DualNorms:
    """The `DualNorms` of a symmetric positive definite A (n×n), which is factorised here.

    Raises a `NumericalError` if it is not positive definite.
    """
    if not isinstance(A, np.ndarray):
        factor = SparseCholesky(A, "A")
        return lambda columns: norms_by_solutions(columns, factor.solve(columns))
    try:
        L = np.linalg.cholesky(A)
    except np.linalg.LinAlgError:
        raise NumericalError("A is not positive definite") from None
    if not len(L):  # LAPACK solves no system without unknowns
        return lambda columns: np.zeros(columns.shape[1])
    return lambda columns: np.linalg.norm(
        scipy.linalg.solve_triangular(L, columns, lower=True, check_finite=False), axis=0
    )


def norms_by_solutions(functionals: Array, solutions: Array) -> Array:
    """Norms (k,) in A⁻¹ of functionals (n×k), from the solutions A⁻¹ of them."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("ik,ik->k", functionals, solutions), 0.0)))


def round_off(B: SparseMatrix | Array, x: Array, g: Array) -> Array:
    """Bound (m,) of the round-off in B x − g (Higham 2002, §3.1), each row from its own terms."""
    terms = np.count_nonzero(B, axis=1) if isinstance(B, np.ndarray) else np.diff(sp.csr_array(B).indptr)
    return round_off_of_terms(terms, abs(B) @ np.abs(x) + np.abs(g))


def round_off_of_terms(entries: Indices, sizes: Array) -> Array:
    """`round_off` from numbers of entries of the rows (m,) and sums of absolute values of their terms (m,)."""
    # The factor 1.01 covers the round-off in this bound itself.
    return np.asarray(1.01 * EPS * (entries + 2.0) * sizes)


def _over(value: float, scale: float) -> float:
    """A residual over its scale; infinite for a solution without energy, not a number where either is not one."""
    return 0.0 if value == 0.0 else value / scale if scale != 0.0 else float("inf")


def verify(program: VariationalInequality, answer: QPSolution, accuracy: float) -> tuple[Status, str, Residuals | None]:
    """Classify a solution by recomputed residuals: status, reason ("" when ok), residuals if they exist."""
    if answer.x is None or answer.alpha is None:
        if infeasibility_certificate(program) is not None:
            return Status.INFEASIBLE, "no point satisfies the constraints (certified)", None
        return Status.FAILED, f"the solver returned nothing: {answer.solver_status}", None
    # Check this before any residual: max(0, nan) is 0 and would hide it.
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


# A timed answer with residuals above this multiple of the accuracy does not solve the program that was posed.
RECOGNISED = 30.0


def check_answer(program: VariationalInequality, answer: QPSolution, accuracy: float) -> None:
    """Refuse, by a `NumericalError`, the answer of a timed repetition that does not solve its program."""
    status, reason, _ = verify(program, answer, RECOGNISED * accuracy)
    if status is not Status.OK:
        raise NumericalError(f"timed in other units of the unknowns, {reason}; does the solver remember answers?")


def infeasibility_certificate(program: VariationalInequality) -> Array | None:
    """Multipliers α ≥ 0 with Bᵀα = 0 and gᵀα = −1 (Farkas), or `None` if none are found; dense programs only."""
    if not isinstance(program.B, np.ndarray):
        return None
    kept = np.isfinite(program.g)
    B, g = program.B[kept], program.g[kept]
    rows = row_norms(B)
    depth = float(np.max(-g / rows, initial=0.0))
    if not depth > 0.0:  # x = 0 satisfies all constraints
        return None
    system = np.vstack([(B / rows[:, None]).T, g / (rows * depth)])
    # Scale columns: those of far constraints are huge, those of zero rows may vanish.
    columns = np.linalg.norm(system, axis=0)
    columns[columns == 0.0] = 1.0
    target = np.append(np.zeros(len(system) - 1), -1.0)
    try:
        alpha, distance = nnls(system / columns, target, maxiter=30 * system.shape[1])
    except RuntimeError:  # nnls did not converge, which certifies nothing
        return None
    if distance > 1e-10 * max(1.0, float(alpha.max(initial=0.0))):
        return None
    certificate = np.zeros(len(kept))
    certificate[kept] = alpha / (columns * rows * depth)
    return certificate


@dataclass(frozen=True)
class Slack:
    """The terms l and c of one solution in the bound of this module, for ‖d‖ instead of ‖d‖_A."""

    linear: float
    constant: float


def slack(program: VariationalInequality, x: Array, alpha: Array, accuracy: float) -> Slack:
    """Slack of a solution x (n,), α (m,) of a dense program whose three natural residuals are at most `accuracy`."""
    smallest = float(np.min(np.linalg.eigvalsh(program.A), initial=np.inf))
    if not smallest > 0.0:
        return Slack(float("inf"), float("inf"))
    norms = dual_norms(program.A)
    energy = _energy(program, x, float(norms((program.B.T @ alpha)[:, None])[0]))
    pressed = float(norms(program.B.T) @ alpha)
    constant = accuracy * (1.5 * energy**2 + 0.5 * pressed**2)
    return Slack(accuracy * energy / np.sqrt(smallest), constant / smallest)


def allowed(first: Slack, second: Slack) -> float:
    """The largest ‖x₁ − x₂‖ compatible with the slacks of both solutions."""
    half = 0.5 * (first.linear + second.linear)
    return float(half + np.sqrt(half**2 + first.constant + second.constant))
