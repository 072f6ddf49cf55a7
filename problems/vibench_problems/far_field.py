"""The half-space outside a block: two fields that span Boussinesq's, and their energies there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from skfem import ElementHex1, FacetBasis, MeshHex

from vibench import Array, Indices

ORDER = 8
"""Order of the quadrature on the sides of the block, on which the integrands are smooth."""


@dataclass(frozen=True)
class FarField:
    """Displacements of the half-space z ≤ 0 outside a block around the origin, in the span of two fields.

    A force F pushes the surface at the origin, with r the distance from it and ζ = −z the depth, by

        u = F/(4πG) (k + (1 − 2ν) m),    k = (ζ x/r³, ζ y/r³, ζ²/r³ + 1/r),    m = (−∂_x, −∂_y, ∂_ζ) ln(r + ζ)

    (Boussinesq 1885; Johnson, Contact Mechanics, 1985, equation (3.18)). Amplitudes of k and m are unknowns: minimising
    the energy finds those of the force and of ν. Densities of energy are homogeneous of degree −4, so that integrals
    over the outside are those of density times x·n over the sides of the block.

    Attributes
    ----------
    values
        Both fields at chosen nodes (2×3×p), in units of their amplitudes.
    divergences, strains, gradients
        ∫ tr ε_i tr ε_j, 2 ∫ ε_i : ε_j and ∫ ∇u_i : ∇u_j over the outside (2×2) [m].
    """

    values: Array
    divergences: Array
    strains: Array
    gradients: Array

    @classmethod
    def around(cls, mesh: MeshHex, sides: Indices, nodes: Indices, length: float) -> FarField:
        """Outside `mesh`, at some nodes of it and over its facets `sides`; fields are those of x over `length`."""
        basis = FacetBasis(mesh, ElementHex1(), facets=sides, intorder=ORDER)
        x = np.asarray(basis.global_coordinates())
        weights = (basis.dx * np.sum(x * basis.normals, axis=0)).ravel()
        nabla = fields(x.reshape(3, -1) / length)[1] / length
        strain, divergence = 0.5 * (nabla + nabla.swapaxes(1, 2)), np.trace(nabla, axis1=1, axis2=2)
        return cls(
            fields(mesh.p[:, nodes] / length)[0],
            np.einsum("ip,jp,p->ij", divergence, divergence, weights),
            2.0 * np.einsum("iabp,jabp,p->ij", strain, strain, weights),
            np.einsum("iabp,jabp,p->ij", nabla, nabla, weights),
        )


def fields(points: Array) -> tuple[Array, Array]:
    """The fields k and m (2×3×p) at points (3×p) of z ≤ 0 but the origin, and their gradients ∂_b u_a (2×3×3×p)."""
    downwards = np.array([1.0, 1.0, -1.0])[:, None]
    x = downwards * points
    r, depth, unit = np.linalg.norm(x, axis=0), x[2], np.eye(3)
    # k_a = ζ x_a/r³ + δ_aζ/r
    k = depth * x / r**3 + unit[2][:, None] / r
    of_k = (
        np.einsum("a...,b->ab...", x, unit[2])
        + unit[..., None] * depth
        - 3.0 * depth * np.einsum("a...,b...->ab...", x, x) / r**2
        - np.einsum("a,b...->ab...", unit[2], x)
    ) / r**3
    # With s = r + ζ the first derivatives of ln s are x/(rs), y/(rs), 1/r.
    s, plane = r + depth, x * np.array([1.0, 1.0, 0.0])[:, None]
    slope = plane / (r * s) + unit[2][:, None] / r
    hessian = -np.einsum("a...,b...->ab...", plane, plane) * (r + s) / (r**3 * s**2)
    hessian[0, 0] += 1.0 / (r * s)
    hessian[1, 1] += 1.0 / (r * s)
    hessian[2], hessian[:, 2] = -x / r**3, -x / r**3
    signs = np.array([-1.0, -1.0, 1.0])
    m, of_m = signs[:, None] * slope, signs[:, None, None] * hessian
    # Back to z upwards: vertical components and derivatives change their signs.
    turned = downwards[:, None] * downwards[None, :]
    return downwards * np.stack([k, m]), turned * np.stack([of_k, of_m])
