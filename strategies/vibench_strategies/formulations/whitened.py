"""A reduced program in coordinates in which it has no units: what its formulations are solved in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from vibench import Array, Mask, NumericalError, VariationalInequality, is_absent

FEASIBLE = 1e-12
"""Violations below this share of the solution are round-off; the scale is that of `Whitened.energy`."""


@dataclass(frozen=True)
class Whitened:
    """The program min ½‖z − y‖² subject to Y z ≤ g, whose rows Y_i have unit length.

    With A = L Lᵀ and l_i² = B_i A⁻¹ B_iᵀ it is the program min ½xᵀA x − fᵀx subject to B x ≤ g for z = Lᵀx / σ and
    multipliers ν_i = l_i α_i / σ, where σ is the largest energy norm of the correction that a constraint needs alone at
    the unconstrained solution. Neither units of x and f, nor a basis of x, nor the scaling of a row with its multiplier
    has a part in it. z + Yᵀν = y.

    Attributes
    ----------
    Y, y, g
        Rows (k×N), unconstrained solution (N,) and bounds (k,); k of R constraints that are neither absent nor zero.
    kept
        Which constraints these are (R,).
    lower, lengths, unit
        L, l (k,) and σ.
    """

    Y: Array
    y: Array
    g: Array
    kept: Mask
    lower: Array
    lengths: Array
    unit: float

    @classmethod
    def of(cls, program: VariationalInequality, factor: Array | None = None) -> Whitened:
        """The reduced program (A dense) in these coordinates; `factor` is L where it is known.

        Raises
        ------
        NumericalError
            If A is not positive definite, or a zero row of B makes the program infeasible.
        """
        try:
            lower = scipy.linalg.cholesky(program.A, lower=True) if factor is None else factor
        except np.linalg.LinAlgError:
            raise NumericalError("the stiffness of the reduced program is not positive definite") from None
        columns = np.column_stack([program.B.T, program.f])
        whitened = scipy.linalg.solve_triangular(lower, columns, lower=True, check_finite=False)
        rows, free, bounds = whitened[:, :-1].T, whitened[:, -1], program.g
        lengths = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        if ((lengths == 0.0) & (bounds < 0.0)).any():
            raise NumericalError("the reduced program is infeasible: a row of B is zero where g is negative")
        kept = (lengths > 0.0) & ~is_absent(bounds)
        rows, lengths, bounds = rows[kept] / lengths[kept, None], lengths[kept], bounds[kept] / lengths[kept]
        unit = float(np.max(rows @ free - bounds, initial=0.0)) or 1.0
        return cls(rows, free / unit, bounds / unit, kept, lower, lengths, unit)

    @property
    def is_free(self) -> bool:
        """Whether the unconstrained solution is feasible, so that z = y and ν = 0."""
        return bool((self.g >= self.Y @ self.y).all())

    def energy(self, z: Array, nu: Array) -> float:
        """S = √(‖z‖² + ‖Yᵀν‖²), relative to which residuals are natural (docs/mathematics.md)."""
        pressed = self.Y.T @ nu
        return float(np.sqrt(z @ z + pressed @ pressed))

    def back(self, z: Array, nu: Array) -> tuple[Array, Array]:
        """The solution x (N,), α (R,) of the program itself from z (N,), ν (k,)."""
        alpha = np.zeros(len(self.kept))
        alpha[self.kept] = self.unit * nu / self.lengths
        return scipy.linalg.solve_triangular(self.lower, self.unit * z, lower=True, trans="T"), alpha
