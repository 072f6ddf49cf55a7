"""Norms and units by which quadratic programs and their residuals are scaled."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Mask, SparseMatrix, read_only
from vibench.interfaces.absent_rows import zero_rows
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import VariationalInequality


def row_norms(B: SparseMatrix | Array) -> Array:
    """Euclidean norms (m,) of the rows, 1 where a row is zero."""
    if isinstance(B, np.ndarray):
        squares = np.asarray(np.einsum("ij,ij->i", B, B), float)
    else:
        B = sp.csr_array(B)
        if not B.has_canonical_format:
            B = B.copy()
            B.sum_duplicates()
        # `B.multiply(B).sum(axis=1)` would allocate three matrices.
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
    """Ratio of a value to a scale, or the value itself where the scale is zero."""
    return value / scale if scale > 0.0 else value


class Drive(NamedTuple):
    """Sizes of x and of the forces on its entries, as the load or the violated constraints prescribe them.

    Constraints that are satisfied at 0 have no part in it, however far they are. `loaded` is true for a load beyond
    round-off, such as −A·lift for a rigid lift.
    """

    length: float
    force: float
    loaded: bool


def drive(program: VariationalInequality, rows: Array) -> Drive:
    """`Drive` of a program, `rows` (m,) being the norms of B's rows.

    A load f moves x by one step of steepest descent, (fᵀf / fᵀA f) f, a violated constraint by −g_i / ‖B_i‖. Where
    neither moves anything the solution is 0, and all units are 1.
    """
    A, f = program.A, program.f
    load = peak(f)
    curvature = float(f @ (A @ f)) if load else 0.0
    moved = load * float(f @ f) / curvature if curvature > 0.0 else 0.0
    depth = -float((program.g / rows).min(initial=0.0))
    # A load that moves x by less than 1e-10 of what the constraints prescribe is round-off.
    if moved > 1e-10 * depth:
        return Drive(max(moved, depth), load, loaded=True)
    length = depth if depth > 0.0 else 1.0
    return Drive(length, stiffness(A) * length, loaded=False)


def near_rows(program: VariationalInequality) -> Mask:
    """Constraints (m,) that are near 0 in units of the solution's length; see `near`."""
    rows = row_norms(program.B)
    return near(program, rows, drive(program, rows)) | ~program.K.rays(len(rows))


def near(program: VariationalInequality, rows: Array, driven: Drive) -> Mask:
    """Constraints (m,) that are less than 1e4 lengths from 0, from the norms (m,) of its rows and its `Drive`.

    Solvers lose their digits to the others, which the solution without them has to satisfy; a zero row that holds has
    no interior, which they may need.
    """
    near = np.asarray(program.g <= 1e4 * driven.length * rows)
    # The norm of a zero row is set to 1.
    if (unit := rows == 1.0).any():
        near &= ~(unit & (program.g >= 0.0) & zero_rows(program.B))
    return near


def stiffness(A: SparseMatrix | Array) -> float:
    """Mean of the diagonal of A (n×n), or 1 where that is not positive."""
    diagonal = A.diagonal()
    mean = float(diagonal.sum()) / max(len(diagonal), 1)
    return mean if mean > 0.0 else 1.0


@dataclass(frozen=True)
class Units:
    """Units in which the data of a program are of order one: absolute tolerances of solvers are relative ones there.

    With y = x / length and multipliers in units of force, a program reads min ½ yᵀA'y − f'ᵀy, B'y ≤ g', where
    A' = A·length/force, f' = f/force, B'_i = B_i/‖B_i‖ and g'_i = g_i/(‖B_i‖·length); `rows` are the ‖B_i‖ (m,).
    """

    rows: Array
    length: float
    force: float

    def scaled(self, program: VariationalInequality) -> VariationalInequality:
        """The program in these units."""
        is_dense = isinstance(program.B, np.ndarray)
        B = program.B / self.rows[:, None] if is_dense else sp.diags_array(1.0 / self.rows) @ program.B
        return replace(self.scaled_dual(program), B=B, g=program.g / (self.rows * self.length))

    def scaled_dual(self, dual: VariationalInequality) -> VariationalInequality:
        """The dual program in these units, whose constraints, −α ≤ 0, are the same in all units."""
        return VariationalInequality(dual.A / (self.force / self.length), dual.f / self.force, dual.B, dual.g)

    def to(self, x: Array, alpha: Array) -> tuple[Array, Array]:
        """Convert a solution x (n,), α (m,) of a program to one of the program in these units."""
        return x / self.length, self.rows * alpha / self.force

    def back(self, x: Array, alpha: Array) -> tuple[Array, Array]:
        """Convert a solution in these units to one of the program itself."""
        return self.length * x, self.force * alpha / self.rows


def units_of(program: VariationalInequality) -> Units:
    """Units in which ‖f‖∞ = 1, or those of what the constraints prescribe without load."""
    rows = row_norms(program.B)
    return units_driven(rows, drive(program, rows))


def units_driven(rows: Array, driven: Drive) -> Units:
    """`units_of` a program from the norms (m,) of its rows and its `Drive`."""
    # Without load the unit of A x − f is a thousandth of what the constraints prescribe: absolute tolerances of solvers
    # then serve a solution that is small beside that, as of constraints that barely act.
    return Units(rows, driven.length, driven.force if driven.loaded else 1e-3 * driven.force)


def units_of_dual(dual: VariationalInequality, loaded: bool) -> Units:
    """Units of a dual program, min ½ αᵀKα − dᵀα over α ≥ 0: d are lengths, K is a flexibility.

    Entries of d below zero are constraints that the unconstrained solution satisfies, and have no part in the units.
    """
    length = float(dual.f.max(initial=0.0)) or size(dual.f)
    # Negative multipliers within a solver's tolerance are set to zero, which opens a gap: a tenth of the prescribed
    # force as a unit keeps it small. The unit of length is as in `units_driven`.
    return Units(np.ones(len(dual.g)), 0.1 * length / stiffness(dual.A), length if loaded else 1e-3 * length)


def random_units(count: int, accuracy: float, *seed: int) -> Array:
    """Units (count,) of the unknowns, all close to 1; the same for the same seed.

    Timed repetitions solve the program in other units, so that a solver that caches answers is not timed on a hit.
    """
    # A cached answer has to be wrong by far more than the accuracy, and the program as difficult as before.
    spread = min(max(1e3 * accuracy, 1e-12), 1e-2)
    return np.asarray(1.0 + spread * (2.0 * _uniform(count, seed) - 1.0))


def in_units(program: VariationalInequality, d: Array) -> VariationalInequality:
    """The dense program of y, where x = D y with units d (n,) of the unknowns: D A D, D f, B D, g.

    It is the same program: as definite and as feasible, with the same multipliers, and its solution is D⁻¹x. Zeros,
    symmetry, and pairs of opposite constraints are preserved to the last bit.
    """
    return replace(program, A=program.A * np.outer(d, d), f=d * program.f, B=program.B * d, g=program.g.copy())


def nearby(box: ParameterBox, mu: Array, *seed: int) -> Array:
    """A parameter (d,) of the box next to mu (d,), new to a problem that caches; the same for the same seed."""
    elsewhere = box.lower + _uniform(box.dim, seed) * (box.upper - box.lower)
    return read_only(mu + 1e-10 * (elsewhere - mu))


def _uniform(count: int, seed: tuple[int, ...]) -> Array:
    # NumPy takes (s, 0) for s, the seed of the validation set: without the 1 `elsewhere` would be mu itself.
    return np.random.default_rng((*seed, 1)).random(count)
