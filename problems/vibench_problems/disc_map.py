"""Maps of the square that scale, shift and optionally bulge its central disc and leave the outer boundary fixed."""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTriP1, MeshTri
from skfem.helpers import dot, grad

from vibench import Array, Indices, SparseMatrix
from vibench_problems.disc_mesh import cross

DECAY = 6.0
"""Exponent of the weight |x|^−DECAY in the extension of the bulge: stiff near the disc, soft near the boundary."""


@BilinearForm
def stiffness(u, v, _):  # type: ignore[no-untyped-def]
    """∫ ∇u · ∇v."""
    return dot(grad(u), grad(v))


@BilinearForm
def decaying_stiffness(u, v, w):  # type: ignore[no-untyped-def]
    """∫ |x|^−DECAY ∇u · ∇v."""
    return dot(w.x, w.x) ** (-0.5 * DECAY) * dot(grad(u), grad(v))


class DiscMap:
    """h(mu) at the nodes of a mesh that fits the disc ω̂ of radius r̂, linear in a few weights.

    With z = x + iy, h(mu) is z ↦ mu_1 z + mu_2 + i mu_3 on ω̂. With `bulge` it is

        z ↦ mu_1 (z + mu_4 z²/(2r̂)) + mu_2 + i mu_3,

    which deforms the disc into an egg shape along x. The map is conformal on ω̂: it preserves angles and scales lengths
    by mu_1 |1 + mu_4 z/r̂|. It is injective for |mu_4| < 1, because its derivative has a positive real part on a convex
    set (Noshiro and Warschawski). Outside ω̂ the displacement is extended to zero on the boundary: scaling and shifts
    harmonically, the bulge with the weight |x|^−6, which preserves the shape of the triangles near the disc. The whole
    map is injective if no triangle is inverted, because it is the identity on the boundary.

    Parameters
    ----------
    mesh
        Triangulation of the square.
    disc_nodes
        Nodes of the closed disc, ascending.
    radius
        r̂ [m].
    bulge
        Whether the map has the fourth parameter mu_4.
    """

    def __init__(self, mesh: MeshTri, disc_nodes: Indices, radius: float, bulge: bool) -> None:
        self._disc_nodes, self._bulge = disc_nodes, bulge
        basis = Basis(mesh, ElementTriP1())
        on_disc = mesh.p[:, disc_nodes]
        extended = partial(self._extended, basis, stiffness.assemble(basis))
        x, y, one = extended(np.stack([*on_disc, np.ones(len(disc_nodes))]))
        zero = np.zeros(mesh.p.shape[1])
        modes = [mesh.p, np.stack([x, y]), np.stack([one, zero]), np.stack([zero, one])]
        if bulge:
            square = (on_disc[0] + 1j * on_disc[1]) ** 2 / (2.0 * radius)
            # The weight keeps the deformation away from the triangles next to the disc.
            extended = partial(self._extended, basis, decaying_stiffness.assemble(basis))
            modes.append(extended(np.stack([square.real, square.imag])))
        self.modes: Array = np.stack(modes)

    def _extended(self, basis: Basis, form: SparseMatrix, values: Array) -> Array:
        """Extensions (k×nodes) of `values` (k×disc nodes) that vanish on the boundary and minimise the energy."""
        free = basis.complement_dofs(np.union1d(basis.get_dofs().all(), self._disc_nodes))
        result = np.zeros((len(values), basis.N))
        result[:, self._disc_nodes] = values
        # `solve` of scikit-fem takes twice the time for each of them.
        inner = sp.csc_array(form[free][:, free])
        factor = splu(inner, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        result[:, free] = factor.solve(-(form[free] @ result.T)).T
        return result

    def weights(self, mu: Array) -> Array:
        """Weights of the modes (4,), or (5,) with a bulge: 1, mu_1 − 1, mu_2, mu_3 and mu_1 mu_4."""
        skew = [mu[0] * mu[3]] if self._bulge else []
        return np.array([1.0, mu[0] - 1.0, mu[1], mu[2], *skew])

    def points(self, mu: Array) -> Array:
        """Nodes (2×nodes) at mu."""
        return np.asarray(np.tensordot(self.weights(mu), self.modes, axes=1))

    def areas(self, triangles: NDArray[np.integer]) -> Array:
        """Areas of triangles (3×t) of the disc relative to mu_1 = 1 and mu_4 = 0, one row per monomial (1×t or 3×t).

        The nodes move linearly in mu_1 and mu_1 mu_4, so an area is exactly Σ_k monomials_k · areas_k.
        """
        (e1, e2), (f1, f2) = (
            (mode[:, triangles[1]] - mode[:, triangles[0]], mode[:, triangles[2]] - mode[:, triangles[0]])
            for mode in (self.modes[0], self.modes[-1])
        )
        unit = cross(e1, e2)
        terms = [unit, cross(e1, f2) + cross(f1, e2), cross(f1, f2)]
        return np.stack(terms if self._bulge else terms[:1]) / unit

    def monomials(self, weights: Array) -> Array:
        """mu_1² (1,), or with a bulge mu_1², mu_1·mu_1 mu_4 and (mu_1 mu_4)² (3,)."""
        scale = 1.0 + weights[1]
        if not self._bulge:
            return np.array([scale**2])
        return np.array([scale**2, scale * weights[4], weights[4] ** 2])
