"""A reduced program in coordinates in which it has no units: what its formulations are solved in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf, dtrtrs

from vibench import Array, Mask, NumericalError, VariationalInequality, is_absent


def positive_solution(matrix: Array, right: Array) -> Array:
    """The solution (k,) of a system with a positive definite matrix (k×k), which is overwritten.

    Raises
    ------
    NumericalError
        If it is not positive definite.
    """
    if not len(right):
        return right
    # `scipy.linalg.solve` takes longer to check its arguments than LAPACK to solve systems of these sizes
    _, solution, info = dposv(matrix.T, right, lower=False, overwrite_a=True)
    if info:
        raise NumericalError(f"a matrix of {len(right)} constraints is not positive definite")
    return np.asarray(solution)


@dataclass(frozen=True)
class Whitened:
    """The program min ½‖z‖² subject to Y z ≤ g, whose rows Y_i have unit length.

    With A = L Lᵀ, l_i² = B_i A⁻¹ B_iᵀ and the unconstrained solution u₀ it is the program min ½xᵀA x − fᵀx subject to
    B x ≤ g for z = Lᵀ(x − u₀) / σ and multipliers ν_i = l_i α_i / σ, where σ is the largest energy norm of the
    correction that a constraint needs alone at u₀. Neither units of x and f, nor a basis of x, nor the scaling of a row
    with its multiplier, nor a load beside the contact has a part in it. z + Yᵀν = 0.

    Attributes
    ----------
    Y, g
        Rows (k×N) and bounds (k,); k of R constraints that are neither absent nor zero.
    y
        Lᵀu₀ / σ (N,).
    kept
        Which constraints these are (R,).
    lower, lengths, unit
        L, l (k,) and σ.
    """

    Y: Array
    g: Array
    y: Array
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
        # LAPACK itself: for small programs SciPy takes longer to check arguments than to factorise
        lower, info = dpotrf(program.A, lower=True) if factor is None else (factor, 0)
        if info:
            raise NumericalError("the stiffness of the reduced program is not positive definite")
        whitened, _ = dtrtrs(lower, np.vstack([program.B, program.f]).T, lower=True, overwrite_b=True)
        rows, free, bounds = whitened[:, :-1].T, whitened[:, -1], program.g
        lengths = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        if ((lengths == 0.0) & (bounds < 0.0)).any():
            raise NumericalError("the reduced program is infeasible: a row of B is zero where g is negative")
        kept = (lengths > 0.0) & ~is_absent(bounds)
        if not kept.all():
            rows, lengths, bounds = rows[kept], lengths[kept], bounds[kept]
        rows, bounds = rows / lengths[:, None], bounds / lengths
        bounds = bounds - rows @ free
        unit = max(0.0, -float(np.min(bounds, initial=0.0))) or 1.0
        return cls(rows, bounds / unit, free / unit, kept, lower, lengths, unit)

    @property
    def is_free(self) -> bool:
        """Whether the unconstrained solution is feasible, so that z = 0 and ν = 0."""
        return bool((self.g >= 0.0).all())

    @staticmethod
    def size(pressed: Array) -> float:
        """F for Yᵀν (N,), relative to which residuals are natural (docs/mathematics.md); at least the unit."""
        return max(1.0, float(np.sqrt(pressed @ pressed)))

    def back(self, z: Array, nu: Array) -> tuple[Array, Array]:
        """The solution x (N,), α (R,) of the program itself from z (N,), ν (k,)."""
        alpha = np.zeros(len(self.kept))
        alpha[self.kept] = self.unit * nu / self.lengths
        return dtrtrs(self.lower, self.unit * (self.y + z), lower=True, trans=True)[0], alpha
