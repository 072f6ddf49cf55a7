from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest
from skfem import Basis, ElementHex1, ElementVector, FacetBasis

from vibench import HighFidelitySolution, HighFidelitySolver, NumericalError
from vibench_problems.cube_shells import graded_block
from vibench_problems.elastic_forms import AXES, dilatation, gradients, products_of_gradients, shearing
from vibench_problems.elliptic_contact import EllipticContact, elliptic_contact
from vibench_problems.far_field import FarField, fields
from vibench_problems.hertz3d import WIDTH, Hertz3D

FLAT = 50.0
"""Factor on radii that leaves the contact and takes away the slopes of the paraboloid."""

MUS = [np.array([1.0, 1.0, 0.00125, 0.3]), np.array([1.3, 0.8, 0.0014, 0.25]), np.array([0.8, 1.2, 0.001, 0.4])]


def flattened(mu: np.ndarray) -> np.ndarray:
    """A parameter of the same contact area, whose normals are vertical up to a fiftieth."""
    return mu * np.array([FLAT, FLAT, 1.0 / FLAT, 1.0])


@cache
def problem(cells: int, **options: str) -> Hertz3D:
    return Hertz3D(21 * cells**3, **options)


@cache
def solver(cells: int, **options: str) -> HighFidelitySolver:
    return HighFidelitySolver(problem(cells, **options))


solved_at = cache(lambda cells, mu, **options: solver(cells, **options).solve(np.array(mu)))


def solved(cells: int, mu: np.ndarray, **options: str) -> HighFidelitySolution:
    return solved_at(cells, tuple(mu), **options)


def excess(cells: int, mu: np.ndarray, **options: str) -> float:
    """Contact force over that of the closed form, minus one."""
    return problem(cells, **options).force(solved(cells, mu, **options).lam) / problem(cells).theory(mu).force - 1.0


def test_round_paraboloids_have_hertz_circular_contact() -> None:
    found = elliptic_contact(2.0, 2.0, 0.003, 5.0)
    a = np.sqrt(2.0 * 0.003)
    assert (found.a, found.b) == pytest.approx((a, a), rel=1e-12)
    assert found.peak == pytest.approx(2.0 * 5.0 * a / (np.pi * 2.0), rel=1e-12)
    assert found.force == pytest.approx(4.0 / 3.0 * 5.0 * np.sqrt(2.0) * 0.003**1.5, rel=1e-12)


def settled(contact: EllipticContact, modulus: float, x: float, y: float) -> float:
    """Boussinesq's integral of the pressure over the distance, in polar coordinates around a point of the ellipse."""
    angles = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    cos, sin = np.cos(angles), np.sin(angles)
    A = (cos / contact.a) ** 2 + (sin / contact.b) ** 2
    B = x * cos / contact.a**2 + y * sin / contact.b**2
    reach = (-B + np.sqrt(B**2 + A * (1.0 - (x / contact.a) ** 2 - (y / contact.b) ** 2))) / A
    nodes, weights = np.polynomial.legendre.leggauss(40)
    t = 0.5 * (nodes + 1.0)
    r = reach * (1.0 - t[:, None] ** 2)  # takes away the root at the end
    integrand = contact.pressure(x + r * cos, y + r * sin) * 2.0 * t[:, None] * reach
    return float((0.5 * weights @ integrand).mean() * 2.0 * np.pi / (np.pi * modulus))


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.5, 0.3), (-0.2, 0.8), (0.9, 0.0)])
@pytest.mark.parametrize("radii", [(1.3, 0.7), (0.7, 1.3), (30.0, 1.0)])
def test_the_pressure_pushes_the_surface_onto_the_paraboloid(radii: tuple[float, float], x: float, y: float) -> None:
    approach, modulus = 0.002, 3.0
    contact = elliptic_contact(*radii, approach, modulus)
    x, y = x * contact.a, y * contact.b
    depth = approach - x**2 / (2.0 * radii[0]) - y**2 / (2.0 * radii[1])
    assert settled(contact, modulus, x, y) == pytest.approx(depth, abs=1e-9 * approach)


def boussinesq(points: np.ndarray, poisson: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacements of a force 4πG on the half-space, and their gradients."""
    values, slopes = fields(points)
    return values[0] + (1.0 - 2.0 * poisson) * values[1], slopes[0] + (1.0 - 2.0 * poisson) * slopes[1]


def difference_quotient(function: Callable[[np.ndarray], np.ndarray], points: np.ndarray, axis: int) -> np.ndarray:
    step = 1e-5 * np.eye(3)[axis][:, None]
    return np.asarray((function(points + step) - function(points - step)) / 2e-5)


def stress(slopes: np.ndarray, poisson: float) -> np.ndarray:
    """σ for G = 1."""
    lame = 2.0 * poisson / (1.0 - 2.0 * poisson)
    return np.asarray(lame * np.trace(slopes) * np.eye(3)[..., None] + slopes + slopes.swapaxes(0, 1))


def traction(points: np.ndarray, poisson: float, axis: int) -> np.ndarray:
    """σ of Boussinesq's field on planes across an axis."""
    return stress(boussinesq(points, poisson)[1], poisson)[:, axis]


def test_fields_have_their_gradients_and_boussinesqs_is_in_equilibrium() -> None:
    points = np.random.default_rng(0).uniform([[0.2], [0.1], [-2.0]], [[2.0], [2.0], [-0.1]], (3, 20))
    for axis in AXES:
        quotients = difference_quotient(lambda x: fields(x)[0], points, axis)
        assert np.allclose(quotients, fields(points)[1][:, :, axis], atol=1e-7)
    for poisson in (0.0, 0.3, 0.45):
        at = partial(traction, poisson=poisson)
        divergence = sum(difference_quotient(partial(at, axis=axis), points, axis) for axis in AXES)
        assert np.allclose(divergence, 0.0, atol=1e-6)
        surface = points * np.array([[1.0], [1.0], [0.0]])
        assert np.allclose(traction(surface, poisson, 2), 0.0, atol=1e-12)


def test_energies_outside_are_the_work_on_the_sides_and_the_force_is_that_of_the_sides() -> None:
    block, poisson = graded_block(6, 6, 0.3, 1.0), 0.3
    field = FarField.around(block.mesh, block.sides, block.far, block.length)
    lame, amplitudes = 2.0 * poisson / (1.0 - 2.0 * poisson), np.array([1.0, 1.0 - 2.0 * poisson])
    basis = FacetBasis(block.mesh, ElementHex1(), facets=block.sides, intorder=8)
    x = np.asarray(basis.global_coordinates())
    u, slopes = boussinesq(x.reshape(3, -1), poisson)
    pulls = np.einsum("abp,bp->ap", stress(slopes, poisson), np.asarray(basis.normals).reshape(3, -1))
    weights = basis.dx.ravel()
    assert pulls[2] @ weights == pytest.approx(4.0 * np.pi / 4.0, rel=1e-6)  # the block hangs on its sides
    work = -np.sum(pulls * u, axis=0) @ weights  # n points out of the block, into the outside
    energy = amplitudes @ (lame * field.divergences + field.strains) @ amplitudes
    assert energy == pytest.approx(work, rel=1e-6)


def test_the_block_is_filled_and_its_zone_and_sides_are_covered() -> None:
    block = graded_block(4, 5, 0.5, 3.0)
    assert block.mesh.t.shape[1] == 4**3 + 5 * 3 * 4**2
    assert Basis(block.mesh, ElementHex1()).dx.sum() == pytest.approx(27.0)
    assert FacetBasis(block.mesh, ElementHex1(), facets=block.zone).dx.sum() == pytest.approx(0.25)
    assert FacetBasis(block.mesh, ElementHex1(), facets=block.sides).dx.sum() == pytest.approx(27.0)
    nodes, triangles = block.surface(0.5)
    x, y, _ = block.mesh.p[:, nodes][:, triangles]
    areas = 0.5 * np.abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))
    assert areas.sum() == pytest.approx(0.25)


def test_forms_by_components_are_those_of_displacements() -> None:
    mesh = graded_block(2, 1, 0.5, 1.0).mesh
    basis = Basis(mesh, ElementVector(ElementHex1()))
    products = products_of_gradients(Basis(mesh, ElementHex1()))
    u, v = np.random.default_rng(0).random((2, 3, mesh.p.shape[1]))
    du, dv = (basis.interpolate(w.T.ravel()).grad for w in (u, v))
    expected = {
        dilatation: np.trace(du) * np.trace(dv),
        shearing: 0.5 * np.sum((du + du.swapaxes(0, 1)) * (dv + dv.swapaxes(0, 1)), axis=(0, 1)),
        gradients: np.sum(du * dv, axis=(0, 1)),
    }
    for form, density in expected.items():
        value = sum(v[j] @ form(products, i, j) @ u[i] for i in AXES for j in AXES)
        assert value == pytest.approx(np.sum(density * basis.dx), rel=1e-12)


@pytest.mark.parametrize("mu", [MUS[2], *(pytest.param(mu, marks=pytest.mark.long) for mu in MUS[:2])], ids=str)
def test_force_axes_peak_and_far_field_agree_with_the_closed_form(mu: np.ndarray) -> None:
    """On the coarse mesh; `results/scripts/three_dimensions.py` has finer ones."""
    found, theory = problem(6).measured(solved(6, mu).lam), problem(6).theory(mu)
    assert abs(excess(6, mu)) < 0.05
    assert (found.a, found.b) == pytest.approx((theory.a, theory.b), rel=0.03)
    assert found.peak == pytest.approx(theory.peak, rel=0.05)
    one, found = problem(6), solved(6, mu)
    shear = one.young / (2.0 * (1.0 + mu[3]))
    k, m = one.amplitudes(found.u)
    assert 4.0 * np.pi * shear * one.block.length * k == pytest.approx(one.force(found.lam), rel=0.02)
    assert m / k == pytest.approx(1.0 - 2.0 * mu[3], abs=0.05)


@pytest.mark.long
def test_the_force_converges_from_above_with_second_order() -> None:
    """Errors of odd and of even numbers of cells lie on two curves: these are even."""
    cells = np.array([2, 4, 6])
    errors = np.array([excess(count, flattened(MUS[1])) for count in cells])
    rates = np.log(errors[:-1] / errors[1:]) / np.log(cells[1:] / cells[:-1])
    assert np.all(errors > 0.0)
    assert np.all(rates > 1.6)


@pytest.mark.parametrize("poisson", [0.2, pytest.param(0.4, marks=pytest.mark.long)])
def test_the_slopes_of_the_paraboloid_act_as_a_first_variation_says(poisson: float) -> None:
    """With slopes s the constraint has −s·u besides: the energy grows by ∫ p s·u, the force by its derivative."""
    mu = np.array([4.0, 4.0, 0.00125 / 4.0, poisson])
    slope = problem(6).theory(mu).a / 4.0
    found = (excess(6, mu) - excess(6, flattened(mu))) / slope
    # The error of the discretisation does not depend on ν; with 8, 10 and 13 cells it is 0.006, 0.0001, 0.003 at 0.3.
    assert found == pytest.approx((1.0 - 2.0 * poisson) / (np.pi * (1.0 - poisson)), abs=0.04)


@pytest.mark.long
def test_a_clamped_far_face_adds_its_share_to_the_force_and_boussinesqs_field_does_not() -> None:
    mu = flattened(MUS[0])
    a, length = problem(6).theory(mu).a, problem(6).block.length
    assert excess(6, mu, far="clamped") - excess(6, mu) == pytest.approx(0.9 * a / length, rel=0.1)
    near, far = Hertz3D(21 * 6**3, distance=8.0), problem(6)
    found = near.force(HighFidelitySolver(near).solve(mu).lam)
    assert found == pytest.approx(far.force(solved(6, mu).lam), rel=3e-3)


def test_exchanged_radii_exchange_the_axes() -> None:
    one, mu = problem(6), MUS[1]
    pressures = []
    for each in (mu, mu[[1, 0, 2, 3]]):
        places = np.round(one.middles / WIDTH, 9)
        grid = np.lexsort(places if each is mu else places[::-1])
        pressures.append(solved(6, each).lam[grid])
    assert np.allclose(*pressures, rtol=1e-9, atol=1e-12)


def test_contact_beyond_the_zone_is_refused() -> None:
    with pytest.raises(NumericalError, match="reaches the end of the potential contact zone"):
        solved(4, np.array([1.3, 1.3, 0.003, 0.3]))


def test_members_are_affine_and_b_truly_varies() -> None:
    one = problem(4)
    assert {name: len(each.terms) for name, each in one.affine.items()} == {"A": 2, "B": 3, "g": 3}
    first, second = (one.assemble(mu) for mu in MUS[:2])
    assert abs(first.B - second.B).max() > 1e-3 * abs(first.B).max()
    assert set(first.B.indices) <= set(one.contact_dofs)


def test_the_picture_shows_the_pressed_surface() -> None:
    one, found = problem(6), solved(6, MUS[0])
    picture = one.picture(MUS[0], found.u, found.lam)
    assert picture.values.min() == pytest.approx(-MUS[0][2], rel=0.05)  # the apex is at δ
    assert picture.points[:, np.argmin(picture.values)] == pytest.approx([0.0, 0.0])
    assert picture.positions[:, np.argmax(picture.multiplier)] == pytest.approx([WIDTH / 12, WIDTH / 12])
