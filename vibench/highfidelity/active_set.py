"""High-fidelity solutions of the variational inequality (7) by a verified primal–dual active set method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Mask
from vibench.errors import NumericalError
from vibench.highfidelity.kkt_systems import ActiveSetSystem, CondensedStiffness
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly
from vibench.linalg.inner_product import check_symmetric
from vibench.linalg.schur_complement import EliminationPattern
from vibench.qp import verification
from vibench.qp.solve import solve_qp

ACCURACY = 1e-10
"""Relative KKT accuracy of every snapshot."""

MAX_ITERATIONS = 100
"""Largest number of iterations, or the number of constraints if larger: the contact set may move node by node."""

FALLBACK_SOLVER = "piqp"


@dataclass(frozen=True)
class HighFidelitySolution:
    """Solution of (7) at one parameter.

    Attributes
    ----------
    u, lam
        Displacement (n,) and multiplier (m,); the multiplier is exactly zero off the contact set.
    fallback
        What was used besides the active set method; "" if nothing.
    iterations
        Linear systems solved by the active set method.
    residuals
        Relative KKT residuals, recomputed.
    """

    u: Array
    lam: Array
    fallback: str
    iterations: int
    residuals: verification.Residuals


class HighFidelitySolver:
    """Solves one problem at many parameters, starting each from the contact set of the nearest parameter solved so far.

    The primal–dual active set method (Hintermüller, Ito, Kunisch 2002) solves the equality-constrained system of the
    current active set until the set no longer changes. If the sets cycle, the method restarts from the active set of an
    interior-point solution; it never returns that solution itself, since greedy cones need multipliers with exact zeros
    off the contact set. Systems are condensed on the constrained unknowns where these are few. The elimination order is
    computed once, and a stiffness that does not depend on the parameter is factorised once.

    Parameters
    ----------
    problem
        Its declarations `constant` and `contact_dofs` decide what is computed once.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._constrained = problem.contact_dofs if problem.contact_dofs is not None else np.zeros(0, dtype=np.intp)
        self._pattern: EliminationPattern | None = None
        self._stiffness: CondensedStiffness | None = None
        self._width = np.maximum(problem.parameters.upper - problem.parameters.lower, np.finfo(float).tiny)
        self._solved: list[Array] = []
        self._active: list[Mask] = []

    def solve(self, mu: Array) -> HighFidelitySolution:
        """Assemble and solve at mu (d,).

        Raises
        ------
        NumericalError
            If the assembly is invalid, the solution does not reach `ACCURACY`, the problem refuses it, or B touches
            unknowns outside the declared `contact_dofs`.
        """
        solution = self.solve_assembled(mu, checked_assembly(self._problem, mu))
        self.remember(mu, solution)
        return solution

    def solve_assembled(self, mu: Array, vi: VariationalInequality) -> HighFidelitySolution:
        """Solve the variational inequality `vi` assembled at mu (d,); unless remembered, no other starts from it."""
        solution = solve_high_fidelity(vi, self.condensed(vi), self._nearest_contact_set(mu))
        reason = self._problem.refuse(mu, solution.u, solution.lam)
        if reason:
            raise NumericalError(f"at mu = {mu.tolist()}: {reason}")
        return solution

    def remember(self, mu: Array, solution: HighFidelitySolution) -> None:
        """Let later solutions start from the contact set of this one, at mu (d,)."""
        self._solved.append(mu)
        self._active.append(solution.lam > 0.0)

    def check_coercive(self, mu: Array, vi: VariationalInequality) -> None:
        """Refuse a stiffness that is not symmetric positive definite.

        The factorisation is reused: `vi` has to be the variational inequality solved last, at mu (d,).

        Raises
        ------
        NumericalError
            Naming mu and the missing property.
        """
        name = f"A at mu = {mu.tolist()}"
        check_symmetric(vi.A, name)
        (self._stiffness or self.condensed(vi)).check_definite(name)

    def _nearest_contact_set(self, mu: Array) -> Mask | None:
        """Contact set of the nearest parameter solved so far; distances are relative to the widths of the box."""
        if not self._active:
            return None
        distances = np.linalg.norm((np.array(self._solved) - mu) / self._width, axis=1)
        return self._active[int(np.argmin(distances))]

    def condensed(self, vi: VariationalInequality) -> CondensedStiffness:
        """The stiffness of `vi` condensed on the constrained unknowns; one object where A is constant."""
        outside = np.setdiff1d(sp.csr_array(vi.B).indices, self._constrained)
        if len(outside):
            if self._problem.contact_dofs is not None:
                undeclared = f"{len(outside)} unknowns outside the declared contact_dofs, the first is {outside[0]}"
                raise NumericalError(f"B touches {undeclared}")
            self._constrained, self._pattern = np.union1d(self._constrained, outside), None
        if self._pattern is None:
            self._pattern, self._stiffness = EliminationPattern.of(vi.A, self._constrained), None
        if self._stiffness is None or "A" not in self._problem.constant:
            self._stiffness = CondensedStiffness(vi.A, self._pattern, reused="A" in self._problem.constant)
        return self._stiffness


def solve_high_fidelity(
    vi: VariationalInequality, stiffness: CondensedStiffness | None = None, start: Mask | None = None
) -> HighFidelitySolution:
    """Solve one variational inequality to `ACCURACY`; see `HighFidelitySolver`.

    Parameters
    ----------
    vi
        Sparse A, B and vectors f, g at one parameter.
    stiffness
        A condensed already; by default it is used as it is.
    start
        Initial active set (m,); empty by default.

    Raises
    ------
    NumericalError
        If neither the active set method nor its fallback reaches `ACCURACY`.
    """
    system = (stiffness or CondensedStiffness(vi.A)).active_set_system(vi)
    empty = np.zeros(vi.B.shape[0], dtype=bool)
    settled = None if start is None else active_set_iterations(system, start)
    settled = settled or active_set_iterations(system, empty)
    fallback = ""
    if settled is None:
        answer = solve_qp(vi, FALLBACK_SOLVER, ACCURACY)
        if answer.alpha is None or not np.all(np.isfinite(answer.alpha)):
            raise NumericalError(f"the high-fidelity problem was not solved: {answer.solver_status}")
        settled = active_set_iterations(system, answer.alpha > 1e-8 * np.max(answer.alpha, initial=0.0))
        fallback = f"the active set cycled; first guess by {FALLBACK_SOLVER}"
    if settled is None:
        raise NumericalError("no active set solves the high-fidelity problem; is it feasible?")
    u_retained, lam, iterations = settled
    u = system.recover(u_retained)
    residuals = verification.kkt_residuals(vi, u, lam)
    if residuals.dual > 0.5 * ACCURACY:  # a large rigid displacement amplifies round-off in the eliminated unknowns
        u = u + system.correct_eliminated(vi.f - vi.A @ u - vi.B.T @ lam)
        residuals = verification.kkt_residuals(vi, u, lam)
    if not residuals.worst <= ACCURACY:
        raise NumericalError(f"the high-fidelity solution has residual {residuals.worst:.1e}, above {ACCURACY:.0e}")
    return HighFidelitySolution(u, lam, fallback, iterations, residuals)


def active_set_iterations(system: ActiveSetSystem, active: Mask) -> tuple[Array, Array, int] | None:
    """Run the primal–dual active set method from an initial active set (m,): u (c,), λ (m,) and iterations.

    `None` if the sets cycle or one of them has linearly dependent constraints.
    """
    seen: set[bytes] = set()
    for iteration in range(1, max(MAX_ITERATIONS, len(active)) + 1):
        try:
            u, lam = system.solve_active(np.flatnonzero(active))
        except (RuntimeError, np.linalg.LinAlgError):  # an exactly singular system
            return None
        scale = np.max(np.abs(lam), initial=0.0)
        violated = ~active & (system.B @ u - system.g > 1e-14 * np.max(np.abs(system.g), initial=0.0))
        in_contact = active & (lam > 1e-14 * scale)
        following = violated | in_contact
        if np.array_equal(following, active):
            return u, lam, iteration
        if following.tobytes() in seen:
            return None
        seen.add(following.tobytes())
        active = following
    return None
