"""Triangulations of a quarter disc, graded towards a zone of its arc that starts at the apex."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import Delaunay
from skfem import MeshTri

from vibench import Array, Indices, Mask

COARSEST = 0.2
"""Largest element size, relative to the radius."""

SKEW = 0.05
"""Displacement along the arc, relative to the depth, that makes the diagonals of aligned layers point one way."""


@dataclass(frozen=True)
class QuarterDisc:
    """A mesh of the quarter of the unit disc with x ≥ 0 and y ≤ 0, centre at the origin, apex at (0, −1).

    Attributes
    ----------
    mesh
        The triangulation.
    zone
        Nodes of the arc from the apex to the end of the zone, in order.
    axis, flat
        Nodes with x = 0 and with y = 0.
    """

    mesh: MeshTri
    zone: Indices
    axis: Indices
    flat: Indices


Triangulation = Literal["staggered", "aligned", "irregular"]
"""How inner nodes and triangles are chosen: every other layer shifted by half a spacing; layers without a shift, cut by
diagonals that all point one way; or staggered, with nodes displaced at random."""

DISPLACED = 0.2
"""Largest displacement of a node of an irregular mesh, relative to its shortest edge."""


def quarter_disc(edges: int, angle: float, growth: float, triangulation: Triangulation = "staggered") -> QuarterDisc:
    """Mesh with `edges` equal edges on the arc 0 ≤ θ ≤ `angle`, layers around it growing by the factor `growth`.

    Inner nodes lie on curves at increasing distances from the zone, with a spacing that matches that of the curves. The
    rest of the boundary is graded by the same size function. The domain is convex, so the Delaunay triangulation of the
    nodes triangulates the domain.

    Parameters
    ----------
    edges
        Number of equal edges on the zone.
    angle
        End of the zone [rad], below π/2.
    growth
        Ratio of the sizes of two successive layers, above 1.
    triangulation
        The boundary nodes are the same for each.
    """
    finest = 2.0 * np.sin(0.5 * angle / edges)

    def size(points: Array) -> Array:
        return np.asarray(np.minimum(finest + (growth - 1.0) * _distance_to_zone(points, angle), COARSEST))

    zone = _on_arc(np.linspace(0.0, angle, edges + 1))
    rest = _on_arc(_graded(angle, 0.5 * np.pi, lambda t: size(_on_arc(t))))
    flat = _graded(0.0, 1.0, lambda s: size(np.column_stack([1.0 - s, np.zeros_like(s)])))
    axis = _graded(0.0, 1.0, lambda s: size(np.column_stack([np.zeros_like(s), -s])))
    flat_points = np.column_stack([1.0 - flat, np.zeros_like(flat)])[1:]
    axis_points = np.column_stack([np.zeros_like(axis), -axis])[1:-1]
    boundary = np.vstack([zone, rest[1:], flat_points, axis_points])
    layers = _layers(angle, finest, growth, size, 0.0 if triangulation == "aligned" else 0.5)
    points, skew = np.vstack([boundary, layers]), SKEW if triangulation == "aligned" else 0.0
    triangles = _triangulate(points, skew)
    for _ in range(4):
        points = _smoothed(points, triangles, len(boundary))
        triangles = _triangulate(points, skew)
    if triangulation == "irregular":
        points = displaced(points, triangles, np.arange(len(points)) >= len(boundary), DISPLACED)
        triangles = _triangulate(points)
    mesh = MeshTri(np.ascontiguousarray(points.T), np.ascontiguousarray(triangles.T))
    return QuarterDisc(
        mesh, np.arange(edges + 1), np.flatnonzero(points[:, 0] == 0.0), np.flatnonzero(points[:, 1] == 0.0)
    )


def _on_arc(theta: Array) -> Array:
    """Points (n×2) of the unit circle at angles from the apex; exact on the axis and on the flat."""
    points = np.column_stack([np.sin(theta), -np.cos(theta)])
    # sin and cos of π/2 are not exact, and the nodes on axis and flat are found by exact comparison with zero.
    points[theta <= 0.0] = (0.0, -1.0)
    points[theta >= 0.5 * np.pi] = (1.0, 0.0)
    return points


def _distance_to_zone(points: Array, angle: float) -> Array:
    """Distances (n,) of points (n×2) from the arc 0 ≤ θ ≤ angle."""
    theta = np.arctan2(points[:, 0], -points[:, 1])
    radial = np.abs(1.0 - np.linalg.norm(points, axis=1))
    end = np.linalg.norm(points - _on_arc(np.array([angle])), axis=1)
    return np.asarray(np.where(theta <= angle, radial, end))


def _graded(start: float, end: float, size: Callable[[Array], Array]) -> Array:
    """Positions from `start` to `end` whose spacing follows `size`."""
    fine = np.linspace(start, end, 20_001)
    density = 1.0 / size(fine)
    count = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(fine))])
    pieces = max(round(count[-1]), 1)
    return np.interp(np.linspace(0.0, count[-1], pieces + 1), count, fine)


def _layers(angle: float, finest: float, growth: float, size: Callable[[Array], Array], shifted: float) -> Array:
    """Inner nodes (n×2) on curves at growing distances from the zone, every other one shifted by a part of a spacing.

    A curve runs from the axis along a smaller arc to the end of the zone and turns around that end to the boundary.
    """
    end = _on_arc(np.array([angle]))[0]
    inwards, onwards = -end, np.array([np.cos(angle), np.sin(angle)])
    layers, distance, shift = [], 0.0, 0.0
    while distance < 1.1:
        distance += np.sqrt(3.0) / 2.0 * min(finest + (growth - 1.0) * distance, COARSEST)
        spacing = min(finest + (growth - 1.0) * distance, COARSEST)
        shift = shifted - shift
        radius = max(1.0 - distance, 0.0)
        along = np.arange(shift * spacing, radius * angle + np.pi * distance, spacing)
        on_arc = along < radius * angle
        turn = (along[~on_arc] - radius * angle) / distance
        directions = np.cos(turn)[:, None] * inwards + np.sin(turn)[:, None] * onwards
        curve = np.vstack([radius * _on_arc(along[on_arc] / max(radius, spacing)), end + distance * directions])
        clear = 0.6 * size(curve)
        inside = (curve[:, 0] > clear) & (curve[:, 1] < -clear) & (np.linalg.norm(curve, axis=1) < 1.0 - clear)
        layers.append(curve[inside & (_distance_to_zone(curve, angle) > 0.9 * distance)])
    return np.vstack(layers)


def _triangulate(points: Array, skew: float = 0.0) -> Indices:
    """Delaunay triangles (k×3), counter-clockwise, without degenerate triangles of collinear nodes.

    A small skew of the nodes decides which diagonal cuts what is nearly a rectangle.
    """
    theta, depth = np.arctan2(points[:, 0], -points[:, 1]), 1.0 - np.linalg.norm(points, axis=1)
    triangles = Delaunay(points + skew * depth[:, None] * np.column_stack([np.cos(theta), np.sin(theta)])).simplices
    a, b, c = (points[triangles[:, k]] for k in range(3))
    twice_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    longest = np.max([np.sum((q - p) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    proper = np.abs(twice_area) > 1e-8 * longest
    triangles, clockwise = triangles[proper], twice_area[proper] < 0.0
    triangles[clockwise] = triangles[clockwise][:, [0, 2, 1]]
    return np.asarray(triangles, dtype=np.intp)


def displaced(points: Array, triangles: Indices, free: Mask, share: float) -> Array:
    """Points (n×2) with the free ones displaced at random by up to `share` of their shortest edge, always the same."""
    edges = np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    shortest = np.full(len(points), np.inf)
    for end in edges.T:
        np.minimum.at(shortest, end, lengths)
    rng = np.random.default_rng(0)
    angle, radius = 2.0 * np.pi * rng.random(len(points)), np.sqrt(rng.random(len(points)))
    steps = share * radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(np.where(free[:, None], points + shortest[:, None] * steps, points))


def neighbour_sums(points: Array, triangles: Indices) -> tuple[Array, Indices]:
    """Sums (n×2) of the neighbours of every node over the triangles around it, and their numbers (n,)."""
    edges = np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = np.vstack([edges, edges[:, ::-1]])
    sums: Array = np.column_stack([np.bincount(edges[:, 0], points[edges[:, 1], d], len(points)) for d in range(2)])
    return sums, np.bincount(edges[:, 0], minlength=len(points))


def _smoothed(points: Array, triangles: Indices, fixed: int) -> Array:
    """One damped Laplacian sweep over the nodes after the first `fixed`: half way to the mean of the neighbours."""
    sums, count = neighbour_sums(points, triangles)
    moved = points.copy()
    moved[fixed:] += 0.5 * (sums / np.maximum(count, 1)[:, None] - points)[fixed:]
    return moved
