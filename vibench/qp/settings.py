"""Settings of the QP solvers: tolerances for an accuracy, and where each solver reports its status.

A new solver of qpsolvers is one entry here. Accuracies are relative. `solve_qp` scales the data so that absolute
tolerances are equivalent. The duality gap has no natural scale; its absolute tolerance is far below the relative one.
Tolerances are tighter than the accuracy, because solvers measure residuals in norms and scalings of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the list of solvers, which completion asks for, needs no NumPy
    from vibench.arrays import Array


@dataclass(frozen=True)
class SolverSettings:
    """Settings of one solver.

    Attributes
    ----------
    tolerances
        Keyword arguments that are multiples of the accuracy, with their factors.
    fixed
        Other keyword arguments.
    status, iterations
        Paths into `solution.extras`, as "info.status"; "" where the solver reports none.
    start
        Keyword arguments for a warm start from x (n,), α (m,), if the solver has one.
    smallest
        The smallest tolerance that the solver accepts.
    bounds
        Whether bounds of the unknowns take it less time than rows of a matrix.
    """

    tolerances: Mapping[str, float]
    fixed: Mapping[str, Any] = field(default_factory=dict)
    status: str = ""
    iterations: str = ""
    start: Callable[[Array, Array], Mapping[str, Any]] | None = None
    smallest: float = 0.0
    bounds: bool = False

    def at(self, accuracy: float) -> dict[str, Any]:
        """Keyword arguments for a relative accuracy."""
        scaled = {name: max(factor * accuracy, self.smallest) for name, factor in self.tolerances.items()}
        return {**scaled, **self.fixed}

    def report(self, solution: Any) -> tuple[str, int | None]:
        """Status as the solver reports it, and its number of iterations."""
        status = _follow(solution.extras, self.status)
        text = ("found" if solution.found else "not found") if status is None else str(status)
        count = _follow(solution.extras, self.iterations)
        if isinstance(count, int):  # tests for abstract classes take longer than a small program leaves
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
    """A primal and dual warm start; without `initial_guess` ProxQP would start from a guess of its own."""
    from proxsuite import proxqp  # noqa: PLC0415  an optional solver

    return {"initvals": x, "z": alpha, "initial_guess": proxqp.InitialGuess.WARM_START}


def _primal_start(x: Array, _: Array) -> dict[str, Any]:
    return {"initvals": x}


_EPS = {"eps_abs": 0.1, "eps_rel": 0.1}
_DUALITY_GAP = {"eps_duality_gap_abs": 1e-3, "eps_duality_gap_rel": 0.1}
_CONIC = {"abstol": 0.1, "reltol": 0.1, "feastol": 0.1}


SETTINGS: Mapping[str, SolverSettings] = {
    "piqp": SolverSettings(
        _EPS | _DUALITY_GAP, {"max_iter": 500, "check_duality_gap": True}, "info.status", "info.iter", bounds=True
    ),
    "proxqp": SolverSettings(
        {"eps_abs": 0.1} | _DUALITY_GAP,
        {"eps_rel": 0.0, "max_iter": 1000, "check_duality_gap": True},
        "info.status",
        "info.iter",
        start=_proxqp_start,
    ),
    "osqp": SolverSettings(  # a first-order method; the iteration limit trades time for accuracy
        {"eps_abs": 0.1, "eps_rel": 0.3}, {"max_iter": 10_000}, "info.status", "info.iter", start=_primal_start
    ),
    "clarabel": SolverSettings({"tol_gap_abs": 0.1, "tol_gap_rel": 0.1, "tol_feas": 0.1}, status="status"),
    "daqp": SolverSettings(
        {"primal_tol": 0.01, "dual_tol": 0.01},
        {"zero_tol": 1e-14},
        iterations="iterations",
        start=_primal_start,
        bounds=True,
    ),
    "quadprog": SolverSettings({}, iterations="iterations"),
    "highs": SolverSettings({"primal_feasibility_tolerance": 0.1, "dual_feasibility_tolerance": 0.1}, smallest=1e-10),
    "scs": SolverSettings(_EPS, {"max_iters": 20_000}),
    "cvxopt": SolverSettings(_CONIC, iterations="iterations"),
    "ecos": SolverSettings(_CONIC),
}
