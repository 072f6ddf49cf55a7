"""Settings of the QP solvers: keyword arguments for an accuracy, and where each solver reports its status.

A new solver of qpsolvers is one entry here. Accuracies are relative. `solve_qp` scales the data so that absolute
tolerances are equivalent. The duality gap has no natural scale; its absolute tolerance is far below the relative one.
Tolerances are tighter than the accuracy, because solvers measure residuals in norms and scalings of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vibench.arrays import Array


@dataclass(frozen=True)
class SolverSettings:
    """Settings of one solver.

    Attributes
    ----------
    settings
        Keyword arguments for an accuracy.
    start
        Keyword arguments for a warm start from x (n,), α (m,), if the solver has one.
    status, iterations
        Paths into `solution.extras`, as "info.status"; "" where the solver reports none.
    """

    settings: Callable[[float], Mapping[str, Any]]
    status: str = ""
    iterations: str = ""
    start: Callable[[Array, Array], Mapping[str, Any]] | None = None

    def report(self, solution: Any) -> tuple[str, int | None]:
        """Status as the solver reports it, and its number of iterations."""
        status = _follow(solution.extras, self.status)
        text = ("found" if solution.found else "not found") if status is None else str(status)
        count = _follow(solution.extras, self.iterations)
        return text, None if count is None else int(np.ravel(count)[0])


def _follow(extras: Mapping[str, Any], path: str) -> Any:
    value: Any = extras
    for step in path.split(".") if path else []:
        value = value.get(step) if isinstance(value, Mapping) else getattr(value, step, None)
        if value is None:
            return None
    return value if path else None


def _proxqp_start(x: Array, alpha: Array) -> dict[str, Any]:
    """A primal and dual warm start; without `initial_guess` ProxQP would start from a guess of its own."""
    from proxsuite import proxqp  # noqa: PLC0415  an optional solver

    return {"initvals": x, "z": alpha, "initial_guess": proxqp.InitialGuess.WARM_START}


SETTINGS: Mapping[str, SolverSettings] = {
    "piqp": SolverSettings(
        lambda accuracy: {
            "eps_abs": 0.1 * accuracy,
            "eps_rel": 0.1 * accuracy,
            "max_iter": 500,
            "check_duality_gap": True,
            "eps_duality_gap_abs": 1e-3 * accuracy,
            "eps_duality_gap_rel": 0.1 * accuracy,
        },
        status="info.status",
        iterations="info.iter",
    ),
    "proxqp": SolverSettings(
        lambda accuracy: {
            "eps_abs": 0.1 * accuracy,
            "eps_rel": 0.0,
            "max_iter": 1000,
            "check_duality_gap": True,
            "eps_duality_gap_abs": 1e-3 * accuracy,
            "eps_duality_gap_rel": 0.1 * accuracy,
        },
        status="info.status",
        iterations="info.iter",
        start=_proxqp_start,
    ),
    "osqp": SolverSettings(  # a first-order method; the iteration limit trades time for accuracy
        lambda accuracy: {"eps_abs": 0.1 * accuracy, "eps_rel": 0.3 * accuracy, "max_iter": 10_000},
        status="info.status",
        iterations="info.iter",
        start=lambda x, _: {"initvals": x},
    ),
    "clarabel": SolverSettings(
        lambda accuracy: {"tol_gap_abs": 0.1 * accuracy, "tol_gap_rel": 0.1 * accuracy, "tol_feas": 0.1 * accuracy},
        status="status",
    ),
    "daqp": SolverSettings(
        lambda accuracy: {"primal_tol": 0.01 * accuracy, "dual_tol": 0.01 * accuracy, "zero_tol": 1e-14},
        iterations="iterations",
        start=lambda x, _: {"initvals": x},
    ),
    "quadprog": SolverSettings(lambda _: {}, iterations="iterations"),
    "highs": SolverSettings(
        lambda accuracy: {
            "primal_feasibility_tolerance": max(0.1 * accuracy, 1e-10),
            "dual_feasibility_tolerance": max(0.1 * accuracy, 1e-10),
        },
    ),
    "scs": SolverSettings(lambda accuracy: {"eps_abs": 0.1 * accuracy, "eps_rel": 0.1 * accuracy, "max_iters": 20_000}),
    "cvxopt": SolverSettings(
        lambda accuracy: {"abstol": 0.1 * accuracy, "reltol": 0.1 * accuracy, "feastol": 0.1 * accuracy},
        iterations="iterations",
    ),
    "ecos": SolverSettings(
        lambda accuracy: {"abstol": 0.1 * accuracy, "reltol": 0.1 * accuracy, "feastol": 0.1 * accuracy},
    ),
}


def settings_for(solver: str, accuracy: float) -> dict[str, Any]:
    """Keyword arguments of `solver` for a relative accuracy."""
    return dict(SETTINGS[solver].settings(accuracy))


def start_for(solver: str, x: Array, alpha: Array) -> dict[str, Any]:
    """Keyword arguments of `solver` for a warm start from x (n,), α (m,); none if it has no warm start."""
    start = SETTINGS[solver].start
    return {} if start is None else dict(start(x, alpha))
