import numpy as np
import pytest

from vibench_problems.disc_mesh import aspect_ratios, disc_in_square, displaced_around_disc, rings_for


def areas(mesh) -> np.ndarray:
    a, b, c = (mesh.p[:, mesh.t[i]] for i in range(3))
    u, v = b - a, c - a
    return 0.5 * (u[0] * v[1] - u[1] * v[0])


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
