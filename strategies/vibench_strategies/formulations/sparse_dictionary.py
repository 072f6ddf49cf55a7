"""Few multipliers of a large dictionary, chosen at the query by a greedy with a certificate."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Lt

from vibench import Array, NumericalError
from vibench_strategies.formulations.reduced_programs import ProgramFormulation
from vibench_strategies.formulations.whitened import Whitened

DEPENDENT = 1e-10
"""A unit row of which less is left outside the span of those chosen lies in it."""


class SparseDictionary(ProgramFormulation):
    """Few pressures of a dictionary, chosen at the query by a greedy active set method (Kollepara et al. 2024).

    The dictionary are the generators of the cone, with the dual strategy `dictionary` all snapshots. The greedy adds
    the entry whose constraint is violated most, and drops those whose coefficients would become negative. Violation
    that is left certifies the answer: at zero it is the mixed one with all entries, of which no more than the dimension
    of the primal space are needed.

    Parameters
    ----------
    tolerance
        Violation, natural as in the residuals of quadratic programs, at which the choice ends; the accuracy by default.
    entries
        Largest number of entries; an answer that needs more is inaccurate, and its reason has the violation.
    """

    def __init__(
        self,
        tolerance: Annotated[float, Gt(0.0), Lt(1.0)] | None = None,
        entries: Annotated[int, Ge(1)] | None = None,
    ) -> None:
        self.tolerance, self.entries = tolerance, entries

    def algorithm(self, program: Whitened, accuracy: float) -> tuple[Array, Array, int, str]:
        """Greedy choice until the violation that is left is small enough."""
        tolerance = self.tolerance or accuracy
        z, nu, steps, left = greedy_active_set(program, tolerance, self.entries)
        short = f"{self.entries} entries leave the violation {left:.1e}, above {tolerance:g}"
        return z, nu, steps, short if left > tolerance else ""


def greedy_active_set(program: Whitened, tolerance: float, entries: int | None) -> tuple[Array, Array, int, float]:
    """Solve a program with the constraints that a greedy chooses; returns z, ν ≥ 0, steps, and the largest violation.

    Each step takes the constraint that the present solution violates most, and moves to the solution with it; a
    multiplier that would become negative on the way leaves (Goldfarb and Idnani 1983). All iterates are optimal for
    the chosen constraints. What is left of violation, relative to the energy of the solution, certifies them for all
    others: at most `tolerance`, unless the number of `entries` ends the choice first.

    Raises
    ------
    NumericalError
        If no z satisfies all constraints.
    """
    Y, g, z, nu, steps = program.Y, program.g, program.y.copy(), np.zeros(len(program.g)), 0
    chosen = list[int]()
    limit = 10 * len(g) + 10
    while True:
        excess = Y @ z - g
        worst = int(np.argmax(excess))
        violation = max(float(excess[worst]), 0.0) / (program.energy(z, nu) or 1.0)
        if violation <= tolerance or (entries is not None and len(chosen) >= entries):
            return program.y - Y.T @ nu, nu, steps, violation
        while True:
            steps += 1
            if steps > limit:
                raise NumericalError(f"the greedy choice has not ended after {limit} steps: its constraints cycle")
            on_chosen, rest = _parts(Y[chosen], Y[worst])
            square = float(rest @ rest)
            falling = [k for k, share in enumerate(on_chosen) if share > DEPENDENT]
            ratios = [nu[chosen[k]] / on_chosen[k] for k in falling]
            full = (Y[worst] @ z - g[worst]) / square if square > DEPENDENT**2 else np.inf
            partial = min(ratios, default=np.inf)
            length = min(full, partial)
            if not np.isfinite(length):
                raise NumericalError("the reduced program is infeasible: no coefficients satisfy all constraints")
            z -= length * rest
            nu[chosen] -= length * on_chosen
            nu[worst] += length
            if full <= partial:
                chosen.append(worst)
                break
            leaving = chosen.pop(falling[int(np.argmin(ratios))])
            nu[leaving] = 0.0


def _parts(rows: Array, row: Array) -> tuple[Array, Array]:
    """Coefficients of a row in the span of `rows` (j×N), which are independent, and what is left of it."""
    if not len(rows):
        return np.zeros(0), row.copy()
    coefficients = np.asarray(np.linalg.lstsq(rows.T, row, rcond=None)[0], float)
    return coefficients, row - rows.T @ coefficients
