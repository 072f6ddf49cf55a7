"""KKT verification: residuals recomputed from the solution, and a status from them alone, not from the solver.

A residual means something only in the norms of the program, relative to what contact does. With u₀ = A⁻¹f the natural
size of a program is F = ‖u − u₀‖_A = ‖Bᵀα‖_{A⁻¹}: a loaded body beside the one in contact adds nothing to it. With
r = f − A x − Bᵀα and s = B x − g the *natural* residuals

    dual ‖r‖_{A⁻¹} / F,    primal max_i (s_i)₊ / ‖B_i‖_{A⁻¹} / F,    gap |αᵀs| / F²,    ‖B_i‖²_{A⁻¹} = B_i A⁻¹ B_iᵀ,

are the same in all units of x and f, in any basis of x, and for any scaling of rows of B with g ("Residuals" in
docs/mathematics.md). Their unit is the F of the answer; where that does not suffice, the larger of it and of
F_low = max_i (B_i u₀ − g_i)₊ / ‖B_i‖_{A⁻¹} ≤ F. Without contact, F_low = 0, it is S, S² = ‖x‖²_A + ‖Bᵀα‖²_{A⁻¹}.
Pairs of opposite rows are equalities and belong to u₀, or a loaded tie would hide the contact; they open no gap, which
would be their force times round-off. Whether a row is violated is decided row by row, against the round-off of its own
s_i: a far row, as one with g_i = ∞, says nothing of the others. A row whose multiplier has a bound is never violated:
its gap is σ_K(s) − λᵀs.

Two solutions of one program whose residuals meet an accuracy have a bounded distance. For solutions k = 1, 2 with
α_k ≥ 0, residuals r_k = f − Ax_k − Bᵀα_k and excesses s_k = Bx_k − g, the difference d = x₁ − x₂ satisfies

    ‖d‖²_A = dᵀ(r₂ − r₁) − (α₁ − α₂)ᵀ(s₁ − s₂) ≤ ‖d‖_A (‖r₁‖ + ‖r₂‖) + |α₁ᵀs₁| + |α₂ᵀs₂| + α₁ᵀ(s₂)₊ + α₂ᵀ(s₁)₊

in the norm of A⁻¹. Where every natural residual is at most ε in the units U_k, the last terms are at most
ε U_k p_l ≤ ε (U_k² + p_l²)/2, with p_k = Σ_i ‖B_i‖ (α_k)_i. This gives ‖d‖²_A ≤ (l₁ + l₂)‖d‖_A + c₁ + c₂, each term
from data of one solution alone, and the smallest eigenvalue of A the distance ‖d‖, in V for a V-orthonormal basis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Protocol

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.optimize import nnls

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError
from vibench.interfaces.dual_sets import RAYS, DualSet
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg import EPS
from vibench.linalg.cholesky import SparseCholesky
from vibench.qp.exact import Rows, rows_that_matter
from vibench.qp.scaling import row_norms
from vibench.qp.status import Status
from vibench.signatures import NotNegative
from vibench.text import above


@dataclass(frozen=True)
class QPSolution:
    """Unverified result of a solver: x (n,), multipliers α (m,) with A x + Bᵀα = f, its status and iteration count.

    `solve_qp` sets negative multipliers to zero; `negative` is the largest absolute value among them. It makes the
    status one printable line, and leaves out iterations that are no number of them.
    """

    x: Annotated[Array, "n"] | None
    alpha: Annotated[Array, "m"] | None
    solver_status: str
    iterations: int | None = None
    negative: float | None = None


class QPSolver(Protocol):
    """A solver registered through the entry point group `vibench.qp_solvers`."""

    def __call__(self, program: VariationalInequality, accuracy: float) -> QPSolution:
        """Solve to a relative accuracy."""


@dataclass(frozen=True)
class Residuals:
    """Natural KKT residuals, recomputed from the solution, and the energy that they are relative to; see above.

    The solution 0 of a program without load, whose constraints are satisfied there, has the residuals 0.
    """

    primal: float
    dual: float
    gap: float
    unit: float

    @classmethod
    def relative(cls, step: float, residual: float, gap: float, unit: float) -> Residuals:
        """The residuals from max (s_i)₊/‖B_i‖, ‖r‖, |αᵀs| and their unit."""
        return cls(_over(step, unit), _over(residual, unit), _over(gap, unit * unit), unit)

    @property
    def worst(self) -> float:
        """The largest of the three; not a number if one of them is."""
        return float(np.max([self.primal, self.dual, self.gap]))


class Inverse(Protocol):
    """A factorisation of a symmetric positive definite A (n×n)."""

    def solve(self, right: Array) -> Array:
        """A⁻¹ r for right-hand sides (n×k)."""

    def dual_norms(self, functionals: Array) -> Array:
        """Norms (k,) in A⁻¹ of functionals (n×k)."""
        return norms_by_solutions(functionals, self.solve(functionals))

    def holding(self, program: VariationalInequality, rows: Indices) -> Array:
        """The minimiser (n,) of ½ uᵀA u − fᵀu with these rows of B u ≤ g, which may be dependent, as equalities."""
        T, free = _dense_rows(program.B, rows), self.solve(program.f[:, None])[:, 0]
        shifts = self.solve(T.T)
        forces = np.linalg.lstsq(T @ shifts, T @ free - program.g[rows], rcond=None)[0]
        return np.asarray(free - shifts @ forces)


@np.errstate(over="ignore", invalid="ignore")  # a diverging solver returns infinite residuals
def kkt_residuals(
    program: VariationalInequality, x: Annotated[Array, "n"], alpha: Annotated[Array, "m"],
    inverse: Inverse | None = None, accuracy: NotNegative = 0.0,
) -> Residuals:  # fmt: skip
    """Natural residuals of x (n,), α (m,) ≥ 0 for a dense or sparse program.

    `inverse` is the factorisation of A where there is one already. Residuals up to the `accuracy` are good enough: F of
    the answer is their unit then, and no other one is computed. Raises a `NumericalError` if A is not definite.
    """
    B, g, K, inverse = program.B, program.g, program.K, inverse or inverse_of(program.A)
    residual, excess = accurate_residuals(program, x, alpha)
    rounded, rays = round_off(B, x, g), K.rays(len(g))
    violated = np.flatnonzero((excess > rounded) & rays)
    force = np.asarray(B.T @ alpha)
    # One solve for all costs the least.
    lengths = inverse.dual_norms(np.column_stack([_dense_rows(B, violated).T, force, residual]))
    step, left, contact = _largest_step(excess[violated], lengths[:-2]), float(lengths[-1]), float(lengths[-2])
    rows = rows_that_matter(B, g, rounded, K=K)
    if len(rows.equalities):
        held = inverse.holding(replace(program, f=force, g=np.zeros_like(g)), rows.equalities)
        contact = _energy(program.A, held)
    pressing = np.where(rows.tied, 0.0, alpha)
    found = Residuals.relative(step, left, complementarity(K, pressing, excess), contact)
    if found.worst <= accuracy or not np.isfinite([step, left, contact]).all():
        return found
    free, moved = _refined_solution(program.A, inverse, program.f), _refined_solution(program.A, inverse, -force)
    least = _least_contact(program, inverse, free, rows)
    unit = max(contact, least) if least else float(np.hypot(_energy(program.A, x), lengths[-2]))
    found = Residuals.relative(step, left, complementarity(K, pressing, excess), unit)
    # What rounding leaves of x says nothing of α, which is then judged with v = −A⁻¹Bᵀα, the x of no round-off being
    # u₀ + v: the factor allows for sums of as many terms as a reduced program has.
    if not left <= 64.0 * EPS * float(np.sqrt(np.abs(x) @ (abs(program.A) @ np.abs(x)))):
        return found
    excess = np.asarray(extended(B) @ (sum(free) + sum(moved)) - g, dtype=float)
    violated = np.flatnonzero((excess > 0.0) & rays)
    rest = np.asarray(-force - extended(program.A) @ sum(moved), dtype=float)
    lengths = inverse.dual_norms(np.column_stack([_dense_rows(B, violated).T, rest]))
    step = _largest_step(excess[violated], lengths[:-1])
    gap = complementarity(K, pressing, excess)
    return min(found, Residuals.relative(step, float(lengths[-1]), gap, unit), key=lambda r: r.worst)


def _largest_step(excess: Array, lengths: Array) -> float:
    """The largest (s_i)₊ / ‖B_i‖ of violated rows (k,), from their lengths; infinite for a violated row of zeros."""
    steps = np.divide(excess, lengths, out=np.full(len(excess), np.inf), where=lengths > 0.0)
    return float(np.max(steps, initial=0.0))


def complementarity(K: DualSet, lam: Array, excess: Array) -> float:
    """The |λᵀs| of rays, whose s = B u − g (m,) may be infinite where λ is zero, and σ_K(s) − λᵀs of other blocks."""
    if not K.blocks:
        pressed = lam > 0.0
        return abs(float(lam[pressed] @ excess[pressed]))
    rays = K.rays(len(lam))
    return complementarity(RAYS, lam[rays], excess[rays]) + K.gap(np.where(rays, 0.0, lam), -excess)


def _dense_rows(B: SparseMatrix | Array, rows: Indices) -> Array:
    return B[rows] if isinstance(B, np.ndarray) else np.asarray(sp.csr_array(B)[rows].toarray())


def _refined_solution(A: SparseMatrix | Array, inverse: Inverse, load: Array) -> tuple[Any, Any]:
    """The solution A⁻¹f and its first correction (n,), whose sum in extended precision is exact to second order."""
    first = inverse.solve(load[:, None])[:, 0]
    rest = np.asarray(load - extended(A) @ extended(first), dtype=float)
    return extended(first), extended(inverse.solve(rest[:, None])[:, 0])


def _least_contact(program: VariationalInequality, inverse: Inverse, free: tuple[Any, Any], rows: Rows) -> float:
    """F_low, a lower bound of F from u₀ alone; 0 where no row is violated there beyond the round-off of u₀."""
    B, g = program.B, program.g
    at = sum(free) if not len(rows.equalities) else inverse.holding(program, rows.equalities)
    excess = np.asarray(extended(B) @ at - g, dtype=float)
    doubtful = round_off(B, np.asarray(at, dtype=float), g) + np.abs(np.asarray(B @ free[1].astype(float)))
    reached = np.flatnonzero((excess > doubtful) & ~rows.implied)
    # Every row gives a lower bound, and those that are farthest out the largest ones: a solution for each of thousands
    # would cost more than the verification.
    depths = excess[reached] / row_norms(B)[reached]
    reached = reached[np.argsort(-depths, kind="stable")[:32]]
    lengths = inverse.dual_norms(_dense_rows(B, reached).T) if len(reached) else np.zeros(0)
    return float(np.max(excess[reached] / lengths, initial=0.0, where=lengths > 0.0))


def accurate_residuals(program: VariationalInequality, x: Array, alpha: Array) -> tuple[Array, Array]:
    """The residuals f − A x − Bᵀα (n,) and B x − g (m,), summed in extended precision where the machine has one.

    For a stiff A, double precision would leave round-off times the condition number in the norm of A⁻¹.
    """
    A, B, u, lam = map(extended, (program.A, program.B, x, alpha))
    residual, excess = program.f - A @ u - B.T @ lam, B @ u - program.g
    return residual.astype(float), excess.astype(float)


def extended(array: Any) -> Any:
    """An array, or a sparse matrix, in extended precision where the machine has one."""
    if not sp.issparse(array) or array.format not in ("csr", "csc"):
        return array.astype(np.longdouble)
    return type(array)((array.data.astype(np.longdouble), array.indices, array.indptr), shape=array.shape)


def _energy(A: SparseMatrix | Array, x: Array) -> float:
    """The norm ‖x‖_A of x (n,)."""
    return float(np.sqrt(max(float(x @ (A @ x)), 0.0)))


def inverse_of(A: SparseMatrix | Array) -> Inverse:
    """Factorise a symmetric positive definite A (n×n); raises a `NumericalError` if it is not positive definite."""
    if not isinstance(A, np.ndarray):
        return _SparseInverse(SparseCholesky(A, "A"))
    try:
        return _DenseInverse(np.asarray(np.linalg.cholesky(A), float))
    except np.linalg.LinAlgError:
        raise NumericalError("A is not positive definite") from None


@dataclass(frozen=True)
class _SparseInverse(Inverse):
    factor: SparseCholesky

    def solve(self, right: Array) -> Array:
        return self.factor.solve(right)


@dataclass(frozen=True)
class _DenseInverse(Inverse):
    L: Array

    def solve(self, right: Array) -> Array:
        return np.asarray(scipy.linalg.cho_solve((self.L, True), right, check_finite=False)) if len(self.L) else right

    def dual_norms(self, functionals: Array) -> Array:
        if not len(self.L):  # LAPACK solves no system without unknowns
            return np.zeros(functionals.shape[1])
        whitened = scipy.linalg.solve_triangular(self.L, functionals, lower=True, check_finite=False)
        return np.asarray(np.linalg.norm(whitened, axis=0))


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


def verify(
    program: VariationalInequality, answer: QPSolution, accuracy: NotNegative
) -> tuple[Status, str, Residuals | None]:
    """Classify a solution by recomputed residuals: status, reason ("" when ok), residuals if they exist."""
    if answer.x is None or answer.alpha is None:
        if infeasibility_certificate(program) is not None:
            return Status.INFEASIBLE, "no point satisfies the constraints (certified)", None
        return Status.FAILED, f"the solver returned nothing: {answer.solver_status}", None
    # Check this before any residual: max(0, nan) is 0 and would hide it, as negative multipliers may hide a violation.
    finite = np.all(np.isfinite(answer.x)) and np.all(np.isfinite(answer.alpha))
    if not finite or np.min(answer.alpha, initial=0.0) < 0.0:
        status, what = (Status.FAILED, "has negative multipliers") if finite else (Status.NONFINITE, "is not finite")
        return status, f"the solution {what}: {answer.solver_status}", None
    residuals = kkt_residuals(program, answer.x, answer.alpha, accuracy=accuracy)
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


def slack(program: VariationalInequality, alpha: Array, residuals: Residuals, accuracy: float) -> Slack:
    """Slack of a solution with multipliers α (m,) of a dense program, if its `residuals` are at most `accuracy`."""
    smallest = float(np.min(np.linalg.eigvalsh(program.A), initial=np.inf))
    if not smallest > 0.0:
        return Slack(float("inf"), float("inf"))
    pressed = float(inverse_of(program.A).dual_norms(program.B.T) @ alpha)
    constant = accuracy * (1.5 * residuals.unit**2 + 0.5 * pressed**2)
    return Slack(accuracy * residuals.unit / np.sqrt(smallest), constant / smallest)


def allowed(first: Slack, second: Slack) -> float:
    """The largest ‖x₁ − x₂‖ compatible with the slacks of both solutions."""
    half = 0.5 * (first.linear + second.linear)
    return float(half + np.sqrt(half**2 + first.constant + second.constant))
