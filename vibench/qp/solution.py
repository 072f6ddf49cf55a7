"""What a QP solver returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality


@dataclass(frozen=True)
class QPSolution:
    """What a solver claims: x (n,), multipliers α (m,) with A x + Bᵀα = f, its own status and iteration count.

    `solve` sets negative multipliers to zero; `negative` is how negative the worst of them was.
    """

    x: Array | None
    alpha: Array | None
    solver_status: str
    iterations: int | None = None
    negative: float = 0.0


class QPSolver(Protocol):
    """What the entry point group `vibench.qp_solvers` registers: a solver qpsolvers does not have."""

    def __call__(self, program: VariationalInequality, accuracy: float) -> QPSolution:
        """Solve to the relative accuracy asked for."""
