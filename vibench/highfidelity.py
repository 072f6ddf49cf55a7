"""High-fidelity solutions of the variational inequality (7): a primal–dual active set method, verified."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from vibench import qp
from vibench.arrays import Array, Indices, Mask
from vibench.errors import NumericalError
from vibench.problem import Problem, VariationalInequality, checked_assembly
from vibench.space import InnerProduct

ACCURACY = 1e-10
"""Relative KKT accuracy of every snapshot."""

CONDENSED_SHARE = 10
"""Systems are condensed on the multipliers where there are this many times more displacements."""

MAX_ITERATIONS = 100
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
    residuals: qp.Residuals


class Solver:
    """Solves one problem at many parameters; a stiffness that does not depend on them is factorised once.

    The primal–dual active set method (Hintermüller, Ito, Kunisch 2002) solves the equality-constrained system of the
    current active set until the set repeats itself; a set that cycles is replaced by that of an interior-point
    solution, and the method goes on from there. Its answer has exact zeros off the active set.

    Parameters
    ----------
    problem
        Its declaration `constant` decides how the systems are solved: condensed on the multipliers where A is constant
        and they are few, as sparse saddle-point systems elsewhere.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._stiffness: InnerProduct | None = None

    def solve(self, mu: Array) -> HighFidelitySolution:
        """Assemble and solve at mu (d,).

        Raises
        ------
        NumericalError
            If the assembly is wrong, the solution does not reach `ACCURACY`, or the problem refuses it.
        """
        vi = checked_assembly(self._problem, mu)
        few = CONDENSED_SHARE * vi.B.shape[0] <= vi.B.shape[1]
        if few and "A" in self._problem.constant and self._stiffness is None:
            self._stiffness = InnerProduct(vi.A)
        found = solve(vi, self._stiffness)
        reason = self._problem.refuse(mu, found.u, found.lam)
        if reason:
            raise NumericalError(f"at mu = {mu.tolist()}: {reason}")
        return found


def solve(vi: VariationalInequality, stiffness: InnerProduct | None = None) -> HighFidelitySolution:
    """Solve one variational inequality to `ACCURACY`; see `Solver`.

    Parameters
    ----------
    vi
        Sparse A, B and vectors f, g at one parameter.
    stiffness
        A factorised as an inner product, where that has been done already.

    Raises
    ------
    NumericalError
        If neither the active set method nor its fallback reaches `ACCURACY`.
    """
    solve_active = partial(_saddle_point, vi) if stiffness is None else _condensed(vi, stiffness)
    found = _active_set_iterations(vi, np.zeros(vi.B.shape[0], dtype=bool), solve_active)
    fallback = ""
    if found is None:
        answer = qp.solve(vi, FALLBACK_SOLVER, ACCURACY)
        if answer.alpha is None or not np.all(np.isfinite(answer.alpha)):
            raise NumericalError(f"the high-fidelity problem was not solved: {answer.solver_status}")
        found = _active_set_iterations(vi, answer.alpha > 1e-8 * np.max(answer.alpha, initial=0.0), solve_active)
        fallback = f"the active set cycled; first guess by {FALLBACK_SOLVER}"
    if found is None:
        raise NumericalError("no active set solves the high-fidelity problem; is it feasible?")
    u, lam, iterations = found
    residuals = qp.residuals(vi, u, lam)
    if not residuals.worst <= ACCURACY:
        raise NumericalError(f"the high-fidelity solution has residual {residuals.worst:.1e}, above {ACCURACY:.0e}")
    return HighFidelitySolution(u, lam, fallback, iterations, residuals)


SolveActive = Callable[[Indices], tuple[Array, Array]]
"""From the active constraints: u (n,) and λ (m,) with these as equalities and no other multiplier."""


def _active_set_iterations(
    vi: VariationalInequality, active: Mask, solve_active: SolveActive
) -> tuple[Array, Array, int] | None:
    """u, λ and iterations of the primal–dual active set method from a first guess (m,).

    `None` if the sets repeat themselves without an answer, or one of them has dependent constraints.
    """
    seen: set[bytes] = set()
    for iteration in range(1, MAX_ITERATIONS + 1):
        try:
            u, lam = solve_active(np.flatnonzero(active))
        except (RuntimeError, np.linalg.LinAlgError):  # an exactly singular system
            return None
        scale = np.max(np.abs(lam), initial=0.0)
        violated = ~active & (vi.B @ u - vi.g > 1e-14 * np.max(np.abs(vi.g), initial=0.0))
        kept = active & (lam > 1e-14 * scale)
        following = violated | kept
        if np.array_equal(following, active):
            return u, lam, iteration
        if following.tobytes() in seen:
            return None
        seen.add(following.tobytes())
        active = following
    return None


def _saddle_point(vi: VariationalInequality, active: Indices) -> tuple[Array, Array]:
    """Solution for an active set by one sparse factorisation, refined once."""
    n, k = vi.A.shape[0], len(active)
    rows = sp.csr_array(vi.B)[active]
    matrix = sp.csc_array(sp.block_array([[vi.A, rows.T], [rows, None]])) if k else sp.csc_array(vi.A)
    right = np.concatenate([vi.f, vi.g[active]])
    factor = splu(matrix)
    solution = factor.solve(right)
    solution += factor.solve(right - matrix @ solution)
    lam = np.zeros(vi.B.shape[0])
    lam[active] = solution[n:]
    return solution[:n], lam


def _condensed(vi: VariationalInequality, stiffness: InnerProduct) -> SolveActive:
    """Solutions for active sets from B A⁻¹Bᵀ alone, formed once with the factor of A."""
    free = stiffness.riesz(vi.f)
    responses = stiffness.riesz(vi.B.T.toarray())
    compliance = np.asarray(vi.B @ responses)
    excess = vi.B @ free - vi.g

    def solve_active(active: Indices) -> tuple[Array, Array]:
        lam = np.zeros(len(vi.g))
        if len(active):
            block = scipy.linalg.cho_factor(compliance[np.ix_(active, active)])
            lam[active] = scipy.linalg.cho_solve(block, excess[active])
            lam[active] += scipy.linalg.cho_solve(block, (excess - compliance @ lam)[active])
        return free - responses @ lam, lam

    return solve_active
