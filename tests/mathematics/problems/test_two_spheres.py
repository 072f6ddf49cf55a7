import shutil
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as sla
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls
from skfem import Basis, BilinearForm, ElementHex1, ElementQuad2, ElementVector, FacetBasis, MeshHex, MeshQuad

from vibench import HighFidelitySolver, NumericalError, ParameterBox, RequestError, create
from vibench.offline.compiled import compiled_contact
from vibench_problems.cube_shells import graded_block
from vibench_problems.elastic_forms import interior
from vibench_problems.hemisphere import drop, hemisphere
from vibench_problems.hertz3d import Hertz3D
from vibench_problems.two_bodies import Body, Shape, TwoBodies, hat_integrals
from vibench_problems.two_spheres import TwoSpheres

PUBLISHED = np.array([1.0, 0.08, 0.3])
"""The case SSNV104 of code_aster in units of its radius, 50 mm."""


@cache
def spheres(cells: int, extent: float) -> tuple[TwoSpheres, HighFidelitySolver]:
    one = TwoSpheres(33 * cells**3, extent=extent)
    return one, HighFidelitySolver(one)


@given(*[st.lists(st.floats(0.05, 1.0), min_size=1, max_size=6)] * 2, st.floats(1.0, 2.0))
def test_integrals_of_hats_are_those_of_quadrature(first: list[float], second: list[float], longer: float) -> None:
    cuts, nodes = (np.concatenate([[0.0], np.cumsum(each)]) for each in (first, second))
    nodes *= longer * cuts[-1] / nodes[-1]
    found = hat_integrals(cuts, nodes)
    every = np.unique(np.concatenate([cuts, nodes]))
    middles, widths = 0.5 * (every[1:] + every[:-1]), np.diff(every)  # exact: hats are linear in between
    for j, hat in enumerate(np.eye(len(nodes))):
        values = np.interp(middles, nodes, hat) * widths
        expected = [values[(middles > a) & (middles < b)].sum() for a, b in pairwise(cuts)]
        assert found[:, j] == pytest.approx(expected, abs=1e-14)


def test_grids_that_end_too_early_and_contact_beyond_the_zone_are_refused() -> None:
    with pytest.raises(NumericalError, match=r"ends at x = 0\.9 m, but .* reaches x = 1 m"):
        hat_integrals(np.linspace(0.0, 1.0, 4), np.linspace(0.0, 0.9, 3))
    with pytest.raises(NumericalError, match="reaches the end of the potential contact zone"):
        spheres(4, 0.2)[1].solve(np.array([1.25, 0.15, 0.3]))


def cube(cells: int, edge: float) -> Shape:
    """A cube below its surface, all of which is zone; its lower side does not move vertically."""
    block = graded_block(cells, 1, 0.5, 1.0)
    count = (cells + 1) ** 3
    inner = block.mesh.t[:, (block.mesh.t < count).all(axis=0)]  # the small cube in the block
    mesh = MeshHex(np.ascontiguousarray(2.0 * edge * block.mesh.p[:, :count]), np.ascontiguousarray(inner))
    corners = np.arange(count).reshape((cells + 1,) * 3)[:, :, 0]
    top = mesh.facets_satisfying(lambda x: np.isclose(x[2], 0.0))
    zone = top[np.lexsort(np.round(mesh.p[1::-1, mesh.facets[:, top]].mean(axis=1), 9))]
    flat = np.flatnonzero(np.isclose(mesh.p[2], -edge))
    return Shape(mesh, zone, corners.ravel(), mesh.p[0, corners[:, 0]], flat)


@pytest.mark.parametrize("radius", [0.8, 1.0])
@pytest.mark.parametrize("cells", [(2, 3), (3, 2)])
def test_a_constant_pressure_is_transferred_exactly(cells: tuple[int, int], radius: float) -> None:
    """The patch test: two cubes of the edge 1 m between plates, free at their sides."""
    box = ParameterBox(("radius", "approach", "poisson"), np.array([0.5, 0.0, 0.0]), np.ones(3), ("m", "m", "1"))
    slave, master = cube(cells[0], 1.0), cube(cells[1], 1.0 / radius)
    one = TwoBodies(Body.of(slave, bubbles=True), Body.of(master, bubbles=False), box, young=2.0)
    mu, strain = np.array([radius, 0.01, 0.3]), -0.01 / 2.0
    vi = one.assemble(mu)
    rows = sp.block_array([[vi.A, vi.B.T], [vi.B, None]])  # all are in contact, where the model would refuse
    solution = sla.spsolve(sp.csc_array(rows), np.concatenate([vi.f, vi.g]))
    u, lam = np.split(solution, [one.V.dim])
    assert lam == pytest.approx(np.full(len(one.areas), -2.0 * strain), rel=1e-11)
    lower, upper = one.displacements(mu, u)
    x, y, z = slave.mesh.p
    assert lower == pytest.approx(strain * np.stack([-0.3 * x, -0.3 * y, z + 1.0]), abs=1e-13)
    x, y, z = radius * master.mesh.p
    assert upper == pytest.approx(strain * np.stack([-0.3 * x, -0.3 * y, 1.0 - z]), abs=1e-13)


def test_the_body_above_is_pressed_with_the_same_force() -> None:
    """Hat functions sum to one: the body above gets the load of the facets, at every radius."""
    one, _ = spheres(4, 0.2)
    for radius in (0.8, 0.93, 1.25):
        B = one.contact(np.array([radius, 0.05, 0.3])).B.toarray()
        nodes = len(one.master.contact)
        assert B[:, -nodes:].sum(axis=1) == pytest.approx(one.areas, rel=1e-13)
        assert B[:, : len(one.slave.contact) - len(one.areas)].sum(axis=1) == pytest.approx(one.areas, rel=1e-13)


def test_loads_of_given_pressures_are_those_of_the_assembled_condition() -> None:
    one, _ = spheres(4, 0.2)
    eta = np.random.default_rng(0).random((len(one.areas), 3))
    loads = one.contact_loads(eta)
    for mu in one.parameters.sample(3, seed=1):
        contact, found = one.contact(mu), loads.fixed.copy()
        varying, bound = loads.varying(mu)
        found[loads.first :] += varying
        assert found == pytest.approx(contact.B.T @ eta, abs=1e-15)
        assert bound == pytest.approx(eta.T @ contact.g, abs=1e-15)


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_c_code_has_the_assembled_condition() -> None:
    one, _ = spheres(4, 0.2)
    evaluate = compiled_contact(one.contact_source(), (one.W.dim, len(one.contact_dofs)))
    for mu in [*one.parameters.sample(3, seed=1), one.parameters.lower, one.parameters.upper]:
        contact, found = one.contact(mu), evaluate(mu)
        assert abs(found.B - contact.B).max() <= 2e-15 * abs(contact.B).max()
        assert found.g == pytest.approx(contact.g, rel=0.0, abs=2e-15 * np.abs(contact.g).max())
    assert evaluate(0.1 * one.parameters.lower) is None  # the body above is too small


@pytest.mark.parametrize("width", [0.02, 0.4])
def test_the_mesh_fills_a_quarter_of_the_hemisphere(width: float) -> None:
    shape = hemisphere(4, 3, width)
    mesh = shape.mesh
    determinants = np.sign(mesh.mapping().detDF(Basis(mesh, ElementHex1()).X))
    assert np.all(determinants == determinants[:, :1])
    assert Basis(mesh, ElementHex1()).dx.sum() == pytest.approx(np.pi / 6.0, rel=0.03)
    x, y, z = mesh.p[:, mesh.facets[:, mesh.boundary_facets()]]
    sides = [(x == 0.0), (y == 0.0), np.isclose(z, -1.0), np.isclose(x**2 + y**2 + (z + 1.0) ** 2, 1.0)]
    assert np.any([side.all(axis=0) for side in sides], axis=0).all()  # no face between parts is left open


def test_facets_and_nodes_of_the_zone_are_a_square_grid_on_the_sphere() -> None:
    shape = hemisphere(3, 2, 0.3)
    x, y, z = shape.mesh.p[:, shape.corners].reshape(3, 4, 4)
    grid = np.linspace(0.0, 0.3, 4)
    assert x == pytest.approx(np.repeat(grid[:, None], 4, axis=1))
    assert y == pytest.approx(x.T)
    assert z == pytest.approx(-drop(x, y))
    middles = shape.mesh.p[:2, shape.mesh.facets[:, shape.zone]].mean(axis=1)
    assert middles == pytest.approx(np.stack([np.repeat(grid[:3] + 0.05, 3), np.tile(grid[:3] + 0.05, 3)]))


def test_the_energy_of_a_body_scales_with_its_radius() -> None:
    body = Body.of(hemisphere(2, 1, 0.3), bubbles=False)
    mesh = body.shape.mesh
    larger = interior(MeshHex(1.3 * mesh.p, mesh.t), body.shape.zone[:0], body.restriction)
    for one, other in zip(body.forms, larger, strict=True):
        assert abs(1.3 * one - other).max() < 1e-13


def test_outputs_and_pictures_are_those_of_the_pressure_and_meshes_have_both_bodies_the_right_way_round() -> None:
    one, solver = spheres(4, 0.2)
    mu = np.array([1.2, 0.07, 0.3])
    found = solver.solve(mu)
    fields = one.mesh_fields(mu, found.u, found.lam)
    corners = fields.points[fields.cells["hexahedron"]]
    edges = np.stack([corners[:, k] - corners[:, 0] for k in (1, 3, 4)], axis=1)
    assert np.all(np.linalg.det(edges) > 0.0)
    assert (fields.points[:, 2].min(), fields.points[:, 2].max()) == (-1.0, pytest.approx(1.2))
    moved = fields.at_points["u [m]"][fields.points[:, 2] == 1.2]
    assert moved[:, 2] == pytest.approx(-0.07)
    mu = np.array([1.0, 0.08, 0.3])
    found = solver.solve(mu)
    force = next(output for output in one.outputs if output.name == "contact force")
    assert force.values(mu[None], found.u[:, None], found.lam[:, None]) == pytest.approx(one.force(found.lam))
    picture = one.picture(mu, found.u, found.lam)
    assert picture.values.min() == pytest.approx(-0.5 * mu[1], rel=0.05)  # equal spheres share the approach
    assert picture.positions[:, np.argmax(picture.multiplier)] == pytest.approx(one.middles[:, 0])


@pytest.mark.parametrize(("radius", "poisson"), [(1.0, 0.3), (0.8, 0.4), (1.25, 0.2)])
def test_small_contacts_are_hertz_contacts_of_two_elastic_bodies(radius: float, poisson: float) -> None:
    """Up to the mesh, and to half of a/R, by which the force is larger."""
    one, solver = spheres(5, 0.05)
    mu = np.array([radius, 0.005, poisson])
    lam = solver.solve(mu).lam
    found, theory = one.measured(lam), one.theory(mu)
    assert one.force(lam) == pytest.approx(theory.force, rel=0.05)
    assert (found.a, found.b) == pytest.approx((theory.a, theory.b), rel=0.03)
    assert found.peak == pytest.approx(theory.peak, rel=0.07)


@cache
def section(cells: int, approach: float, poisson: float, width: float) -> tuple[float, float]:
    """Contact force and mean pressure of the innermost ring of equal spheres with E = 1, by other elements.

    Equal spheres touch in a plane that each of them meets like a rigid one. This is a hemisphere against a plane, with
    its rotational symmetry: biquadratic elements on the section y = 0 of the mesh, a constant pressure on each edge.
    """
    solid = hemisphere(cells, 3, width).mesh
    sides = solid.facets[:, solid.boundary_facets()]
    nodes, places = np.unique(sides[:, (solid.p[1, sides] == 0.0).all(axis=0)], return_inverse=True)
    p, quads = solid.p[[0, 2]][:, nodes], places.reshape(4, -1)
    x, z = p[:, quads] - p[:, quads].mean(axis=1)[:, None]
    mesh = MeshQuad(np.ascontiguousarray(p), np.take_along_axis(quads, np.argsort(np.arctan2(z, x), axis=0), axis=0))
    basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=6)
    lame, shear = poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)), 0.5 / (1.0 + poisson)

    def strains(u, r):  # type: ignore[no-untyped-def]
        return u.grad[0, 0], u.grad[1, 1], u[0] / r, np.sqrt(0.5) * (u.grad[0, 1] + u.grad[1, 0])

    @BilinearForm
    def energy(u, v, w):  # type: ignore[no-untyped-def]
        r = w.x[0]
        e, f = strains(u, r), strains(v, r)
        return r * (lame * sum(e[:3]) * sum(f[:3]) + 2.0 * shear * sum(i * j for i, j in zip(e, f, strict=True)))

    top = mesh.facets_satisfying(
        lambda x: (np.hypot(x[0], x[1] + 1.0) > 0.99) & (x[0] < width) & (x[1] > -0.5), boundaries_only=True
    )
    top = top[np.argsort(mesh.p[0, mesh.facets[:, top]].mean(axis=0))]
    facets = FacetBasis(mesh, ElementVector(ElementQuad2()), facets=top, intorder=6)
    r = np.asarray(facets.global_coordinates())[0]
    rings = facets.dx * np.abs(facets.normals[1]) * r
    B = np.zeros((len(top), basis.N))
    for i in range(facets.Nbfun):
        B[np.arange(len(top)), facets.element_dofs[i]] += (np.asarray(facets.basis[i][0])[1] * rings).sum(axis=1)
    g = ((drop(r, 0.0 * r) - 0.5 * approach) * rings).sum(axis=1)
    axis = basis.get_dofs(lambda x: np.isclose(x[0], 0.0)).all(["u^1"])
    flat = basis.get_dofs(lambda x: np.isclose(x[1], -1.0)).all(["u^2"])
    free = np.setdiff1d(np.arange(basis.N), np.concatenate([axis, flat]))
    A = sp.csc_matrix(energy.assemble(basis))[free][:, free]
    S = B[:, free] @ sla.splu(A).solve(B[:, free].T)
    # B u ≤ g with u = −A⁻¹ Bᵀ p: the least squares of the Cholesky factor are nonnegative and the same problem.
    factor = np.linalg.cholesky(S)
    pressure = nnls(factor.T, -np.linalg.solve(factor, g))[0]
    return float(2.0 * np.pi * rings.sum(axis=1) @ pressure), float(pressure[0])


@pytest.mark.long
def test_the_published_case_is_that_of_axisymmetric_elements() -> None:
    """Hertz's theory has 2798 MPa and a = 10 mm; a hemisphere of this size is stiffer, whatever the mesh."""
    one = TwoSpheres("medium", extent=0.2)
    found, theory = HighFidelitySolver(one).solve(PUBLISHED), one.theory(PUBLISHED)
    assert 50.0 * theory.a == pytest.approx(10.0)
    assert 20_000.0 * theory.peak == pytest.approx(2798.0, abs=1.0)
    force, pressure = section(9, PUBLISHED[1], PUBLISHED[2], 0.274)
    assert force / theory.force == pytest.approx(1.125, abs=0.005)
    assert 20_000.0 * pressure == pytest.approx(2910.0, abs=10.0)
    assert one.force(found.lam) == pytest.approx(1.125 * theory.force, rel=0.005)
    assert 20_000.0 * one.measured(found.lam).peak == pytest.approx(2910.0, rel=0.005)
    assert 50.0 * one.measured(found.lam).a == pytest.approx(10.3, abs=0.2)


def test_the_plugin_has_both_obstacles_and_refuses_options_of_the_other() -> None:
    assert type(create("problem", "hertz3d", {"resolution": 1000, "obstacle": "sphere", "extent": 0.1})) is TwoSpheres
    assert type(Hertz3D(1000, obstacle="paraboloid", distance=8.0)) is Hertz3D
    with pytest.raises(RequestError, match="obstacle = 'sphere' has no option 'far'"):
        create("problem", "hertz3d", {"obstacle": "sphere", "far": "clamped"})
    with pytest.raises(RequestError, match="obstacle = 'paraboloid' has no option 'extent'"):
        create("problem", "hertz3d", {"extent": 0.1})
