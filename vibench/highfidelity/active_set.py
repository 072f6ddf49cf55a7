"""High-fidelity solutions of the variational inequality (7): a primal–dual active set method, verified."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Mask
from vibench.errors import NumericalError
from vibench.highfidelity.kkt_systems import ActiveSystem, Stiffness
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly
from vibench.linalg.inner_product import check_symmetric
from vibench.linalg.schur_complement import Pattern
from vibench.qp import verification
from vibench.qp.solve import solve_qp

ACCURACY = 1e-10
"""Relative KKT accuracy of every snapshot."""

MAX_ITERATIONS = 100
"""Systems tried at most, or one per constraint where there are more: the contact set may move node by node."""

FALLBACK_SOLVER = "piqp"


@dataclass(frozen=True)
class HighFidelitySolution:
    """Solution of (7) at one parameter.

    Attributes
    ----------
    u, lam
        Displacement (n,) and multiplier (m,), zero exactly off the contact set.
    fallback
        "" where the active set method found it alone; otherwise what had to help.
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
    """Solves one problem at many parameters, each from the contact set of the nearest solved before.

    The primal–dual active set method (Hintermüller, Ito, Kunisch 2002) solves the equality-constrained system of the
    current active set until the set repeats itself; a set that cycles is replaced by that of an interior-point
    solution, and the method goes on from there. Its answer has exact zeros off the active set. Systems are condensed
    on the constrained unknowns where they are few, by one factorisation of all others; the order of elimination is
    found once, and a stiffness that does not depend on the parameter is factorised once.

    Parameters
    ----------
    problem
        Its declarations `constant` and `contact_dofs` decide what is done once.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._touched = problem.contact_dofs if problem.contact_dofs is not None else np.zeros(0, dtype=np.intp)
        self._pattern: Pattern | None = None
        self._system: Stiffness | None = None
        self._width = np.maximum(problem.parameters.upper - problem.parameters.lower, np.finfo(float).tiny)
        self._solved: list[Array] = []
        self._active: list[Mask] = []

    def solve(self, mu: Array) -> HighFidelitySolution:
        """Assemble and solve at mu (d,).

        Raises
        ------
        NumericalError
            If the assembly is wrong, the solution does not reach `ACCURACY`, or the problem refuses it; or if B touches
            unknowns that the problem does not declare as its contact.
        """
        return self.solve_assembled(mu, checked_assembly(self._problem, mu))

    def solve_assembled(self, mu: Array, vi: VariationalInequality) -> HighFidelitySolution:
        """Solve at mu (d,) what was assembled there."""
        found = solve_high_fidelity(vi, self._stiffness(vi), self._nearest(mu))
        reason = self._problem.refuse(mu, found.u, found.lam)
        if reason:
            raise NumericalError(f"at mu = {mu.tolist()}: {reason}")
        self._solved.append(mu)
        self._active.append(found.lam > 0.0)
        return found

    def check_coercive(self, mu: Array, vi: VariationalInequality) -> None:
        """Refuse a stiffness that is not symmetric positive definite.

        Parameters
        ----------
        mu
            Where (d,).
        vi
            What was solved last: most of the work has been done for that.

        Raises
        ------
        NumericalError
            Saying at which mu, and what it is not.
        """
        name = f"A at mu = {mu.tolist()}"
        check_symmetric(vi.A, name)
        (self._system or self._stiffness(vi)).check_definite(name)

    def _nearest(self, mu: Array) -> Mask | None:
        """Contact set of the solved parameter that is nearest, the box of parameters taken for a cube."""
        if not self._active:
            return None
        distances = np.linalg.norm((np.array(self._solved) - mu) / self._width, axis=1)
        return self._active[int(np.argmin(distances))]

    def _stiffness(self, vi: VariationalInequality) -> Stiffness:
        touched = np.zeros(vi.A.shape[0], dtype=bool)
        touched[sp.csr_array(vi.B).indices] = True
        touched[self._touched] = False
        outside = np.flatnonzero(touched)
        if len(outside) and self._problem.contact_dofs is not None:
            raise NumericalError(
                f"B touches {len(outside)} unknowns outside the declared contact_dofs, the first is {outside[0]}"
            )
        if len(outside):
            self._touched, self._pattern = np.union1d(self._touched, outside), None
        if self._pattern is None:
            self._pattern, self._system = Pattern.of(vi.A, self._touched), None
        if self._system is None or "A" not in self._problem.constant:
            self._system = Stiffness(vi.A, self._pattern, reused="A" in self._problem.constant)
        return self._system


def solve_high_fidelity(
    vi: VariationalInequality, stiffness: Stiffness | None = None, start: Mask | None = None
) -> HighFidelitySolution:
    """Solve one variational inequality to `ACCURACY`; see `HighFidelitySolver`.

    Parameters
    ----------
    vi
        Sparse A, B and vectors f, g at one parameter.
    stiffness
        Its A prepared, where that has been done already.
    start
        Constraints (m,) that are active at first; none by default.

    Raises
    ------
    NumericalError
        If neither the active set method nor its fallback reaches `ACCURACY`.
    """
    system = (stiffness or Stiffness(vi.A)).system(vi)
    nothing = np.zeros(vi.B.shape[0], dtype=bool)
    found = None if start is None else _active_set_iterations(system, start)
    found = found or _active_set_iterations(system, nothing)
    fallback = ""
    if found is None:
        answer = solve_qp(vi, FALLBACK_SOLVER, ACCURACY)
        if answer.alpha is None or not np.all(np.isfinite(answer.alpha)):
            raise NumericalError(f"the high-fidelity problem was not solved: {answer.solver_status}")
        found = _active_set_iterations(system, answer.alpha > 1e-8 * np.max(answer.alpha, initial=0.0))
        fallback = f"the active set cycled; first guess by {FALLBACK_SOLVER}"
    if found is None:
        raise NumericalError("no active set solves the high-fidelity problem; is it feasible?")
    kept, lam, iterations = found
    u = system.expand(kept)
    residuals = verification.kkt_residuals(vi, u, lam)
    if residuals.dual > 0.5 * ACCURACY:  # what a large rigid displacement leaves
        u = u + system.settle(vi.f - vi.A @ u - vi.B.T @ lam)
        residuals = verification.kkt_residuals(vi, u, lam)
    if not residuals.worst <= ACCURACY:
        raise NumericalError(f"the high-fidelity solution has residual {residuals.worst:.1e}, above {ACCURACY:.0e}")
    return HighFidelitySolution(u, lam, fallback, iterations, residuals)


def _active_set_iterations(system: ActiveSystem, active: Mask) -> tuple[Array, Array, int] | None:
    """Run the primal–dual active set method from a first guess (m,): u (c,), λ (m,) and iterations.

    `None` if the sets repeat themselves without an answer, or one of them has dependent constraints.
    """
    seen: set[bytes] = set()
    for iteration in range(1, max(MAX_ITERATIONS, len(active)) + 1):
        try:
            u, lam = system.solve_active(np.flatnonzero(active))
        except (RuntimeError, np.linalg.LinAlgError):  # an exactly singular system
            return None
        scale = np.max(np.abs(lam), initial=0.0)
        violated = ~active & (system.B @ u - system.g > 1e-14 * np.max(np.abs(system.g), initial=0.0))
        kept = active & (lam > 1e-14 * scale)
        following = violated | kept
        if np.array_equal(following, active):
            return u, lam, iteration
        if following.tobytes() in seen:
            return None
        seen.add(following.tobytes())
        active = following
    return None
