"""Lower bounds of the inf-sup constant β_A(µ) at online cost, from one number that is proved offline.

β_A(µ)² is the smallest eigenvalue of B A⁻¹Bᵀ against X_W. With A ≼ γ X it is at least that of B X⁻¹Bᵀ/γ, and

- where B(µ) = θ(µ) B₀ is declared, β_A ≥ |θ| β₀/√γ;
- where X has a block for every one of several bodies and B(µ) = B₀ + B₁(µ), B₀ on some of the bodies and B₁ on the
  others, B X⁻¹Bᵀ = B₀X⁻¹B₀ᵀ + B₁X⁻¹B₁ᵀ, hence β_A ≥ β₀/√γ. That B is B₀ on these bodies is verified at the parameter.

Here β₀² is the smallest eigenvalue of B₀X⁻¹B₀ᵀ against X_W, see `vibench.stability.coercivity` for its proof.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from vibench.arrays import Indices, Mask, SparseMatrix
from vibench.linalg.inner_product import InnerProduct
from vibench.stability.coercivity import energy_inf_sup

SCALED = "beta_A from B(mu) = theta(mu) B_0"
ON_BODIES = "beta_A from the bodies on which B is constant"
NO_BODY = "no beta_A: B is declared to be no multiple of one matrix, and constant on no body"
NOT_PROVED = "no beta_A: no positive lower bound of the inf-sup constant of the constant part of B is proved"
NOT_CONSTANT = "no beta_A: B is not at this parameter what it is at the training parameters on any body"


@dataclass(frozen=True)
class OnlineInfSup:
    """What bounds β_A(µ) from below at online cost; see above.

    Attributes
    ----------
    value
        β₀; 0 where there is none.
    constraint
        B₀ (m×k) on the contact unknowns.
    bodies
        Contact unknowns (k,) on which B(µ) must be B₀; `None` where B(µ) = θ(µ) B₀ is declared.
    reason
        Why there is none, or "".
    """

    value: float
    constraint: SparseMatrix
    bodies: Mask | None
    reason: str = ""

    def at(self, theta: float, B: SparseMatrix | None, gamma: float) -> tuple[float, str]:
        """A lower bound of β_A(µ), 0 if there is none, and which it is or why there is none.

        Parameters
        ----------
        theta
            θ(µ) where B(µ) = θ(µ) B₀ is declared.
        B
            B(µ) (m×k) on the contact unknowns; else.
        gamma
            γ(µ).
        """
        if self.reason:
            return 0.0, self.reason
        if self.bodies is None:
            return abs(theta) * self.value / sqrt(gamma), SCALED
        assert B is not None  # evaluated where B is no multiple of one matrix
        difference = sp.csr_array(sp.csr_array(B) - self.constraint)
        if np.any(difference.data[self.bodies[difference.indices]] != 0.0):  # NaN is not zero
            return 0.0, NOT_CONSTANT
        return self.value / sqrt(gamma), ON_BODIES


def online_inf_sup(
    X: InnerProduct, W: InnerProduct, contact: Indices, constraint: SparseMatrix, same: Mask | None
) -> OnlineInfSup:
    """Prove β₀ for B₀, which is a part of a matrix (m×k) on the contact unknowns (k,).

    `same` (k,) are the unknowns on which B was the same at the training parameters; `None` where B(µ) is declared to be
    a multiple of the matrix, which is B₀ then. Bodies are unknowns that X couples, directly or by others.
    """
    bodies = None
    if same is not None:
        body = connected_components(X.matrix, directed=False)[1][contact]
        bodies = ~np.isin(body, body[~same])
        constraint = sp.csr_array(constraint @ sp.diags_array(bodies.astype(float)))
        if not bodies.any():
            return OnlineInfSup(0.0, constraint, bodies, NO_BODY)
    entries = sp.coo_array(constraint)
    rows, columns = entries.coords
    B = sp.csr_array((entries.data, (rows, contact[columns])), shape=(constraint.shape[0], X.dim))
    found = energy_inf_sup(X.matrix, B, W)
    proved = found.proved and found.value > 0.0
    return OnlineInfSup(found.value if proved else 0.0, constraint, bodies, "" if proved else NOT_PROVED)
