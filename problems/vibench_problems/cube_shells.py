"""A mesh of hexahedra of a large block, fine around one corner: a small cube with shells around it that grow."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from skfem import MeshHex

from vibench import Array, Indices


@dataclass(frozen=True)
class GradedBlock:
    """The block 0 ≤ x, y ≤ L, −L ≤ z ≤ 0.

    Attributes
    ----------
    mesh
        Its hexahedra; third reference coordinates of those of the small cube are zero on their upper sides.
    zone
        Facets (k²,) of the square 0 ≤ x, y ≤ `width` of the surface z = 0 that the small cube has there.
    sides
        Facets of the sides x = L, y = L and z = −L.
    far
        Nodes of these sides, rising.
    width, length
        Edge of the small cube, and L.
    """

    mesh: MeshHex
    zone: Indices
    sides: Indices
    far: Indices
    width: float
    length: float

    def surface(self, extent: float) -> tuple[Indices, Indices]:
        """Nodes (p,) of the surface with x, y ≤ `extent`, and the triangles (3×t) between them, in their numbers."""
        facets = self.mesh.boundary_facets()
        corners = self.mesh.p[:, self.mesh.facets[:, facets]]
        inside = (corners[2] == 0.0).all(axis=0) & (corners[:2] <= extent).all(axis=(0, 1))
        nodes, places = np.unique(quads(self.mesh, facets[inside]).T, return_inverse=True)
        around = places.reshape(4, -1)
        return nodes.astype(np.intp), np.hstack([around[[0, 1, 2]], around[[0, 2, 3]]]).astype(np.intp)


def graded_block(cells: int, layers: int, width: float, length: float) -> GradedBlock:
    """A cube of `cells`³ equal cells and `layers` shells of 3 · `cells`² hexahedra each.

    The shells lie between copies of the cube's three inner sides, scaled about the origin by the powers of one factor.

    Parameters
    ----------
    cells, layers
        Numbers of them.
    width, length
        Edges of the small cube and of the block.
    """
    corners = np.array(list(product(range(cells + 1), repeat=3)))
    number = np.arange(len(corners)).reshape((cells + 1,) * 3)
    shell = np.flatnonzero(corners.max(axis=1) == cells)  # the nodes of the three sides
    scales = (length / width) ** (np.arange(1, layers + 1) / layers)
    unit = np.vstack([corners / cells, *(scale * (corners[shell] / cells) for scale in scales)])
    on_shell = np.full(len(corners), -1)
    on_shell[shell] = np.arange(len(shell))
    quads = np.hstack([_quads(np.take(number, cells, axis)) for axis in range(3)])
    levels = [quads, *(len(corners) + layer * len(shell) + on_shell[quads] for layer in range(layers))]
    inside = np.vstack(
        [number[i : i + cells, j : j + cells, k : k + cells].ravel() for i, j, k in product((0, 1), repeat=3)]
    )
    shells = [np.vstack(pair) for pair in pairwise(levels)]
    # `product` counts corners in another order than the reference hexahedron does.
    order = MeshHex.elem.refdom.p.T.astype(int) @ np.array([4, 2, 1])
    points = np.ascontiguousarray(width * (unit * np.array([1.0, 1.0, -1.0])).T)
    mesh = MeshHex(points, np.ascontiguousarray(np.hstack([inside, *shells])[order]))
    boundary = mesh.boundary_facets()
    nodes = mesh.facets[:, boundary]
    in_zone = (mesh.p[2, nodes] == 0.0).all(axis=0) & (nodes < len(corners)).all(axis=0)
    first_far = len(unit) - len(shell)
    in_sides = (nodes >= first_far).all(axis=0)
    return GradedBlock(mesh, boundary[in_zone], boundary[in_sides], np.arange(first_far, len(unit)), width, length)


def _quads(side: Array) -> Array:
    """Nodes (4×k²) of the squares of a side with the nodes (k + 1)×(k + 1)."""
    return np.vstack([side[:-1, :-1].ravel(), side[:-1, 1:].ravel(), side[1:, :-1].ravel(), side[1:, 1:].ravel()])


def hexahedra(mesh: MeshHex) -> Indices:
    """Nodes (k×8) of the hexahedra in the order of VTK, their volumes positive."""
    reference = mesh.elem.refdom.p.T.astype(int) @ np.array([4, 2, 1])  # the corner x, y, z is 4x + 2y + z
    corners = mesh.t[np.argsort(reference)[[0, 4, 6, 2, 1, 5, 7, 3]]]
    first = mesh.p[:, corners[0]]
    edges = np.stack([mesh.p[:, corners[k]] - first for k in (1, 3, 4)])
    inverted = np.linalg.det(edges.transpose(2, 0, 1)) < 0.0
    return np.asarray(np.where(inverted[:, None], corners[[4, 5, 6, 7, 0, 1, 2, 3]].T, corners.T))


def quads(mesh: MeshHex, facets: Indices) -> Indices:
    """Nodes (k×4) of facets in their order around them, seen from above."""
    corners = mesh.facets[:, facets]
    x, y = mesh.p[:2, corners] - mesh.p[:2, corners].mean(axis=1)[:, None]
    return np.asarray(np.take_along_axis(corners, np.argsort(np.arctan2(y, x), axis=0), axis=0).T)
