"""Triangulations of the square around a disc, and of a quarter disc."""

import numpy as np
import pytest
from numerics import doubled_areas
from skfem import Mesh

from vibench_problems import disc_mesh
from vibench_problems.disc_mesh import aspect_ratios, disc_in_square, displaced_around_disc, rings_for
from vibench_problems.graded_mesh import Triangulation, quarter_disc


def areas(mesh: Mesh) -> np.ndarray:
    return 0.5 * doubled_areas(mesh.p, mesh.t)


@pytest.mark.parametrize("nodes", [200, 400, 900, 2000, 3594])
def test_the_mesh_is_a_triangulation_of_the_square_that_fits_the_disc(nodes: int) -> None:
    mesh = disc_in_square(nodes, 0.2)
    assert mesh.p.shape[1] == pytest.approx(nodes, rel=0.11 if nodes < 1000 else 0.03)
    area = np.abs(areas(mesh))
    assert area.sum() == pytest.approx(1.0, abs=1e-12)
    disc = mesh.subdomains["disc"]
    rings = rings_for(nodes * np.pi * 0.04)
    polygon = 3 * rings * 0.2**2 * np.sin(2.0 * np.pi / (6 * rings))
    assert area[disc].sum() == pytest.approx(polygon, rel=1e-12)
    assert np.all(np.linalg.norm(mesh.p[:, mesh.t[:, disc]], axis=0) <= 0.2 * (1.0 + 1e-12))
    assert set(np.unique(mesh.t)) == set(range(mesh.p.shape[1]))
    assert aspect_ratios(mesh.p, mesh.t).max() < 2.0


def test_a_mesh_triangulated_once_is_the_one_triangulated_at_every_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    once = disc_in_square(300, 0.2)
    monkeypatch.setattr(disc_mesh, "_are_delaunay", lambda *_: False)
    other = disc_in_square(300, 0.2)
    np.testing.assert_allclose(once.p, other.p, atol=1e-14)
    one, two = ({tuple(sorted(corners)) for corners in mesh.t.T.tolist()} for mesh in (once, other))
    assert one == two
    quads = disc_mesh._quadrilaterals(np.array([[0, 1, 2], [0, 2, 3]]))
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    monkeypatch.undo()
    for x, expected in ((0.9, False), (1.1, True)):  # of the corner 0, on the circle through the others for x = 1
        assert disc_mesh._are_delaunay(square + np.outer([0, 0, 0, 1], [1.0 - x, x - 1.0]), quads) is expected


def test_the_mesh_is_always_the_same() -> None:
    one, two = disc_in_square(700, 0.2), disc_in_square(700, 0.2)
    assert np.array_equal(one.p, two.p)
    assert np.array_equal(one.t, two.t)


@pytest.mark.parametrize("nodes", [200, 900, 3594])
def test_displaced_nodes_leave_the_square_and_the_disc_as_they_are(nodes: int) -> None:
    plain = disc_in_square(nodes, 0.2)
    mesh = displaced_around_disc(plain, 0.2)
    assert np.array_equal(mesh.t, plain.t)
    assert np.array_equal(np.sign(areas(mesh)), np.sign(areas(plain)))
    assert np.abs(areas(mesh)).sum() == pytest.approx(1.0, abs=1e-12)
    boundary = np.abs(plain.p).max(axis=0) >= 0.5
    assert np.array_equal(mesh.p[:, boundary], plain.p[:, boundary])
    circle = np.abs(np.linalg.norm(plain.p, axis=0) - 0.2) < 1e-9
    assert np.linalg.norm(mesh.p[:, circle], axis=0) == pytest.approx(0.2)
    inside = mesh.p[:, mesh.t[:, mesh.subdomains["disc"]]]
    assert np.all(np.linalg.norm(inside, axis=0) <= 0.2 * (1.0 + 1e-9))
    assert np.all(mesh.p[:, ~boundary] != plain.p[:, ~boundary])
    assert aspect_ratios(mesh.p, mesh.t).max() < 2.5


def test_aspect_ratios_of_known_triangles() -> None:
    points = np.array([[0.0, 1.0, 0.5, 0.0], [0.0, 0.0, np.sqrt(3.0) / 2.0, 1.0]])
    triangles = np.array([[0, 0], [1, 1], [2, 3]])
    right = np.sqrt(2.0) * (2.0 + np.sqrt(2.0)) / (2.0 * np.sqrt(3.0))
    assert aspect_ratios(points, triangles) == pytest.approx([1.0, right])


TRIANGULATIONS: tuple[Triangulation, ...] = ("staggered", "aligned", "irregular")


@pytest.mark.parametrize("triangulation", TRIANGULATIONS)
@pytest.mark.parametrize(("edges", "angle", "growth"), [(40, 0.5, 1.3), (90, np.pi / 6.0, 1.36), (60, 0.83, 1.1)])
def test_the_mesh_fills_the_quarter_disc(edges: int, angle: float, growth: float, triangulation: Triangulation) -> None:
    disc = quarter_disc(edges, angle, growth, triangulation)
    p, t = disc.mesh.p, disc.mesh.t
    arc = p[:, np.abs(np.linalg.norm(p, axis=0) - 1.0) < 1e-12]
    theta = np.sort(np.arctan2(arc[0], -arc[1]))
    polygon = 0.5 * np.sin(np.diff(theta)).sum()  # the triangles between the centre and the nodes of the arc
    assert np.abs(areas(disc.mesh)).sum() == pytest.approx(polygon, rel=1e-10)
    assert np.pi / 4.0 - 0.02 < polygon < np.pi / 4.0
    assert set(np.unique(t)) == set(range(p.shape[1]))
    assert aspect_ratios(p, t).max() < 2.5


def test_zone_and_straight_sides_are_exact() -> None:
    disc = quarter_disc(50, 0.6, 1.2)
    zone = disc.mesh.p[:, disc.zone]
    assert zone.shape == (2, 51)
    assert np.array_equal(zone[:, 0], [0.0, -1.0])
    assert zone[:, -1] == pytest.approx([np.sin(0.6), -np.cos(0.6)])
    lengths = np.linalg.norm(np.diff(zone, axis=1), axis=0)
    assert np.allclose(lengths, 2.0 * np.sin(0.006), rtol=1e-12)
    disc = quarter_disc(40, 0.5, 1.3)
    p = disc.mesh.p
    assert np.all(p[0, disc.axis] == 0.0)
    assert np.all(p[1, disc.flat] == 0.0)
    assert {(0.0, 0.0), (0.0, -1.0)} <= set(map(tuple, p[:, disc.axis].T))
    assert {(0.0, 0.0), (1.0, 0.0)} <= set(map(tuple, p[:, disc.flat].T))
    assert p[0].min() == 0.0
    assert p[1].max() == 0.0


def test_slower_growth_gives_more_nodes_and_the_same_zone() -> None:
    coarse, fine = quarter_disc(60, 0.5, 1.5), quarter_disc(60, 0.5, 1.1)
    assert fine.mesh.p.shape[1] > 2 * coarse.mesh.p.shape[1]
    assert np.array_equal(coarse.mesh.p[:, coarse.zone], fine.mesh.p[:, fine.zone])


def test_triangulations_differ_inside_alone() -> None:
    meshes = [quarter_disc(90, 0.5, 1.265, triangulation) for triangulation in TRIANGULATIONS]
    first, *others = meshes
    for other in others:
        assert np.array_equal(first.mesh.p[:, first.zone], other.mesh.p[:, other.zone])
        assert other.mesh.p.shape[1] == pytest.approx(first.mesh.p.shape[1], rel=0.02)
    assert np.array_equal(first.mesh.p[:, first.axis], others[1].mesh.p[:, others[1].axis])
    assert not np.array_equal(first.mesh.p, others[1].mesh.p)
    again = quarter_disc(90, 0.5, 1.265, "irregular")
    assert np.array_equal(again.mesh.p, others[1].mesh.p)


def test_aligned_layers_are_cut_one_way() -> None:
    """Below the zone: seen from a node of it, the diagonals of the first layer all lead to the same side."""

    def diagonals(triangulation: Triangulation) -> np.ndarray:
        disc = quarter_disc(90, 0.5, 1.265, triangulation)
        p, t = disc.mesh.p, disc.mesh.t
        theta = np.arctan2(p[0], -p[1])
        edges = np.hstack([t[[0, 1]], t[[1, 2]], t[[2, 0]]])
        edges = np.hstack([edges, edges[::-1]])
        down = np.isin(edges[0], disc.zone[5:60]) & ~np.isin(edges[1], disc.zone)
        sides = (theta[edges[1]] - theta[edges[0]])[down] / (0.5 / 90)
        return np.sign(np.where(np.abs(sides) > 0.25, sides, 0.0))

    def one_way(sides: np.ndarray) -> float:
        return abs(sides.sum()) / max(np.abs(sides).sum(), 1.0)

    assert one_way(diagonals("aligned")) > 3.0 * one_way(diagonals("staggered"))
