"""Few multipliers of a large dictionary, chosen at the query by a greedy with a certificate."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import scipy.linalg
from annotated_types import Ge, Gt, Lt
from scipy.linalg.lapack import dtrtrs

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
    the chosen constraints. What is left of violation, relative to what contact does, certifies them for all
    others: at most `tolerance`, unless the number of `entries` ends the choice first.

    Raises
    ------
    NumericalError
        If no z satisfies all constraints.
    """
    Y, g, z, nu, steps = program.Y, program.g, np.zeros_like(program.y), np.zeros(len(program.g)), 0
    chosen = Chosen(Y)
    limit = 10 * len(g) + 10
    while True:
        excess = Y @ z - g
        worst = int(excess.argmax())
        violation = max(float(excess[worst]), 0.0) / program.size(z)
        if violation <= tolerance or (entries is not None and len(chosen.rows) >= entries):
            return -(Y.T @ nu), nu, steps, violation
        lacking = excess[worst]
        while True:
            steps += 1
            if steps > limit:
                raise NumericalError(f"the greedy choice has not ended after {limit} steps: its constraints cycle")
            on_chosen, rest = chosen.parts(Y[worst])
            square = float(rest @ rest)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratios = np.where(on_chosen > DEPENDENT, nu[chosen.rows] / on_chosen, np.inf)
            full = lacking / square if square > DEPENDENT**2 else np.inf
            length = min(full, ratios.min(initial=np.inf))
            if not np.isfinite(length):
                raise NumericalError("the reduced program is infeasible: no coefficients satisfy all constraints")
            z -= length * rest
            nu[chosen.rows] -= length * on_chosen
            nu[worst] += length
            if length == full:
                chosen.add(worst, on_chosen, rest)
                break
            lacking -= length * square
            nu[chosen.drop(int(ratios.argmin()))] = 0.0


class Chosen:
    """Chosen rows of Y (k×N), which are independent, with the factors Y_Sᵀ = Q T, updated at every choice."""

    def __init__(self, Y: Array) -> None:
        self.rows = list[int]()
        self._Q, self._T = np.zeros((Y.shape[1], 0)), np.zeros((0, 0))

    def parts(self, row: Array) -> tuple[Array, Array]:
        """Coefficients (j,) of a row in the span of those chosen, and what is left of it (N,)."""
        if not self.rows:
            return np.zeros(0), row
        on = self._Q.T @ row
        rest = row - self._Q @ on
        # a second time: of a nearly dependent row round-off is left, too
        again = self._Q.T @ rest
        return dtrtrs(self._T, on + again)[0], rest - self._Q @ again

    def add(self, row: int, coefficients: Array, rest: Array) -> None:
        """Choose a row with these parts."""
        length, size = np.sqrt(rest @ rest), len(self.rows)
        T = np.zeros((size + 1, size + 1))
        T[:size, :size], T[:size, size], T[size, size] = self._T, self._T @ coefficients, length
        self._Q, self._T = np.column_stack([self._Q, rest / length]), T
        self.rows.append(row)

    def drop(self, place: int) -> int:
        """Drop the row at a place, and return its number."""
        Q, T = scipy.linalg.qr_delete(self._Q, self._T, place, which="col", check_finite=False)
        # a square Q is taken for a full factorisation, which keeps all columns
        self._Q, self._T = Q[:, : T.shape[1]], T[: T.shape[1]]
        return self.rows.pop(place)
