import numpy as np
import pytest
from matplotlib.tri import LinearTriInterpolator, Triangulation
from numerics import doubled_areas, fitted_rate
from skfem import Basis, ElementTriP1, Functional, MeshTri
from skfem.helpers import dot, grad

from vibench.highfidelity import active_set
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.validation import checked_assembly
from vibench_problems.obstacle import Obstacle

CENTRE = np.array([1.0, 0.0, 0.0])
OFF = np.array([1.1, 0.03, -0.02])


@pytest.fixture(scope="module")
def coarse() -> Obstacle:
    return Obstacle("coarse")


def test_sizes_and_resolutions() -> None:
    for resolution, nodes in (("coarse", 400), ("medium", 1200), (2500, 2500), ("paper", 3594)):
        problem = Obstacle(resolution)
        assert problem.nodes == pytest.approx(nodes, rel=0.05)
        boundary = np.abs(problem.mesh.p).max(axis=0) > 0.5 - 1e-9
        assert problem.V.dim == problem.nodes - np.count_nonzero(boundary)
    assert problem.W.dim == pytest.approx(467, rel=0.05)


def test_parameters_of_the_paper(coarse: Obstacle) -> None:
    training = coarse.training_set()
    assert training.shape == (125, 3)
    assert np.array_equal(np.unique(training[:, 0]), np.linspace(0.8, 1.2, 5))
    assert np.allclose(np.unique(training[:, 1]), [-0.05, -0.025, 0.0, 0.025, 0.05])
    assert coarse.validation_set(64, 3).shape == (64, 3)


@pytest.mark.parametrize("mu", [CENTRE, OFF])
def test_the_map_scales_and_shifts_the_disc_and_fixes_the_boundary(coarse: Obstacle, mu: np.ndarray) -> None:
    points, reference = coarse.points(mu), coarse.mesh.p
    disc = coarse.disc_nodes
    assert np.allclose(points[:, disc], mu[0] * reference[:, disc] + mu[1:, None], atol=1e-14)
    boundary = np.abs(reference).max(axis=0) > 0.5 - 1e-9
    assert np.array_equal(points[:, boundary], reference[:, boundary])
    turned = doubled_areas(points, coarse.mesh.t) * doubled_areas(reference, coarse.mesh.t)
    assert np.all(turned > 0.0)  # no triangle is turned over


def test_forms_against_integrals_on_the_mapped_mesh(coarse: Obstacle) -> None:
    vi = checked_assembly(coarse, OFF)
    mesh = MeshTri(coarse.points(OFF), coarse.mesh.t)
    basis = Basis(mesh, ElementTriP1(), intorder=6)
    rng = np.random.default_rng(0)
    v = np.zeros(coarse.nodes)
    v[coarse.free] = rng.standard_normal(len(coarse.free))
    eta = np.zeros(coarse.nodes)
    eta[coarse.disc_nodes] = rng.random(len(coarse.disc_nodes))
    energy = Functional(lambda w: dot(grad(w["z"]), grad(w["z"]))).assemble(basis, z=basis.interpolate(v))
    assert np.isclose(v[coarse.free] @ (vi.A @ v[coarse.free]), energy, rtol=1e-10)
    work = Functional(lambda w: -w["z"]).assemble(basis, z=basis.interpolate(v))
    assert np.isclose(vi.f @ v[coarse.free], work, rtol=1e-10)
    inside = basis.with_elements(np.arange(len(coarse.mesh.subdomains["disc"])))
    coupling = Functional(lambda w: -w["z"] * w["eta"]).assemble(
        inside, z=inside.interpolate(v), eta=inside.interpolate(eta)
    )
    assert np.isclose(eta[coarse.disc_nodes] @ (vi.B @ v[coarse.free]), coupling, rtol=1e-10)

    def psi(w):
        return -1.25 * ((w.x[0] - OFF[1]) ** 2 + (w.x[1] - OFF[2]) ** 2) / OFF[0] ** 2

    bound = Functional(lambda w: -psi(w) * w["eta"]).assemble(inside, eta=inside.interpolate(eta))
    assert np.isclose(eta[coarse.disc_nodes] @ vi.g, bound, rtol=1e-10)


def test_the_norm_is_that_of_equation_44() -> None:
    problem = Obstacle("coarse", length=3.0)
    basis = Basis(problem.mesh, ElementTriP1())
    v = np.zeros(problem.nodes)
    v[problem.free] = np.random.default_rng(0).standard_normal(len(problem.free))
    field = basis.interpolate(v)
    square = Functional(lambda w: w["z"] ** 2 + 9.0 * dot(grad(w["z"]), grad(w["z"]))).assemble(basis, z=field)
    assert np.isclose(float(problem.V.norm(v[problem.free])) ** 2, square, rtol=1e-10)


@pytest.mark.parametrize("mu", [CENTRE, OFF])
def test_the_membrane_lies_on_the_obstacle_where_the_multiplier_is(mu: np.ndarray) -> None:
    problem = Obstacle("paper")
    vi = problem.assemble(mu)
    found = active_set.solve_high_fidelity(vi)
    assert found.fallback == ""
    assert found.residuals.worst <= 1e-10
    u = np.zeros(problem.nodes)
    u[problem.free] = found.u
    points = problem.points(mu)[:, problem.disc_nodes]
    psi = -1.25 * ((points[0] - mu[1]) ** 2 + (points[1] - mu[2]) ** 2) / mu[0] ** 2
    touching = found.lam > 0.0
    distance = np.hypot(points[0] - mu[1], points[1] - mu[2])
    assert distance[touching].max() < 0.7 * 0.2 * mu[0]  # contact well inside the disc
    assert np.abs(u[problem.disc_nodes] - psi)[touching].max() < 0.02**2  # the mesh width squared
    assert 110 <= np.count_nonzero(touching) <= 140  # of 469
    deep = distance < 0.08 * mu[0]
    weights = problem.multiplier_integrals()[deep]
    assert np.isclose(weights @ found.lam[deep] / weights.sum(), 5.0 / mu[0] ** 2 + 1.0, rtol=0.05)  # −Δψ + 1


def test_options_change_what_they_name(coarse: Obstacle) -> None:
    loaded = Obstacle("coarse", load=-2.0, obstacle=-2.5)
    one, two = coarse.assemble(OFF), loaded.assemble(OFF)
    assert np.allclose(two.f, 2.0 * one.f)
    assert np.allclose(two.g, 2.0 * one.g)
    u, v = active_set.solve_high_fidelity(one).u, active_set.solve_high_fidelity(two).u
    assert np.allclose(v, 2.0 * u, atol=1e-12)


def test_displacements_converge_with_order_one_and_multipliers_with_a_half() -> None:
    """Errors of u in V and of λ in L² at the off-centre parameter, against a very fine mesh."""
    fine = Obstacle("fine")
    assert fine.nodes == pytest.approx(14376, rel=0.05)
    vi = active_set.HighFidelitySolver(fine).solve(OFF)
    mesh = MeshTri(fine.points(OFF), fine.mesh.t)
    basis = Basis(mesh, ElementTriP1(), intorder=3)
    inside = basis.with_elements(fine.mesh.subdomains["disc"])
    widths, errors_u, errors_lam = [], [], []
    fine_u, fine_lam = np.zeros(fine.nodes), np.zeros(fine.nodes)
    fine_u[fine.free], fine_lam[fine.disc_nodes] = vi.u, vi.lam
    for nodes in (225, 450, 900, 1800, 3600):
        problem = Obstacle(nodes)
        found = active_set.HighFidelitySolver(problem).solve(OFF)
        u, lam = np.zeros(problem.nodes), np.zeros(problem.nodes)
        u[problem.free], lam[problem.disc_nodes] = found.u, found.lam
        triangles = Triangulation(*problem.points(OFF), problem.mesh.t.T)
        points = (1.0 - 1e-9) * mesh.p  # round-off must not put a node of Γ outside
        difference = fine_u - LinearTriInterpolator(triangles, u)(*points).filled(np.nan)
        field = basis.interpolate(difference)
        square = Functional(lambda w: w["e"] ** 2 + dot(grad(w["e"]), grad(w["e"]))).assemble(basis, e=field)
        jump = inside.interpolate(fine_lam - LinearTriInterpolator(triangles, lam)(*points).filled(np.nan))
        widths.append(1.0 / np.sqrt(problem.nodes))
        errors_u.append(np.sqrt(square))
        errors_lam.append(np.sqrt(Functional(lambda w: w["e"] ** 2).assemble(inside, e=jump)))
    assert 0.9 < fitted_rate(widths, errors_u) < 1.25, errors_u
    assert 0.35 < fitted_rate(widths, errors_lam) < 0.75, errors_lam


@pytest.mark.parametrize(("asymmetric", "ties"), [(False, True), (True, False)])
def test_snapshots_are_tied_by_symmetry_alone(asymmetric: bool, ties: bool) -> None:
    """Obstacles at mirrored centres: on a symmetric mesh their multipliers have the same norm, to round-off."""
    problem = Obstacle("coarse", asymmetric=asymmetric)
    solver = HighFidelitySolver(problem)
    mirrored = np.array([[1.0, x, y] for x in (-0.03, 0.03) for y in (-0.02, 0.02)])
    norms = np.sort([float(problem.W.norm(solver.solve(mu).lam)) for mu in mirrored])
    assert (np.diff(norms) < 1e-9 * norms[0]).all() == ties
    assert (np.diff(norms) < 1e-9 * norms[0]).any() == ties
