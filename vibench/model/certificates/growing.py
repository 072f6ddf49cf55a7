"""The model that an adaptive training grows with: all solutions so far, and an error bound at any parameter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from vibench.arrays import Array, Mask
from vibench.highfidelity.active_set import (
    ActiveSetSolution,
    HighFidelitySolution,
    HighFidelitySolver,
    solve_unverified,
)  # fmt: skip
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Trainer
from vibench.interfaces.validation import ReferenceAssembly, checked_assembly
from vibench.linalg.inner_product import orthonormal_range
from vibench.model.certificates.contact_estimates import ContactEstimates, Estimate
from vibench.model.error_bounds import find_correction, residual, terms
from vibench.model.errors import Energy, rieszes
from vibench.model.galerkin import project
from vibench.qp.exact import ExactSolution, exact_solution
from vibench.qp.scaling import ratio
from vibench.qp.solve import solve_qp
from vibench.qp.verification import QPSolution
from vibench.reduction.cone_parts import part_in_cone
from vibench.reduction.supremizers import supremizers
from vibench.timing import NO_TIME, Seconds, timed

T = TypeVar("T")


@dataclass(frozen=True)
class Bounded:
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


class GrowingModel:
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
        self._last: tuple[bytes, Estimate] | None = None
        self._bounded: Bounded | None = None

    def add(self, vi: VariationalInequality, solution: HighFidelitySolution) -> str:
        """Add the solution of `vi`; returns what was less accurate than usual, "" if nothing."""
        V, W, size = self._problem.V, self._problem.W, self._whitened.shape[1]
        part, note = part_in_cone(solution.lam, self.generators, W)
        new, rest = [solution.u[:, None]], solution.lam - part
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

    def _estimated(self, estimates: ContactEstimates, mu: Array) -> Estimate:
        """The estimate at mu (d,); the last one is kept, which is what a bound is asked for next."""
        key = mu.tobytes()
        if self._last is None or self._last[0] != key:
            self._bounded = None  # a problem may assemble into the arrays of that
            self._last = key, estimates.at(mu)
        return self._last[1]

    def bounded(self, mu: Array) -> Bounded | None:
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
        energy = Energy(vi.A, self._solver.condensed(vi))
        corrected = find_correction(vi, energy, u, lam)
        if corrected is None:
            return float("inf")
        self._bounded = Bounded(mu, vi, energy.stiffness, corrected.nu > 0.0)
        (riesz,) = rieszes([energy], [residual(vi, u, lam)])
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


class GrowingTrainer(Trainer):
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
        self._model, self._evaluated = GrowingModel(problem, self._solver), 0
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
