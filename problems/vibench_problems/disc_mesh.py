"""Triangulations of the square (−½, ½)² that resolve a centred disc, with a prescribed number of nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay
from skfem import MeshTri

from vibench import Array
from vibench_problems.graded_mesh import DISPLACED, displaced, neighbour_sums

SMOOTHING_SWEEPS = 20


def disc_in_square(nodes: int, radius: float) -> MeshTri:
    """Quasi-uniform mesh of (−½, ½)² with about `nodes` nodes, fitted to the disc |x| ≤ radius.

    The disc is a stack of rings, ring k with 6k nodes. Outside it a hexagonal lattice of the same spacing, adjusted to
    meet the number of nodes, is triangulated by Delaunay and smoothed. The disc's nodes come first.

    Parameters
    ----------
    nodes
        Target number of nodes, boundary included; met to within a few per cent.
    radius
        Radius of the disc, below ½.

    Returns
    -------
    MeshTri
        Mesh with the elements of the disc as subdomain "disc" and without named boundaries.

    Raises
    ------
    ValueError
        If the disc's boundary could not be resolved.
    """
    rings = rings_for(nodes * np.pi * radius**2)
    disc_points, disc_triangles = rings_in_disc(rings, radius)
    wanted = nodes - len(disc_points)
    spacing = np.sqrt((1.0 - np.pi * radius**2) / max(wanted, 1) * 2.0 / np.sqrt(3.0))
    outside = _outside(spacing, radius)
    # The estimate ignores the clearance between the lattice and the two boundaries: correct it by the actual count.
    for _ in range(8):
        if abs(len(outside) - wanted) <= 0.01 * nodes:
            break
        spacing *= np.sqrt(len(outside) / wanted)
        outside = _outside(spacing, radius)
    circle = np.arange(len(disc_points) - 6 * rings, len(disc_points))
    points, outer_triangles = _triangulate_around(disc_points, circle, outside, radius)
    triangles = np.vstack([disc_triangles, outer_triangles])
    mesh = MeshTri(np.ascontiguousarray(points.T), np.ascontiguousarray(triangles.T))
    return mesh.with_subdomains({"disc": np.arange(len(disc_triangles))})


def displaced_around_disc(mesh: MeshTri, radius: float) -> MeshTri:
    """The mesh with its nodes displaced at random, those of the circle along it; the square's boundary stays."""
    points, distance = mesh.p.T, np.linalg.norm(mesh.p, axis=0)
    free = np.abs(points).max(axis=1) < 0.5
    moved = displaced(points, mesh.t.T, free, DISPLACED)
    circle = np.abs(distance - radius) < 1e-9
    moved[circle] *= radius / np.linalg.norm(moved[circle], axis=1)[:, None]
    return MeshTri(np.ascontiguousarray(moved.T), mesh.t).with_subdomains(mesh.subdomains)


def rings_for(disc_nodes: float) -> int:
    """Number of rings k whose 1 + 3k(k+1) nodes come closest to `disc_nodes`, at least 2."""
    candidates = np.arange(2, int(np.sqrt(max(disc_nodes, 1.0))) + 4)
    return int(candidates[np.argmin(np.abs(1 + 3 * candidates * (candidates + 1) - disc_nodes))])


def aspect_ratios(points: Array, triangles: NDArray[np.int64]) -> Array:
    """Longest edge over inradius of every triangle, scaled so that an equilateral one has 1.

    Parameters
    ----------
    points
        Nodes (2×n).
    triangles
        Vertices (3×k).

    Returns
    -------
    Array
        (k,) values of h·s/(2√3·area), h the longest edge and s half the perimeter.
    """
    a, b, c = (points[:, triangles[i]] for i in range(3))
    edges = np.stack([np.linalg.norm(b - a, axis=0), np.linalg.norm(c - b, axis=0), np.linalg.norm(a - c, axis=0)])
    area = 0.5 * np.abs(cross(b - a, c - a))
    return np.asarray(edges.max(axis=0) * edges.sum(axis=0) / (4.0 * np.sqrt(3.0) * area))


def cross(u: Array, v: Array) -> Array:
    """Cross products (k,) of plane vectors (2×k)."""
    return np.asarray(u[0] * v[1] - u[1] * v[0])


def rings_in_disc(rings: int, radius: float) -> tuple[Array, NDArray[np.int64]]:
    """Nodes (n×2), ring by ring from the centre, and triangles (k×3), six congruent sectors."""
    points = [np.zeros((1, 2))]
    for k in range(1, rings + 1):
        angle = 2.0 * np.pi * np.arange(6 * k) / (6 * k)
        points.append(radius * k / rings * np.column_stack([np.cos(angle), np.sin(angle)]))

    def node(ring: int, position: int) -> int:
        return 0 if ring == 0 else 1 + 3 * ring * (ring - 1) + position % (6 * ring)

    triangles = []
    for k in range(1, rings + 1):
        for sector in range(6):
            for i in range(k):
                inner, outer = sector * (k - 1) + i, sector * k + i
                triangles.append((node(k - 1, inner), node(k, outer), node(k, outer + 1)))
                if i < k - 1:
                    triangles.append((node(k - 1, inner), node(k, outer + 1), node(k - 1, inner + 1)))
    return np.vstack(points), np.array(triangles, dtype=np.int64)


def _outside(spacing: float, radius: float) -> Array:
    """Nodes (n×2) outside the disc: the square's boundary first, then a hexagonal lattice kept clear of both."""
    per_side = max(round(1.0 / spacing), 2)
    side = np.linspace(-0.5, 0.5, per_side + 1)[:-1]
    one = np.full(per_side, 0.5)
    boundary = np.vstack([np.column_stack(p) for p in ((side, -one), (one, side), (-side, one), (-one, -side))])
    rows = np.arange(-int(1.0 / spacing) - 2, int(1.0 / spacing) + 3)
    x, y = np.meshgrid(rows.astype(float), rows.astype(float))
    lattice = np.column_stack([(x + 0.5 * (y % 2)).ravel(), (np.sqrt(3.0) / 2.0 * y).ravel()]) * spacing
    clear = (np.abs(lattice).max(axis=1) < 0.5 - 0.5 * spacing) & (
        np.linalg.norm(lattice, axis=1) > radius + 0.7 * spacing
    )
    return np.vstack([boundary, lattice[clear]])


def _triangulate_around(
    disc_points: Array, circle: NDArray[np.int64], outside: Array, radius: float
) -> tuple[Array, NDArray[np.int64]]:
    """All nodes, those outside smoothed, and the triangles (k×3) between the circle and the square's boundary."""
    points = np.vstack([disc_points, outside])
    used = np.concatenate([circle, np.arange(len(disc_points), len(points))])
    fixed = np.zeros(len(points), dtype=bool)
    fixed[: len(disc_points)] = True
    fixed |= np.abs(points).max(axis=1) >= 0.5
    triangles = _delaunay_annulus(points, used, radius)
    smooth = points
    for _ in range(SMOOTHING_SWEEPS):
        smooth = _smoothed(smooth, triangles, fixed)
    if not _are_delaunay(smooth, _quadrilaterals(triangles)):
        # The lattice is so regular that this is rare.
        if len(points) < 100_000:
            smooth = points
            for _ in range(SMOOTHING_SWEEPS):
                smooth = _smoothed(smooth, triangles, fixed)
                triangles = _delaunay_annulus(smooth, used, radius)
        else:  # a dozen edges of millions differ
            triangles = _delaunay_annulus(smooth, used, radius)
    points = smooth
    ring = np.sort(np.column_stack([circle, np.roll(circle, -1)]), axis=1)
    edges = np.sort(np.vstack([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    boundary = {tuple(edge) for edge in unique[count == 1]}
    if not all(tuple(edge) in boundary for edge in ring):
        raise ValueError("the mesh does not resolve the boundary of the disc")
    return points, triangles


def _delaunay_annulus(points: Array, used: NDArray[np.int64], radius: float) -> NDArray[np.int64]:
    """Delaunay triangles (k×3) of the points `used` that lie outside the disc, counter-clockwise."""
    triangles = used[Delaunay(points[used]).simplices]
    corners = points[triangles]
    # Delaunay fills the convex hull: triangles with all corners on the circle cover the disc, which has its own mesh.
    inside = np.all(np.linalg.norm(corners, axis=2) < radius * (1.0 + 1e-9), axis=1)
    triangles = triangles[~inside]
    a, b, c = (points[triangles[:, i]].T for i in range(3))
    twice_area = cross(b - a, c - a)
    proper = np.abs(twice_area) > 1e-12  # collinear nodes on a side of the square give slivers
    triangles = triangles[proper]
    flip = twice_area[proper] < 0.0
    triangles[flip] = triangles[flip][:, [0, 2, 1]]
    return np.asarray(triangles, dtype=np.int64)


def _quadrilaterals(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Corners p, a, b, q (k×4) of all pairs of counter-clockwise triangles p a b and q b a with a common edge a b."""
    edges = np.sort(triangles[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    same = np.flatnonzero((edges[order[1:]] == edges[order[:-1]]).all(axis=1))
    triangle, corner = np.divmod(order[same], 3)
    a, b = (triangles[triangle, (corner + i) % 3] for i in (1, 2))
    return np.column_stack([triangles.ravel()[order[same]], a, b, triangles.ravel()[order[same + 1]]])


def _are_delaunay(points: Array, quads: NDArray[np.int64]) -> bool:
    """Whether no q is inside the circle through p, a, b; round-off in it is left to Qhull."""
    p, a, b, q = points.T[:, quads.T].swapaxes(0, 1)
    u, v, w = p - q, a - q, b - q
    terms = [np.sum(x**2, axis=0) * cross(y, z) for x, y, z in ((u, v, w), (v, w, u), (w, u, v))]
    return bool(np.all(sum(terms) < -1e-9 * np.sum(np.abs(terms), axis=0)))


def _smoothed(points: Array, triangles: NDArray[np.int64], fixed: NDArray[np.bool_]) -> Array:
    """One Laplacian sweep: every free node moves to the mean of its neighbours."""
    sums, count = neighbour_sums(points, triangles)
    moved = points.copy()
    free = ~fixed & (count > 0)
    moved[free] = sums[free] / count[free, None]
    return moved
