"""The solution of a QP solver, and the interface of solvers from plugins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality


@dataclass(frozen=True)
class QPSolution:
    """Unverified result of a solver: x (n,), multipliers α (m,) with A x + Bᵀα = f, its status and iteration count.

    `solve_qp` sets negative multipliers to zero; `negative` is the largest absolute value among them. It makes the
    status one printable line, and leaves out iterations that are no number of them.
    """

    x: Array | None
    alpha: Array | None
    solver_status: str
    iterations: int | None = None
    negative: float = 0.0


class QPSolver(Protocol):
    """A solver registered through the entry point group `vibench.qp_solvers`."""

    def __call__(self, program: VariationalInequality, accuracy: float) -> QPSolution:
        """Solve to a relative accuracy."""
