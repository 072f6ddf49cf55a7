"""Norms and units by which quadratic programs and their residuals are scaled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, SparseMatrix
from vibench.interfaces.problem import VariationalInequality

NO_LOAD = 1e-10
"""A load below this share of the forces at work in the constraints is round-off, as −A·lift is for a rigid lift."""

OBJECTIVE_UNIT = 1e-3
"""Share of what the constraints prescribe that is a solver's unit of A x − f, of force or in the dual of length.

Its absolute tolerances then serve a solution that is small beside that, as of constraints that barely act.
"""

MULTIPLIER_UNIT = 0.1
"""Share of the prescribed force that is the unit of the unknowns of a dual program.

Negative ones within a solver's tolerance are set to zero, which opens a gap.
"""


def row_norms(B: SparseMatrix | Array) -> Array:
    """Euclidean norms (m,) of the rows, 1 where a row is zero."""
    squares = (B * B).sum(axis=1) if isinstance(B, np.ndarray) else B.multiply(B).sum(axis=1)
    norms = np.sqrt(np.asarray(squares, float).ravel())
    return np.where(norms > 0.0, norms, 1.0)


def peak(vector: Array) -> float:
    """Largest entry in absolute value; 0 of an empty vector."""
    return float(np.max(np.abs(vector), initial=0.0))


def size(vector: Array) -> float:
    """Largest entry in absolute value, or 1 for the zero vector: a safe divisor."""
    return peak(vector) or 1.0


def ratio(value: float, scale: float) -> float:
    """A value relative to a scale, or as it is where the scale is zero."""
    return value / scale if scale > 0.0 else value


class Prescribed(NamedTuple):
    """What the constraints of a program without load prescribe; the data have no other length and no other force.

    Attributes
    ----------
    length
        L = max |g_i| / ‖B_i‖, or 1 where g = 0.
    force
        k L with the stiffness k, the mean of the diagonal of A.
    """

    length: float
    force: float


def prescribed(program: VariationalInequality, rows: Array) -> Prescribed | None:
    """What the constraints prescribe, `rows` (m,) being the norms of B's rows; `None` for a program with a load f."""
    bound, k = program.g / rows, stiffness(program.A)
    if peak(program.f) > NO_LOAD * k * float(np.max(-bound, initial=0.0)):  # x = 0 violates them by that much
        return None
    return Prescribed(size(bound), k * size(bound))


def stiffness(A: SparseMatrix | Array) -> float:
    """Mean of the diagonal of A (n×n), or 1 where that is not positive."""
    diagonal = A.diagonal()
    mean = float(np.sum(diagonal)) / max(len(diagonal), 1)
    return mean if mean > 0.0 else 1.0


@dataclass(frozen=True)
class Units:
    """Units in which the data of a program are of order one: absolute tolerances of solvers are relative ones there.

    With y = x / length and multipliers in units of force, a program reads min ½ yᵀA'y − f'ᵀy, B'y ≤ g', where
    A' = A·length/force, f' = f/force, B'_i = B_i/‖B_i‖ and g'_i = g_i/(‖B_i‖·length).

    Attributes
    ----------
    rows
        Norms ‖B_i‖ (m,).
    length, force
        Units of x and of f.
    """

    rows: Array
    length: float
    force: float

    def scaled(self, program: VariationalInequality) -> VariationalInequality:
        """The program in these units."""
        is_dense = isinstance(program.B, np.ndarray)
        B = program.B / self.rows[:, None] if is_dense else sp.diags_array(1.0 / self.rows) @ program.B
        A, g = program.A / (self.force / self.length), program.g / (self.rows * self.length)
        return VariationalInequality(A, program.f / self.force, B, g)

    def to(self, x: Array, alpha: Array) -> tuple[Array, Array]:
        """A solution x (n,), α (m,) of a program as one of the program in these units."""
        return x / self.length, self.rows * alpha / self.force

    def back(self, x: Array, alpha: Array) -> tuple[Array, Array]:
        """A solution in these units as one of the program itself; reverses `to`."""
        return self.length * x, self.force * alpha / self.rows


def units_of(program: VariationalInequality) -> Units:
    """Units in which ‖f‖∞ = 1 and x is as it is; without load, those of what the constraints prescribe."""
    rows = row_norms(program.B)
    scale = prescribed(program, rows)
    if scale is None:
        return Units(rows, 1.0, size(program.f))
    return Units(rows, scale.length, OBJECTIVE_UNIT * scale.force)


def units_of_dual(dual: VariationalInequality) -> Units:
    """Units of the dual of a program without load, min ½ αᵀKα − dᵀα over α ≥ 0: d are lengths, K is a flexibility."""
    length = size(dual.f)
    return Units(np.ones(len(dual.g)), MULTIPLIER_UNIT * length / stiffness(dual.A), OBJECTIVE_UNIT * length)
