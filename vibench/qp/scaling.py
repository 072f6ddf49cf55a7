"""Norms and units by which quadratic programs and their residuals are scaled."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Mask, SparseMatrix
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import VariationalInequality

NO_LOAD = 1e-10
"""A load that moves x by less than this share of what the constraints prescribe is round-off."""

OBJECTIVE_UNIT = 1e-3
"""Share of what the constraints prescribe that is a solver's unit of A x − f, of force or in the dual of length.

Its absolute tolerances then serve a solution that is small beside that, as of constraints that barely act.
"""

FAR = 1e4
"""A constraint so many lengths away is left out, and the solution without it must satisfy it: see `near`."""

MULTIPLIER_UNIT = 0.1
"""Share of the prescribed force that is the unit of the unknowns of a dual program.

Negative ones within a solver's tolerance are set to zero, which opens a gap.
"""


def row_norms(B: SparseMatrix | Array) -> Array:
    """Euclidean norms (m,) of the rows, 1 where a row is zero."""
    if isinstance(B, np.ndarray):
        squares = np.asarray(np.einsum("ij,ij->i", B, B), float)
    else:  # as `B.multiply(B).sum(axis=1)`, without the matrices that it makes
        B = sp.csr_array(B)
        if not B.has_canonical_format:
            B = B.copy()
            B.sum_duplicates()
        rows = np.repeat(np.arange(B.shape[0]), np.diff(B.indptr))
        squares = np.bincount(rows, weights=B.data * B.data, minlength=B.shape[0])
    norms = np.sqrt(squares)
    if not norms.all():
        norms[norms == 0.0] = 1.0
    return np.asarray(norms)


def peak(vector: Array) -> float:
    """Largest entry in absolute value; 0 of an empty vector."""
    return float(np.abs(vector).max(initial=0.0))


def size(vector: Array) -> float:
    """Largest entry in absolute value, or 1 for the zero vector: a safe divisor."""
    return peak(vector) or 1.0


def ratio(value: float, scale: float) -> float:
    """A value relative to a scale, or as it is where the scale is zero."""
    return value / scale if scale > 0.0 else value


class Drive(NamedTuple):
    """What drives the solution of a program away from 0, in the units of its data.

    Constraints that are satisfied at 0 drive nothing: however far they are, they have no part in it.

    Attributes
    ----------
    length, force
        Sizes of x and of forces on its entries: those of the load, or of what violated constraints prescribe.
    loaded
        Whether there is a load; one that is round-off, as −A·lift is for a rigid lift, is none.
    """

    length: float
    force: float
    loaded: bool


def drive(program: VariationalInequality, rows: Array) -> Drive:
    """What drives the solution of a program, `rows` (m,) being the norms of B's rows.

    A load f moves x by one step of steepest descent, (fᵀf / fᵀA f) f, a violated constraint by −g_i / ‖B_i‖. Where
    neither moves anything the solution is 0, and all units are 1.
    """
    A, f = program.A, program.f
    load = peak(f)
    curvature = float(f @ (A @ f)) if load else 0.0
    moved = load * float(f @ f) / curvature if curvature > 0.0 else 0.0
    depth = -float((program.g / rows).min(initial=0.0))
    if moved > NO_LOAD * depth:
        return Drive(max(moved, depth), load, loaded=True)
    length = depth if depth > 0.0 else 1.0
    return Drive(length, stiffness(A) * length, loaded=False)


def near_rows(program: VariationalInequality) -> Mask:
    """Constraints (m,) that are less than `FAR` lengths from 0; solvers lose their digits to the others."""
    rows = row_norms(program.B)
    return near(program, rows, drive(program, rows))


def near(program: VariationalInequality, rows: Array, driven: Drive) -> Mask:
    """The same where the norms (m,) of its rows, and what drives it, are known."""
    return np.asarray(program.g <= FAR * driven.length * rows)


def stiffness(A: SparseMatrix | Array) -> float:
    """Mean of the diagonal of A (n×n), or 1 where that is not positive."""
    diagonal = A.diagonal()
    mean = float(diagonal.sum()) / max(len(diagonal), 1)
    return mean if mean > 0.0 else 1.0


def random_units(count: int, accuracy: float, *seed: int) -> Array:
    """Units (count,) of the unknowns, all close to 1; the same for the same seed.

    Timed repetitions solve the program in other units, so that a solver that caches answers is not timed on a hit.
    """
    # The answer in other units must be wrong by far more than the accuracy; the program stays as difficult as before.
    spread = min(max(1e3 * accuracy, 1e-12), 1e-2)
    return np.asarray(1.0 + spread * (2.0 * _uniform(count, seed) - 1.0))


def in_units(program: VariationalInequality, d: Array) -> VariationalInequality:
    """The dense program of y, where x = D y with units d (n,) of the unknowns: D A D, D f, B D, g.

    It is the same program: as definite and as feasible, with the same multipliers, and its solution is D⁻¹x. Zeros,
    symmetry, and pairs of opposite constraints are preserved to the last bit.
    """
    return replace(program, A=program.A * np.outer(d, d), f=d * program.f, B=program.B * d, g=program.g.copy())


def nearby(box: ParameterBox, mu: Array, *seed: int) -> Array:
    """A parameter (d,) of the box next to mu (d,), for problems that cache; the same for the same seed."""
    elsewhere = box.lower + _uniform(box.dim, seed) * (box.upper - box.lower)
    return np.asarray(mu + 1e-10 * (elsewhere - mu))


def _uniform(count: int, seed: tuple[int, ...]) -> Array:
    """Random numbers (count,) between 0 and 1."""
    # NumPy takes (s, 0) for s, the seed of the validation set: the parameter elsewhere would be the one to be moved.
    return np.random.default_rng((*seed, 1)).random(count)


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

    def scaled_dual(self, dual: VariationalInequality) -> VariationalInequality:
        """The same of a dual program, whose constraints, −α ≤ 0, are the same in all units."""
        return VariationalInequality(dual.A / (self.force / self.length), dual.f / self.force, dual.B, dual.g)

    def to(self, x: Array, alpha: Array) -> tuple[Array, Array]:
        """A solution x (n,), α (m,) of a program as one of the program in these units."""
        return x / self.length, self.rows * alpha / self.force

    def back(self, x: Array, alpha: Array) -> tuple[Array, Array]:
        """A solution in these units as one of the program itself; reverses `to`."""
        return self.length * x, self.force * alpha / self.rows


def units_of(program: VariationalInequality) -> Units:
    """Units of what drives a program: those in which ‖f‖∞ = 1, or of what the constraints prescribe without load."""
    rows = row_norms(program.B)
    return units_driven(rows, drive(program, rows))


def units_driven(rows: Array, driven: Drive) -> Units:
    """The same from the norms (m,) of the rows of a program, and what drives it."""
    return Units(rows, driven.length, driven.force if driven.loaded else OBJECTIVE_UNIT * driven.force)


def units_of_dual(dual: VariationalInequality, loaded: bool) -> Units:
    """Units of a dual program, min ½ αᵀKα − dᵀα over α ≥ 0: d are lengths, K is a flexibility.

    Entries of d below zero are constraints that the unconstrained solution satisfies, and drive nothing.
    """
    length = float(dual.f.max(initial=0.0)) or size(dual.f)
    return Units(
        np.ones(len(dual.g)),
        MULTIPLIER_UNIT * length / stiffness(dual.A),
        length if loaded else OBJECTIVE_UNIT * length,
    )
