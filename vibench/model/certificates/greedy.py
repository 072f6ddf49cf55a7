"""The model that an adaptive training grows with: all solutions so far, and an error bound at any parameter.

The bounds (ii) of `vibench.model.error_bounds` take two factorisations of mesh size at a parameter. Candidates are
ranked by estimates at the cost of the contact. There A(µ) is replaced by γ X, X = A(µ₁) at the first solution and
γ = ‖u_N‖²_A / ‖u_N‖²_X: the correction is that of `vibench.model.certificates.contact_correction` with the compliance
C = Eᵀ X⁻¹ E of the contact unknowns E, which is computed once. If A and f are constant, nothing of mesh size is left: X
is A, the estimates are the bounds, and with Φ and z the basis and u_N = Φ z,

    ‖r‖²_{A⁻¹} = ‖f‖² − 2 fᵀu_N + ‖u_N‖²_A − 2 (A⁻¹f)_Eᵀ F + 2 (u_N)_Eᵀ F + Fᵀ C F,    F = Bᵀλ_N on E.

Cancellation halves the number of correct digits of this sum: values near 1e-7·‖u_N‖ are estimates, not bounds.
Otherwise r is formed, and X⁻¹ r solved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, sqrt

import numpy as np
import scipy.sparse as sp
from cachetools import LRUCache

from vibench.arrays import Array, Mask, SparseMatrix
from vibench.errors import at_parameter
from vibench.highfidelity import active_set
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Trainer
from vibench.interfaces.validation import ReferenceAssembly, checked_assembly
from vibench.linalg import EPS
from vibench.linalg.cholesky import SparseCholesky
from vibench.linalg.definite import dense_inverse
from vibench.linalg.inner_product import orthonormal_range
from vibench.linalg.schur_complement import EliminationPattern, StaticCondensation
from vibench.model.bound_terms import BoundTerms
from vibench.model.certificates.contact_correction import ContactCompliance, find_contact_correction, unknowns_near
from vibench.model.error_bounds import bound_terms, find_correction
from vibench.model.errors import EnergyNorm, T
from vibench.model.galerkin import contact_at, project
from vibench.qp.exact import ExactSolution, exact_solution
from vibench.qp.scaling import ratio
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution
from vibench.reduction.cone_subtraction import subtract_cone_component
from vibench.reduction.supremizers import supremizers
from vibench.timing import NO_TIME, Seconds, timed


@dataclass(frozen=True)
class ErrorEstimate:
    """Approximate value of `IncrementalModel.bound`, and whether it is this bound up to round-off.

    `reduced` are the inequality, z (d,) and λ_N (m,) of a problem whose A or f vary.
    """

    value: float
    is_bound: bool
    reduced: tuple[VariationalInequality, Array, Array] | None


class ContactEstimates:
    """Estimates of the bounds of one incremental model, of a problem that `supports` them.

    `vi` is the inequality of the first solution, `stiffness` its A as a high-fidelity solver condensed it.
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
        self._compliance = ContactCompliance(compliance, np.zeros(0, np.intp), 0.0)
        load = self._solve(self._f[:, None])[:, 0]
        self._load, self._square_of_load = load[self._dofs], float(self._f @ load)
        self._basis, self._at_contact = np.zeros((len(vi.f), 0)), np.zeros((len(self._dofs), 0))
        self._sizes = np.zeros(len(self._dofs))
        self._stiffness, self._loads, self._generators = np.zeros((0, 0)), np.zeros(0), np.zeros((len(vi.g), 0))
        # projected stiffnesses of candidates, which are evaluated again with a larger basis
        self._projected: LRUCache[bytes, Array] = LRUCache(1000)

    @staticmethod
    def supports(problem: Problem) -> bool:
        """Tell whether the problem assembles its constraint on contact unknowns, which are not too many."""
        dofs = problem.contact_dofs
        # the compliance of 4,000 unknowns is a dense matrix of 128 MB
        return problem.has_contact and dofs is not None and len(dofs) <= 4000

    def grow(self, vi: VariationalInequality, basis: Array, generators: Array) -> None:
        """Take the basis Φ (n×d) and the generators (m×R) of the model, after it has taken a solution of `vi`.

        Φ begins with what it was before.
        """
        self._basis, self._generators = basis, generators
        self._at_contact = np.ascontiguousarray(self._basis[self._dofs])
        self._sizes = np.linalg.norm(self._at_contact, axis=1)
        self._stiffness, self._loads = self._grown(self._stiffness, self._A, self._f)
        near = unknowns_near(sp.csr_array(vi.B)[:, self._dofs], generators)
        near[self._compliance.near] = True
        if near.sum() > len(self._compliance.near):
            self._compliance = ContactCompliance(self._compliance.matrix, np.flatnonzero(near), 0.0)

    def _grown(self, projected: Array, A: SparseMatrix, f: Array) -> tuple[Array, Array]:
        """The matrix ΦᵀAΦ (d×d), from that on the first vectors of Φ, and Φᵀf (d,)."""
        size, (n, count) = len(projected), self._basis.shape
        # one product with Φ, which is large, for all
        right = np.empty((n, count - size + 1))
        right[:, :-1], right[:, -1] = A @ self._basis[:, size:], f
        products = self._basis.T @ right
        new, grown = products[:, :-1], np.zeros((count, count))
        grown[:size, :size], grown[:, size:], grown[size:] = projected, new, new.T
        grown[size:, size:] = 0.5 * (new[size:] + new[size:].T)
        return grown, products[:, -1]

    def estimate(self, mu: Array) -> ErrorEstimate:
        """The estimate at mu (d,); infinite where the reduced program has no solution, or no correction was found."""
        contact = contact_at(self._problem, mu)
        chi, rows = self._generators, sp.csr_array(contact.B)
        vi, A, f = None, self._stiffness, self._loads
        if not self.may_be_bounds:
            vi, key = checked_assembly(self._problem, mu), mu.tobytes()
            A, f = self._grown(self._projected.get(key, np.zeros((0, 0))), vi.A, vi.f)
            self._projected[key] = A
        B = chi.T @ np.asarray(rows @ self._at_contact)
        if (answer := exact_solution(VariationalInequality(A, f, B, chi.T @ contact.g))) is None:
            return ErrorEstimate(inf, False, None)
        z, lam = answer.x, chi @ np.maximum(answer.alpha, 0.0)
        energy, force, on_contact = float(z @ (A @ z)), np.asarray(rows.T @ lam), self._at_contact @ z
        gamma = 1.0 if vi is None else ratio(energy, float(z @ (self._stiffness @ z))) or 1.0
        # d products, their sum, and the round-off of Φ: as in `OnlineCertificate.unit_round_off`
        uncertain = (len(z) + 4.0) * EPS * float(np.linalg.norm(z)) * self._sizes
        best = find_contact_correction(self._compliance, contact, on_contact, uncertain, lam, gamma)
        reduced = None if vi is None else (vi, z, lam)
        if best is None:
            return ErrorEstimate(inf, False, reduced)
        _, _, C = self._compliance.blocks[len(best.unknowns) > len(self._compliance.near)]
        # no force is on other unknowns, or the correction would involve them
        pushed = C @ force[best.unknowns]
        pressed, size_of_load = float(force[best.unknowns] @ pushed), self._square_of_load
        if vi is None:
            riesz = (self._load - on_contact)[best.unknowns] - pushed
            square = size_of_load + energy - 2.0 * float(self._loads @ z + (self._load - on_contact) @ force)
            square += pressed
        else:
            residual = vi.f - vi.A @ (self._basis @ z)
            residual[self._dofs] -= force
            whole = self._solve(residual[:, None])[:, 0]
            riesz, square = whole[self._dofs[best.unknowns]], float(residual @ whole)
        rho, omega, work = sqrt(max(square, 0.0) / gamma), sqrt(gamma) * best.norm, float(riesz @ best.load)
        terms = BoundTerms.from_work(rho, omega, best.kappa, work)
        value = self._relative(terms, lam, best.nu, sqrt(max(energy, 0.0)), sqrt(max(pressed, 0.0) / gamma))
        # a square of 1e-9 of its largest term has lost nine of sixteen digits; below, it is no bound
        resolved = min(terms.primal**2, terms.gap) >= 1e-9 * max(size_of_load, energy, pressed)
        return ErrorEstimate(value, vi is None and resolved and best.nu is not None and not best.eta, reduced)

    def _relative(self, bounds: BoundTerms, lam: Array, nu: Array | None, energy: float, pressed: float) -> float:
        """The largest of the bounds of u and λ and the estimate of λ in W, relative to u_N and λ_N, as in `bound`.

        `energy` and `pressed` are ‖u_N‖_A and the norm of Bᵀλ_N.
        """
        of_u = ratio(bounds.primal, energy)
        if not pressed > 0.0:
            return of_u
        # no digit is lost in a sum of squares: no factor of X_W is needed
        X = self._problem.W.matrix
        squares = (float(eta @ (X @ eta)) for eta in (np.zeros_like(lam) if nu is None else nu - lam, lam))
        in_W = ratio(*(sqrt(max(0.0, square)) for square in squares))
        return max(of_u, ratio(bounds.dual, pressed), in_W)


@dataclass(frozen=True)
class BoundState:
    """Start, assembly and factors that a bound at mu (d,) leaves to a solution there.

    The multiplier of the correction, which presses rows (m,), is that of the solution but for the residual.
    """

    mu: Array
    vi: VariationalInequality
    stiffness: CondensedStiffness
    pressed: Mask


class IncrementalModel:
    """A reduced model of all high-fidelity solutions that were added to it, without compression.

    Its space is spanned by the u(µ_i) and supremizers T(µ_i)ν_i (Haasdonk, Salomon and Wohlmuth 2012, §5), its cone by
    the ν_i: every λ(µ_i) without its part in the cone before it (line 9 of Algorithm 2 of Niakh et al. 2022), which
    makes the cone larger than that of the λ(µ_i). The ν_i (m×R) are the `generators`, of unit norm in W. Bounds are
    (ii) of `vibench.model.error_bounds`, at the cost of the mesh.
    """

    def __init__(self, problem: Problem, solver: active_set.HighFidelitySolver) -> None:
        self._problem, self._solver = problem, solver
        self._whitened, self._basis = np.zeros((problem.V.dim, 0)), np.zeros((problem.V.dim, 0))
        self.generators = np.zeros((problem.W.dim, 0))
        self._estimates: ContactEstimates | None = None
        self._last: tuple[bytes, ErrorEstimate] | None = None
        self._state: BoundState | None = None

    def add(self, vi: VariationalInequality, solution: active_set.HighFidelitySolution) -> str:
        """Add the solution of `vi`; returns what was less accurate than usual, "" if nothing."""
        V, W, size = self._problem.V, self._problem.W, self._whitened.shape[1]
        rest, note = subtract_cone_component(solution.lam, self.generators, W)
        new = [solution.u[:, None]]
        norm = float(W.norm(rest))
        # less than 1e-6 outside the cone may be what a solver left
        if norm > 1e-6 * float(W.norm(solution.lam)):
            new.append(supremizers(V, vi.B, rest[:, None]))
            self.generators = np.hstack([self.generators, rest[:, None] / norm])
        # orthonormalise u first, so that its supremizer cannot displace it
        for column in new:
            more = orthonormal_range(V.whiten(column), self._whitened)
            self._whitened = np.hstack([self._whitened, more])
        self._basis = np.hstack([self._basis, V.unwhiten(self._whitened[:, size:])])
        if self._estimates is None and ContactEstimates.supports(self._problem):
            self._estimates = ContactEstimates(self._problem, vi, self._solver.condensed(vi))
        self._last = self._state = None
        if self._estimates is not None:
            self._estimates.grow(vi, self._basis, self.generators)
        return note

    def solution(self, vi: VariationalInequality) -> tuple[Array, Array] | None:
        """The reduced solution u_N (n,) and λ_N ≥ 0 (m,) of `vi`; `None` if its program cannot be solved."""
        program = project(vi, self._basis, self.generators)
        # No active set is exact up to round-off where the generators are dependent, for instance.
        answer: ExactSolution | QPSolution = exact_solution(program) or solve_qp(program, "piqp", 1e-9)
        if answer.x is None or answer.alpha is None:
            return None
        return self._basis @ answer.x, self.generators @ np.maximum(answer.alpha, 0.0)

    def estimate(self, mu: Array) -> float | None:
        """A cheap estimate of `bound`, evaluated on the contact unknowns only; `None` where the problem has none."""
        return None if self._estimates is None else self._estimated(self._estimates, mu).value

    def _estimated(self, estimates: ContactEstimates, mu: Array) -> ErrorEstimate:
        """The estimate at mu (d,), cached: the next bound is usually at the parameter of the last estimate."""
        key = mu.tobytes()
        if self._last is None or self._last[0] != key:
            # a problem may assemble into the arrays of the last bound
            self._state = None
            self._last = key, estimates.estimate(mu)
        return self._last[1]

    def state(self, mu: Array) -> BoundState | None:
        """State that the last bound leaves to a solution at mu (d,), unless it was at another parameter."""
        return self._state if self._state is not None and np.array_equal(self._state.mu, mu) else None

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
        # the inequality and its reduced solution, those of the last estimate if it was there
        last, self._last, self._state = self._last, None, None
        if last is not None and last[0] == mu.tobytes() and (reduced := last[1].reduced) is not None:
            vi, z, lam = reduced
            u = self._basis @ z
        else:
            vi = checked_assembly(self._problem, mu)
            if (solved := self.solution(vi)) is None:
                return inf
            u, lam = solved
        energy = EnergyNorm(vi.A, self._solver.condensed(vi))
        if (corrected := find_correction(vi, energy, u, lam)) is None:
            return inf
        self._state = BoundState(mu, vi, energy.stiffness, corrected.nu > 0.0)
        terms = bound_terms(corrected, u, lam)
        of_u = ratio(terms.primal, energy.norm(u))
        pressed, W = corrected.contact.force_representer(lam).norm, self._problem.W
        if not pressed > 0.0:
            return of_u
        in_W = ratio(float(W.norm(corrected.nu - lam)), float(W.norm(lam)))
        return max(of_u, ratio(terms.dual, pressed), in_W)


@dataclass(frozen=True)
class Solved:
    """One solution of an adaptive training, the bound that led to it, and how many were evaluated before it.

    Estimates are among these. `fallback` says what was used besides the active set method, and what was less accurate
    in the growth of the model.
    """

    mu: Array
    solution: active_set.HighFidelitySolution
    seconds: Seconds
    bound: float
    evaluated: int
    fallback: str


class GreedyTrainer(Trainer):
    """High-fidelity solutions, and bounds of the model that they make, with the seconds of both.

    A solution where a bound was computed last starts from what that has left: its assembly and its factors of A are
    among the seconds of bounds. `solved` has the solutions in their order, `setup` the seconds that the first one took
    beyond its repetition, `selecting` those of bounds and of the growth of their model.
    """

    def __init__(self, problem: Problem, reference: ReferenceAssembly) -> None:
        self._problem, self._reference = problem, reference
        # one condensation serves a bound and the solution there
        self._solver = active_set.HighFidelitySolver(problem, condensing=True)
        self._model, self._evaluated = IncrementalModel(problem, self._solver), 0
        self.solved: list[Solved] = []
        self.setup = self.selecting = NO_TIME

    def solve(self, mu: Array, bound: float = float("nan")) -> None:
        """Assemble, solve, and let the model grow."""
        mu = np.array(mu, float)
        state = self._model.state(mu)

        def work() -> tuple[VariationalInequality, active_set.ActiveSetSolution]:
            if state is not None:
                with at_parameter(mu):
                    return state.vi, active_set.solve_unverified(state.vi, state.stiffness, state.pressed)
            vi = checked_assembly(self._problem, mu)
            return vi, self._solver.solve_assembled(mu, vi)

        (vi, unverified), seconds = timed(work)
        # verification and checks are not timed
        solution = self._solver.verify(mu, vi, unverified)
        self._reference.refuse_false_declarations(mu, vi)
        self._solver.remember(mu, solution)
        if not self.solved:
            # the first solution has no start: what it takes beyond its repetition, which has one, is the set-up
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
        """The estimate of the model, or `None`."""
        return self._evaluate(self._model.estimate, mu)

    def _evaluate(self, judge: Callable[[Array], T], mu: Array) -> T:
        with at_parameter(mu):
            value, seconds = timed(lambda: judge(np.array(mu, float)))
        self.selecting, self._evaluated = self.selecting + seconds, self._evaluated + int(value is not None)
        return value
