"""Settings of the QP solvers: tolerances for an accuracy, and where each solver reports its status.

A new solver of qpsolvers is one entry here. Accuracies are relative. `solve_qp` scales the data so that absolute
tolerances are equivalent. The duality gap has no natural scale; its absolute tolerance is far below the relative one.
Tolerances are tighter than the accuracy, because solvers measure residuals in norms and scalings of their own: those of
qpsolvers come out up to 1.4 times below ours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # completion asks for the list of solvers, which needs no NumPy
    from vibench.arrays import Array


@dataclass(frozen=True)
class SolverSettings:
    """Settings of one solver; `status` and `iterations` are paths into `solution.extras`, "" where there are none."""

    # From a relative accuracy to keyword arguments.
    at: Callable[[float], dict[str, Any]]
    status: str = ""
    iterations: str = ""
    # Keyword arguments for a warm start from x (n,), α (m,), if the solver has one.
    start: Callable[[Array, Array], Mapping[str, Any]] | None = None
    # Bounds of the unknowns take some solvers less time than rows of a matrix.
    bounds: bool = False

    def report(self, solution: Any) -> tuple[str, int | None]:
        """Status as the solver reports it, and its number of iterations."""
        status = _follow(solution.extras, self.status)
        text = ("found" if solution.found else "not found") if status is None else str(status)
        count = _follow(solution.extras, self.iterations)
        # First, because the tests for abstract classes below cost as much as a small program.
        if isinstance(count, int):
            return text, count
        while isinstance(count, Sequence) or getattr(count, "shape", None):
            count = count[0]
        return text, None if count is None else int(count)


def _follow(extras: Mapping[str, Any], path: str) -> Any:
    value: Any = extras
    for step in path.split("."):
        value = value.get(step) if isinstance(value, (dict, Mapping)) else getattr(value, step, None)
    return value


def _proxqp_start(x: Array, alpha: Array) -> dict[str, Any]:
    from proxsuite import proxqp  # noqa: PLC0415  an optional solver

    # Without `initial_guess` ProxQP would start from a guess of its own.
    return {"initvals": x, "z": alpha, "initial_guess": proxqp.InitialGuess.WARM_START}


def _primal_start(x: Array, _: Array) -> dict[str, Any]:
    return {"initvals": x}


def _duality_gap(accuracy: float) -> dict[str, Any]:
    gap = {"eps_duality_gap_abs": 5e-4 * accuracy, "eps_duality_gap_rel": 0.05 * accuracy}
    return {"eps_abs": 0.05 * accuracy, "check_duality_gap": True, **gap}


def _conic(accuracy: float) -> dict[str, Any]:
    return dict.fromkeys(("abstol", "reltol", "feastol"), 0.05 * accuracy)


SETTINGS: Mapping[str, SolverSettings] = {
    "piqp": SolverSettings(
        lambda accuracy: {"eps_rel": 0.05 * accuracy, "max_iter": 500, **_duality_gap(accuracy)},
        "info.status", "info.iter", bounds=True,
    ),
    "proxqp": SolverSettings(
        lambda accuracy: {"max_iter": 1000, **_duality_gap(accuracy)},
        "info.status", "info.iter", start=_proxqp_start,
    ),
    # A first-order method, whose iteration limit trades time for accuracy.
    "osqp": SolverSettings(
        # Programs without their load take it up to 25,000 steps at 1e-8.
        lambda accuracy: {"eps_abs": 0.05 * accuracy, "eps_rel": 0.15 * accuracy, "max_iter": 50_000},
        "info.status", "info.iter", start=_primal_start,
    ),
    "clarabel": SolverSettings(
        lambda accuracy: dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 0.05 * accuracy), "status"
    ),
    "daqp": SolverSettings(
        lambda accuracy: {"primal_tol": 0.005 * accuracy, "dual_tol": 0.005 * accuracy, "zero_tol": 1e-14},
        iterations="iterations", start=_primal_start,
    ),
    "quadprog": SolverSettings(lambda _: {}, iterations="iterations"),
    # HiGHS accepts no smaller tolerance than 1e-10.
    "highs": SolverSettings(
        lambda accuracy: dict.fromkeys(
            ("primal_feasibility_tolerance", "dual_feasibility_tolerance"), max(0.05 * accuracy, 1e-10)
        )
    ),
    "scs": SolverSettings(
        lambda accuracy: {"eps_abs": 0.05 * accuracy, "eps_rel": 0.05 * accuracy, "max_iters": 20_000}
    ),
    "cvxopt": SolverSettings(_conic, iterations="iterations"),
    "ecos": SolverSettings(_conic),
}  # fmt: skip
