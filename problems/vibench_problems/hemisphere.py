"""A mesh of hexahedra of a quarter of a hemisphere, fine around its apex, where its projection is a square grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from skfem import MeshHex

from vibench import Array, Indices
from vibench_problems.cube_shells import GradedBlock, graded_block
from vibench_problems.two_bodies import Shape

EDGE = 0.5
"""Edge of the square that the part with the apex covers, seen from above, relative to the radius."""

PLACES = 9
"""Decimals to which nodes of two parts are the same node, relative to the radius."""

# Where three parts meet on the plane y = 0, all four inside, and three on the flat; near these places angles are 60 to
# 150 degrees.
ON_PLANE, INSIDE, ON_FLAT = (0.38, 0.0, -0.52), (0.36, 0.36, -0.56), (0.42, 0.42, -1.0)

Surface = Callable[[Array, Array], Array]
"""From coordinates in the unit square (p,) and (p,) to points (3×p)."""


def hemisphere(cells: int, layers: int, width: float) -> Shape:
    """The quarter x, y ≥ 0 of the lower half of a ball of radius 1 that hangs from its apex, the origin: −1 ≤ z ≤ 0.

    Its parts are one around the apex, one at the centre, and one at each corner of the base, the flat z = −1.
    That of the apex is a small cube with shells (`graded_block`) under a square of the edge `EDGE`, whose verticals
    begin on the sphere: seen from above, nodes of the surface stay where they are on the block. The other three parts
    have `cells`³ hexahedra each, between a curved or plane side and the part that faces it.

    Parameters
    ----------
    cells, layers
        Cells along the zone, and shells around the small cube.
    width
        Edge of the zone, below `EDGE`.
    """
    block = graded_block(cells, layers, width / EDGE, 1.0)
    apex = _between(_apex_side, _patch((0.0, 0.0, -0.5), ON_PLANE, _swapped(ON_PLANE), INSIDE))
    centre = _between(
        _patch((0.0, 0.0, -0.5), ON_PLANE, _swapped(ON_PLANE), INSIDE),
        _patch((0.0, 0.0, -1.0), (0.55, 0.0, -1.0), (0.0, 0.55, -1.0), ON_FLAT),
    )
    base = _between(_base_side, _patch(ON_PLANE, (0.55, 0.0, -1.0), INSIDE, ON_FLAT))
    grid, hexahedra = _cube(cells)
    parts = [apex(*(block.mesh.p * np.array([[1.0], [1.0], [-1.0]])))]
    parts += [centre(*grid), base(*grid), base(*grid)[[1, 0, 2]]]
    others = [hexahedra + parts[0].shape[1] + number * grid.shape[1] for number in range(3)]
    connected = [block.mesh.t, *others]
    return _joined(np.hstack(parts), np.hstack(connected), block, cells)


def drop(x: Array, y: Array) -> Array:
    """How far the sphere of radius 1 is below its apex at x and y."""
    square = x**2 + y**2
    return np.asarray(square / (1.0 + np.sqrt(1.0 - square)))


def _joined(points: Array, hexahedra: Indices, block: GradedBlock, cells: int) -> Shape:
    """The parts as one mesh: equal nodes are one node, the first of them."""
    _, first, same = np.unique(np.round(points, PLACES), axis=1, return_index=True, return_inverse=True)
    kept = np.sort(first)
    number = np.searchsorted(kept, first)[same.ravel()]
    mesh = MeshHex(np.ascontiguousarray(points[:, kept]), np.ascontiguousarray(number[hexahedra]))
    boundary = mesh.boundary_facets()
    # Nodes of the block come first, those of its cube before all others; y varies faster than x, and z fastest.
    corners = np.arange((cells + 1) ** 3).reshape((cells + 1,) * 3)[:, :, 0]
    inside = np.isin(mesh.facets[:, boundary], corners).all(axis=0)
    facets = boundary[inside]
    middles = block.mesh.p[:2, mesh.facets[:, facets]].mean(axis=1)
    place = np.lexsort(np.round(middles[::-1], PLACES))
    flat = np.flatnonzero(mesh.p[2] < -1.0 + 10.0**-PLACES)
    return Shape(mesh, facets[place], corners.ravel(), mesh.p[0, corners[:, 0]], flat)


def _cube(cells: int) -> tuple[Array, Indices]:
    """Nodes (3×p) of the unit cube with `cells`³ equal cells, and these."""
    block = graded_block(cells, 1, 0.5, 1.0)
    inner = block.mesh.t[:, (block.mesh.t < (cells + 1) ** 3).all(axis=0)]
    nodes = block.mesh.p[:, : (cells + 1) ** 3] * np.array([[2.0], [2.0], [-2.0]])
    return nodes, inner


def _between(upper: Surface, lower: Surface) -> Callable[[Array, Array, Array], Array]:
    """The points on lines from a surface at z = 0 to another one at z = 1."""
    return lambda x, y, z: (1.0 - z) * upper(x, y) + z * lower(x, y)


def _patch(*corners: tuple[float, float, float]) -> Surface:
    """The bilinear surface with corners at (0, 0), (1, 0), (0, 1) and (1, 1)."""
    p, q, r, s = (np.array(corner)[:, None] for corner in corners)
    return lambda x, y: (1.0 - x) * (1.0 - y) * p + x * (1.0 - y) * q + (1.0 - x) * y * r + x * y * s


def _swapped(point: tuple[float, float, float]) -> tuple[float, float, float]:
    return point[1], point[0], point[2]


def _apex_side(x: Array, y: Array) -> Array:
    """The sphere above the square with the edge `EDGE`."""
    return np.stack([EDGE * x, EDGE * y, -drop(EDGE * x, EDGE * y)])


def _base_side(x: Array, y: Array) -> Array:
    """The sphere from the side of this square, x = 0, to the circle around the flat, x = 1, for angles up to π/4."""
    angles = 0.25 * np.pi * y
    circle = np.stack([np.cos(angles), np.sin(angles), np.full_like(y, -1.0)])
    chord = (1.0 - x) * _apex_side(np.ones_like(y), y) + x * circle
    centre = np.array([[0.0], [0.0], [-1.0]])
    return np.asarray(centre + (chord - centre) / np.linalg.norm(chord - centre, axis=0))
