"""Estimates of the error bounds of a growing model at the cost of the contact, to rank candidates by.

The bounds (ii) of `vibench.model.error_bounds` take two factorisations of mesh size at a parameter. Here A(µ) is
replaced by γ X in them, X = A(µ₁) at the first solution and γ = ‖u_N‖²_A / ‖u_N‖²_X: the correction is that of
`vibench.model.certificates.contact_correction` with the compliance C = Eᵀ X⁻¹ E of the contact unknowns E, which is
computed once. Where A and f are constant nothing of mesh size is left: X is A, the estimates are the bounds, and with
Φ and z the basis and u_N = Φ z,

    ‖r‖²_{A⁻¹} = ‖f‖² − 2 fᵀu_N + ‖u_N‖²_A − 2 (A⁻¹f)_Eᵀ F + 2 (u_N)_Eᵀ F + Fᵀ C F,    F = Bᵀλ_N on E.

This sum keeps half of the digits: a residual below 1e-7 of u_N is round-off, and what is not far above that is no
bound. Otherwise r is formed, and X⁻¹ r solved.

The model that an adaptive training grows with: all solutions so far, and an error bound at any parameter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, sqrt
from typing import TypeVar

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.highfidelity.active_set import (
    ActiveSetSolution,
    HighFidelitySolution,
    HighFidelitySolver,
    solve_unverified,
)  # fmt: skip
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.problem import Contact, Problem, VariationalInequality
from vibench.interfaces.strategies import Trainer
from vibench.interfaces.validation import ReferenceAssembly, checked_assembly
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.definite import dense_inverse
from vibench.linalg.inner_product import orthonormal_range
from vibench.linalg.schur_complement import EliminationPattern, StaticCondensation
from vibench.model.certificates.contact_correction import ContactCompliance, ContactCorrection, find_contact_correction
from vibench.model.error_bounds import find_correction, residual, terms
from vibench.model.errors import EnergyNorm, riesz_representatives
from vibench.model.galerkin import project
from vibench.qp.exact import ExactSolution, exact_solution
from vibench.qp.scaling import ratio
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution
from vibench.reduction.cone_subtraction import subtract_cone_component
from vibench.reduction.supremizers import supremizers
from vibench.timing import NO_TIME, Seconds, timed

MOST_CONTACT = 4000
"""Largest number of contact unknowns whose compliance is a dense matrix here."""

KEPT = 1000
"""Parameters whose projected stiffness is kept."""

RESOLVED = 1e-9
"""Squares of bounds that are at least this share of the largest of their terms have lost no more than nine digits."""


@dataclass(frozen=True)
class Reduced:
    """The reduced solution z (d,) and λ_N (m,) of an estimate, and what was assembled for it."""

    vi: VariationalInequality
    z: Array
    lam: Array


@dataclass(frozen=True)
class ErrorEstimate:
    """About what the bound of `vibench.model.certificates.greedy` is, and whether it is this bound up to round-off.

    `reduced` is of a problem whose A or f vary.
    """

    value: float
    is_bound: bool = False
    reduced: Reduced | None = None


class ContactEstimates:
    """What estimates of one growing model are computed from; see above.

    Parameters
    ----------
    problem
        One that `supports` estimates.
    vi, stiffness
        The variational inequality of the first solution, and its A as a high-fidelity solver condensed it.
    """

    def __init__(self, problem: Problem, vi: VariationalInequality, stiffness: CondensedStiffness) -> None:
        assert problem.contact_dofs is not None  # as `supports` says
        self._problem, self._dofs, self._A, self._f = problem, problem.contact_dofs, vi.A.copy(), vi.f.copy()
        self.may_be_bounds = {"A", "f"} <= set(problem.constant)
        if self.may_be_bounds and stiffness.dense and np.array_equal(stiffness.retained, self._dofs):
            self._solve, compliance = stiffness.solve, stiffness.liftings(sp.eye_array(len(self._dofs), format="csr"))
        else:
            condensed = StaticCondensation(vi.A, EliminationPattern.of(vi.A, self._dofs))
            self._solve, compliance = SparseCholesky(vi.A, "A").solve, dense_inverse(condensed.dense_schur, "A")
        self._compliance = ContactCompliance(compliance, np.zeros(0, np.intp))
        self._near = np.zeros(len(self._dofs), bool)
        of_load = self._solve(self._f[:, None])[:, 0]
        self._of_load, self._square_of_load = of_load[self._dofs], float(self._f @ of_load)
        self._basis, self._at_contact = np.zeros((len(vi.f), 0)), np.zeros((len(self._dofs), 0))
        self._sizes = np.zeros(len(self._dofs))
        self._stiffness, self._loads, self._generators = np.zeros((0, 0)), np.zeros(0), np.zeros((len(vi.g), 0))
        self._projected = dict[bytes, Array]()

    @staticmethod
    def supports(problem: Problem) -> bool:
        """Whether the problem assembles its constraint on contact unknowns, which are not too many."""
        dofs = problem.contact_dofs
        return problem.has_contact and dofs is not None and len(dofs) <= MOST_CONTACT

    def grow(self, vi: VariationalInequality, basis: Array, generators: Array) -> None:
        """Take the basis Φ (n×d) and the generators (m×R) of the model, after it has taken a solution of `vi`.

        Φ begins with what it was before.
        """
        self._basis, self._generators = basis, generators
        self._at_contact = np.ascontiguousarray(self._basis[self._dofs])
        self._sizes = np.linalg.norm(self._at_contact, axis=1)
        self._stiffness, self._loads = self._grown(self._stiffness, self._A, self._f)
        touches = abs(sp.csr_array(vi.B)[:, self._dofs]) > 0.0
        near = self._near | self._next_to(touches)
        if np.any(near & ~self._near):
            self._near = near
            self._compliance = ContactCompliance(self._compliance.matrix, np.flatnonzero(near))

    def _grown(self, projected: Array, A: SparseMatrix, f: Array) -> tuple[Array, Array]:
        """ΦᵀAΦ (d×d), from that on the first vectors of Φ, and Φᵀf (d,)."""
        size, (n, count) = len(projected), self._basis.shape
        right = np.empty((n, count - size + 1))  # one product with Φ, which is large, for all
        right[:, :-1], right[:, -1] = A @ self._basis[:, size:], f
        products = self._basis.T @ right
        new, grown = products[:, :-1], np.zeros((count, count))
        grown[:size, :size], grown[:, size:], grown[size:] = projected, new, new.T
        grown[size:, size:] = 0.5 * (new[size:] + new[size:].T)
        return grown, products[:, -1]

    def _program(self, mu: Array, vi: VariationalInequality, contact: Contact) -> VariationalInequality:
        """The reduced program at mu (d,), where A varies; candidates are evaluated again with a larger basis."""
        key, chi = mu.tobytes(), self._generators
        A, f = self._grown(self._projected.pop(key, np.zeros((0, 0))), vi.A, vi.f)
        self._projected[key] = A
        if len(self._projected) > KEPT:
            del self._projected[next(iter(self._projected))]
        return VariationalInequality(A, f, chi.T @ np.asarray(contact.B @ self._at_contact), chi.T @ contact.g)

    def _next_to(self, touches: Mask) -> Mask:
        """Contact unknowns (k,) in rows of the support of a generator, or in rows that touch one of these."""
        rows = np.any(self._generators > 0.0, axis=1)
        return np.asarray(touches.T @ (touches @ (touches.T @ rows)), bool)

    def at(self, mu: Array) -> ErrorEstimate:
        """The estimate at mu (d,); infinite where the reduced program has no solution, or no correction was found."""
        contact = self._problem.contact(mu)
        assert contact is not None  # as `supports` says
        chi, rows = self._generators, sp.csr_array(contact.B)
        vi = None if self.may_be_bounds else checked_assembly(self._problem, mu)
        if vi is None:
            B = chi.T @ np.asarray(rows @ self._at_contact)
            program = VariationalInequality(self._stiffness, self._loads, B, chi.T @ contact.g)
        else:
            program = self._program(mu, vi, contact)
        answer = exact_solution(program)
        if answer is None:
            return ErrorEstimate(inf)
        z, lam = answer.x, chi @ np.maximum(answer.alpha, 0.0)
        energy, force, on_contact = float(z @ (program.A @ z)), np.asarray(rows.T @ lam), self._at_contact @ z
        gamma = 1.0 if vi is None else ratio(energy, float(z @ (self._stiffness @ z))) or 1.0
        uncertain = (len(z) + 4.0) * float(np.finfo(float).eps) * float(np.linalg.norm(z)) * self._sizes
        found = find_contact_correction(self._compliance, contact, on_contact, uncertain, lam, gamma)
        reduced = None if vi is None else Reduced(vi, z, lam)
        if found is None:
            return ErrorEstimate(inf, reduced=reduced)
        _, _, C = self._compliance.blocks[len(found.unknowns) > len(self._compliance.near)]
        pushed = C @ force[found.unknowns]  # no force is elsewhere, or the correction would have other unknowns
        pressed, size_of_load = float(force[found.unknowns] @ pushed), self._square_of_load
        if vi is None:
            riesz = (self._of_load - on_contact)[found.unknowns] - pushed
            square = size_of_load + energy - 2.0 * float(self._loads @ z + (self._of_load - on_contact) @ force)
            square += pressed
        else:
            riesz, square = self._residual(vi, z, force, found.unknowns)
        bounds = _Bounds.of(found, max(square, 0.0) / gamma, gamma, riesz)
        value = self._relative(bounds, lam, found.nu, sqrt(max(energy, 0.0)), sqrt(max(pressed, 0.0) / gamma))
        resolved = bounds.smallest_square >= RESOLVED * max(size_of_load, energy, pressed)
        return ErrorEstimate(value, vi is None and resolved and found.nu is not None and not found.eta, reduced)

    def _residual(self, vi: VariationalInequality, z: Array, force: Array, unknowns: Indices) -> tuple[Array, float]:
        """X⁻¹ r on some contact unknowns (l,), and the square of ‖r‖ in X⁻¹."""
        residual = vi.f - vi.A @ (self._basis @ z)
        residual[self._dofs] -= force
        riesz = self._solve(residual[:, None])[:, 0]
        return riesz[self._dofs[unknowns]], float(residual @ riesz)

    def _relative(self, bounds: _Bounds, lam: Array, nu: Array | None, energy: float, pressed: float) -> float:
        """The largest of the bounds of u and λ and the estimate of λ in W, relative to u_N and λ_N, as in `bound`.

        `energy` and `pressed` are ‖u_N‖_A and the norm of Bᵀλ_N.
        """
        of_u = ratio(bounds.primal, energy)
        if not pressed > 0.0:
            return of_u
        X = self._problem.W.matrix  # as no digit is lost in a sum of squares, no factor of it is needed
        squares = (float(eta @ (X @ eta)) for eta in (np.zeros_like(lam) if nu is None else nu - lam, lam))
        in_W = ratio(*(sqrt(max(0.0, square)) for square in squares))
        return max(of_u, ratio(bounds.dual, pressed), in_W)


@dataclass(frozen=True)
class _Bounds:
    """Bounds (ii) with a correction: Δ_A, that of λ, and the smallest of the squares that they are roots of."""

    primal: float
    dual: float
    smallest_square: float

    @classmethod
    def of(cls, found: ContactCorrection, square: float, gamma: float, riesz: Array) -> _Bounds:
        """With ρ² and X⁻¹ r (l,) on the unknowns of the correction."""
        omega = sqrt(gamma) * found.norm
        total = square + omega**2 + 2.0 * found.kappa
        primal, gap = sqrt(total), total + 2.0 * float(riesz @ found.load)
        return cls(primal, min(sqrt(max(0.0, gap)), omega + primal), min(total, gap))


T = TypeVar("T")


@dataclass(frozen=True)
class BoundState:
    """What a bound at mu (d,) leaves to a solution there: where to start, and what was assembled and condensed.

    The multiplier of the correction, which presses rows (m,), is that of the solution but for the residual.
    """

    mu: Array
    vi: VariationalInequality
    stiffness: CondensedStiffness
    pressed: Mask


IN_CONE = 1e-6
"""A multiplier is in the cone where less than this share of it is outside: it may be what a solver left."""

SOLVER, ACCURACY = "piqp", 1e-9
"""Solver of the programs that cannot be solved to round-off."""


class IncrementalModel:
    """A reduced model of all high-fidelity solutions that were added to it, without compression.

    Its space is spanned by the u(µ_i) and supremizers T(µ_i)ν_i (Haasdonk, Salomon and Wohlmuth 2012, §5), its cone by
    the ν_i: every λ(µ_i) without its part in the cone before it (line 9 of Algorithm 2 of Niakh et al. 2022), which
    makes the cone larger than that of the λ(µ_i). Bounds are (ii) of `vibench.model.error_bounds`, at the cost of the
    mesh.

    Attributes
    ----------
    generators
        The ν_i (m×R), unit norm in W.
    """

    def __init__(self, problem: Problem, solver: HighFidelitySolver) -> None:
        self._problem, self._solver = problem, solver
        self._whitened = np.zeros((problem.V.dim, 0))
        self._basis = np.zeros((problem.V.dim, 0))
        self.generators = np.zeros((problem.W.dim, 0))
        self._estimates: ContactEstimates | None = None
        self._last: tuple[bytes, ErrorEstimate] | None = None
        self._bounded: BoundState | None = None

    def add(self, vi: VariationalInequality, solution: HighFidelitySolution) -> str:
        """Add the solution of `vi`; returns what was less accurate than usual, "" if nothing."""
        V, W, size = self._problem.V, self._problem.W, self._whitened.shape[1]
        rest, note = subtract_cone_component(solution.lam, self.generators, W)
        new = [solution.u[:, None]]
        norm = float(W.norm(rest))
        if norm > IN_CONE * float(W.norm(solution.lam)):
            new.append(supremizers(V, vi.B, rest[:, None]))
            self.generators = np.hstack([self.generators, rest[:, None] / norm])
        for column in new:  # one after the other: u must not lose to its supremizer
            more = orthonormal_range(V.whiten(column), self._whitened)
            self._whitened = np.hstack([self._whitened, more])
        self._basis = np.hstack([self._basis, V.unwhiten(self._whitened[:, size:])])
        if self._estimates is None and ContactEstimates.supports(self._problem):
            self._estimates = ContactEstimates(self._problem, vi, self._solver.condensed(vi))
        self._last = self._bounded = None
        if self._estimates is not None:
            self._estimates.grow(vi, self._basis, self.generators)
        return note

    def solution(self, vi: VariationalInequality) -> tuple[Array, Array] | None:
        """The reduced solution u_N (n,) and λ_N ≥ 0 (m,) of `vi`; `None` if its program cannot be solved."""
        program = project(vi, self._basis, self.generators)
        answer: ExactSolution | QPSolution | None = exact_solution(program)
        if answer is None:
            answer = solve_qp(program, SOLVER, ACCURACY)
        if answer.x is None or answer.alpha is None:
            return None
        return self._basis @ answer.x, self.generators @ np.maximum(answer.alpha, 0.0)

    def estimate(self, mu: Array) -> float | None:
        """What `bound` is about, at the cost of the contact; `None` where the problem does not allow it."""
        return None if self._estimates is None else self._estimated(self._estimates, mu).value

    def _estimated(self, estimates: ContactEstimates, mu: Array) -> ErrorEstimate:
        """The estimate at mu (d,); the last one is kept, which is what a bound is asked for next."""
        key = mu.tobytes()
        if self._last is None or self._last[0] != key:
            self._bounded = None  # a problem may assemble into the arrays of that
            self._last = key, estimates.at(mu)
        return self._last[1]

    def bounded(self, mu: Array) -> BoundState | None:
        """What the last bound leaves to a solution at mu (d,), unless it was at another parameter."""
        return self._bounded if self._bounded is not None and np.array_equal(self._bounded.mu, mu) else None

    def bound(self, mu: Array) -> float:
        """The largest of two bounds and an estimate at mu (d,), relative to the reduced solution; infinite without one.

        The bound of u is in the energy norm over that of u_N, that of λ in the norm of A⁻¹ over that of Bᵀλ_N. Neither
        follows the error of λ in W, in which contact pressures are compared: the same λ − λ_N is smaller in the norm of
        A⁻¹ the faster it oscillates. Its estimate is ‖ν − λ_N‖_W / ‖λ_N‖_W, ν the multiplier of the correction that the
        bounds need anyway. Where A and f are constant the estimate is all that, with a factorisation of A, too.
        """
        if self._estimates is not None and self._estimates.may_be_bounds:
            estimated = self._estimated(self._estimates, mu)
            if estimated.is_bound:
                return estimated.value
        vi, solved = self._assembled(mu)
        if solved is None:
            return float("inf")
        u, lam = solved
        energy = EnergyNorm(vi.A, self._solver.condensed(vi))
        corrected = find_correction(vi, energy, u, lam)
        if corrected is None:
            return float("inf")
        self._bounded = BoundState(mu, vi, energy.stiffness, corrected.nu > 0.0)
        (riesz,) = riesz_representatives([energy], [residual(vi, u, lam)])
        of_pair = terms(corrected, u, lam, riesz)
        of_u = ratio(of_pair.primal, energy.norm(u))
        pressed, W = corrected.on.of_force(lam).norm, self._problem.W
        if not pressed > 0.0:
            return of_u
        in_W = ratio(float(W.norm(corrected.nu - lam)), float(W.norm(lam)))
        return max(of_u, ratio(of_pair.dual, pressed), in_W)

    def _assembled(self, mu: Array) -> tuple[VariationalInequality, tuple[Array, Array] | None]:
        """The inequality at mu (d,) and its reduced solution: what an estimate just there has left, or made anew."""
        last, self._last, self._bounded = self._last, None, None
        if last is not None and last[0] == mu.tobytes() and (reduced := last[1].reduced) is not None:
            return reduced.vi, (self._basis @ reduced.z, reduced.lam)
        vi = checked_assembly(self._problem, mu)
        return vi, self.solution(vi)


@dataclass(frozen=True)
class Solved:
    """One solution of an adaptive training, the bound that led to it, and how many were evaluated before it.

    Estimates are among these. `fallback` says what was used besides the active set method, and what was less accurate
    in the growth of the model.
    """

    mu: Array
    solution: HighFidelitySolution
    seconds: Seconds
    bound: float
    evaluated: int
    fallback: str


class GreedyTrainer(Trainer):
    """High-fidelity solutions, and bounds of the model that they make, with the seconds of both.

    A solution where a bound was computed last starts from what that has left: its assembly and its factors of A are
    among the seconds of bounds.

    Attributes
    ----------
    solved
        The solutions in their order.
    setup
        Seconds of the set-up: what the first solution took beyond its repetition.
    selecting
        Seconds of bounds and of the growth of their model.
    """

    def __init__(self, problem: Problem, reference: ReferenceAssembly) -> None:
        self._problem, self._reference = problem, reference
        # one condensation serves a bound and the solution there
        self._solver = HighFidelitySolver(problem, condensing=True)
        self._model, self._evaluated = IncrementalModel(problem, self._solver), 0
        self.solved: list[Solved] = []
        self.setup = self.selecting = NO_TIME

    def solve(self, mu: Array, bound: float = float("nan")) -> None:
        """Assemble, solve, and let the model grow."""
        mu = np.array(mu, float)
        bounded = self._model.bounded(mu)

        def work() -> tuple[VariationalInequality, ActiveSetSolution]:
            if bounded is not None:
                return bounded.vi, solve_unverified(bounded.vi, bounded.stiffness, bounded.pressed)
            vi = checked_assembly(self._problem, mu)
            return vi, self._solver.solve_assembled(mu, vi)

        (vi, unverified), seconds = timed(work)
        solution = self._solver.verify(mu, vi, unverified)  # as what follows, this is not timed
        self._solver.check_coercive(mu, vi)
        self._reference.refuse_false_constants(mu, vi)
        self._solver.remember(mu, solution)
        if not self.solved:  # without a start, which later ones have; with one it is a solution like those
            (vi, _), marginal = timed(work)
            self.setup, seconds = seconds.beyond(marginal), marginal
        note, growing = timed(lambda: self._model.add(vi, solution))
        fallback = "; ".join(filter(None, (solution.fallback, note)))
        self.solved.append(Solved(mu, solution, seconds, bound, self._evaluated, fallback))
        self.selecting += growing

    def bound(self, mu: Array) -> float:
        """The bound of the model of all solutions."""
        return self._evaluate(self._model.bound, mu)

    def estimate(self, mu: Array) -> float | None:
        """What the bound is about, or `None`."""
        return self._evaluate(self._model.estimate, mu)

    def _evaluate(self, judge: Callable[[Array], T], mu: Array) -> T:
        found, seconds = timed(lambda: judge(np.array(mu, float)))
        self.selecting, self._evaluated = self.selecting + seconds, self._evaluated + int(found is not None)
        return found
