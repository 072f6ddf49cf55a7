"""The energy norm of the high-fidelity problem at one parameter, and its dual norm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array, SparseMatrix
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.linalg.cholesky import SparseCholesky


@dataclass(frozen=True)
class Energy:
    """Factorisations of A(µ).

    Attributes
    ----------
    A
        Sparse SPD (n×n).
    factor
        Its Cholesky factor.
    stiffness
        A condensed on the unknowns that constraints involve, for programs with this A and these constraints.
    """

    A: SparseMatrix
    factor: SparseCholesky
    stiffness: CondensedStiffness

    @property
    def nbytes(self) -> int:
        """Memory, about: that of the condensed matrix is as large, and SuperLU allocates twice what it fills."""
        return 4 * self.factor.nbytes

    def norm(self, v: Array) -> float:
        """‖v‖_A of v (n,)."""
        return float(np.sqrt(max(float(v @ (self.A @ v)), 0.0)))

    def dual_norm(self, functional: Array) -> float:
        """‖ℓ‖_{A⁻¹} of a functional (n,)."""
        return float(np.sqrt(max(float(functional @ self.factor.solve(functional)), 0.0)))
