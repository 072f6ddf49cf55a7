"""The obstacle problem of the paper: its map, forms and single entries, and what its solutions converge to."""

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest
import qpsolvers
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.tri import LinearTriInterpolator, Triangulation
from numerics import doubled_areas, fitted_rate
from other_problems import Put
from skfem import Basis, ElementTriP1, Functional, MeshTri
from skfem.helpers import dot, grad
from skfem.models.poisson import laplace, unit_load

from vibench import HighFidelitySolver, Problem, VariationalInequality, checked_assembly, solve_high_fidelity
from vibench.highfidelity import active_set
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle
from vibench_problems.p1_entries import LoadEntries, StiffnessEntries
from vibench_problems.radial import Radial

CENTRE = np.array([1.0, 0.0, 0.0])
OFF = np.array([1.1, 0.03, -0.02])
OBSTACLE, SMALL = cache(partial(Obstacle, "coarse")), cache(partial(Obstacle, 200))
seeds = st.integers(0, 10_000)

TRIANGLE = np.array([[[0.0, 4.0, 0.0], [0.0, 0.0, 3.0]], [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
"""By weight: a triangle with legs 4 and 3, and what makes the legs longer by 1."""


def test_sizes_resolutions_and_parameters() -> None:
    for resolution, nodes in (("coarse", 400), ("medium", 1200), (2500, 2500), ("paper", 3594)):
        problem = Obstacle(resolution)
        assert problem.nodes == pytest.approx(nodes, rel=0.05)
        boundary = np.abs(problem.mesh.p).max(axis=0) > 0.5 - 1e-9
        assert problem.V.dim == problem.nodes - np.count_nonzero(boundary)
    assert problem.W.dim == pytest.approx(467, rel=0.05)
    training = OBSTACLE().training_set()
    assert training.shape == (125, 3)
    assert np.array_equal(np.unique(training[:, 0]), np.linspace(0.8, 1.2, 5))
    assert np.allclose(np.unique(training[:, 1]), [-0.05, -0.025, 0.0, 0.025, 0.05])
    assert OBSTACLE().validation_set(64, 3).shape == (64, 3)


@pytest.mark.parametrize("mu", [CENTRE, OFF])
def test_the_map_scales_and_shifts_the_disc_and_fixes_the_boundary(mu: np.ndarray) -> None:
    points, reference = OBSTACLE().points(mu), OBSTACLE().mesh.p
    disc = OBSTACLE().disc_nodes
    assert np.allclose(points[:, disc], mu[0] * reference[:, disc] + mu[1:, None], atol=1e-14)
    boundary = np.abs(reference).max(axis=0) > 0.5 - 1e-9
    assert np.array_equal(points[:, boundary], reference[:, boundary])
    turned = doubled_areas(points, OBSTACLE().mesh.t) * doubled_areas(reference, OBSTACLE().mesh.t)
    assert np.all(turned > 0.0)  # no triangle is turned over


def test_constraints_are_integrals_on_the_mapped_mesh() -> None:
    vi = checked_assembly(OBSTACLE(), OFF)
    mesh = MeshTri(OBSTACLE().points(OFF), OBSTACLE().mesh.t)
    basis = Basis(mesh, ElementTriP1(), intorder=6)
    rng = np.random.default_rng(0)
    v = np.zeros(OBSTACLE().nodes)
    v[OBSTACLE().free] = rng.standard_normal(len(OBSTACLE().free))
    eta = np.zeros(OBSTACLE().nodes)
    eta[OBSTACLE().disc_nodes] = rng.random(len(OBSTACLE().disc_nodes))
    inside = basis.with_elements(OBSTACLE().mesh.subdomains["disc"])
    coupling = Functional(lambda w: -w["z"] * w["eta"]).assemble(
        inside, z=inside.interpolate(v), eta=inside.interpolate(eta)
    )
    assert np.isclose(eta[OBSTACLE().disc_nodes] @ (vi.B @ v[OBSTACLE().free]), coupling, rtol=1e-10)

    def psi(w):
        return -1.25 * ((w.x[0] - OFF[1]) ** 2 + (w.x[1] - OFF[2]) ** 2) / OFF[0] ** 2

    bound = Functional(lambda w: -psi(w) * w["eta"]).assemble(inside, eta=inside.interpolate(eta))
    assert np.isclose(eta[OBSTACLE().disc_nodes] @ vi.g, bound, rtol=1e-10)


def test_a_membrane_between_two_obstacles_is_that_of_an_independent_solver() -> None:
    problem, k = Obstacle(200, ceiling=0.01), len(SMALL().disc_nodes)
    found, vi = HighFidelitySolver(problem).solve(OFF), checked_assembly(problem, OFF)
    # The gap between both bounds, times the integrals of the multiplier functions.
    integrals = np.asarray(vi.B[k:].sum(axis=1)).ravel()
    assert np.allclose(vi.g[:k] + vi.g[k:], 0.01 * integrals, rtol=1e-12)
    assert abs(vi.B[:k] + vi.B[k:]).max() == 0.0
    assert found.lam[:k].any()
    assert found.lam[k:].any()
    u = qpsolvers.solve_qp(vi.A.toarray(), -vi.f, vi.B.toarray(), vi.g, solver="daqp")
    assert np.allclose(found.u, u, atol=1e-8)
    force, area = (output.function for output in problem.outputs[:2])
    assert np.isclose(force(OFF, found.u, found.lam), integrals @ (found.lam[:k] - found.lam[k:]), rtol=1e-12)
    assert np.isclose(area(OFF, found.u, found.lam), integrals @ ((found.lam[:k] > 0.0) | (found.lam[k:] > 0.0)))
    # A ceiling that is out of reach changes nothing.
    high, alone = (HighFidelitySolver(Obstacle(200, ceiling=c)).solve(OFF) for c in (1.0, None))
    assert np.allclose(high.u, alone.u, atol=1e-13)
    assert not high.lam[k:].any()


def test_the_coarser_mesh_knows_both_obstacles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vibench_problems.obstacle.NESTED", 500)
    fine, calls = Obstacle(800, ceiling=0.01), HighFidelitySolver(Obstacle(200, ceiling=0.01)).solve(OFF)
    nested = fine.start(OFF, None)
    above = np.arange(len(calls.lam)) >= len(calls.lam) // 2
    assert np.array_equal(above[nested.nearest], np.arange(fine.W.dim) >= fine.W.dim // 2)


@pytest.mark.parametrize(("obstacle", "value"), [("A", 1.88646121), ("B", 7.27215590)])
def test_energies_of_cutest_between_two_obstacles(obstacle: str, value: float) -> None:
    """OBSTCLAE and OBSTCLBL (Dembo and Tulowitzki) at 100×100 points; edges beside the boundary count half."""
    h, k = 1.0 / 99.0, 98
    slopes = sp.csr_array(sp.diags_array([np.ones(k), -np.ones(k)], offsets=[0, -1], shape=(k + 1, k)))
    K = sp.csr_array(slopes.T @ sp.diags_array(np.r_[0.5, np.ones(k - 1), 0.5]) @ slopes)
    unit = sp.eye_array(k)
    x, y = (values.ravel() for values in np.meshgrid(*[h * np.arange(1, k + 1)] * 2, indexing="ij"))
    lower, upper = np.sin(3.2 * x) * np.sin(3.3 * y), np.full(k * k, 2000.0)
    if obstacle == "B":
        wave = np.sin(9.2 * x) * np.sin(9.3 * y)
        lower, upper = wave**3, wave**2 + 0.02
    A, B = sp.csr_array(sp.kron(K, unit) + sp.kron(unit, K)), sp.eye_array(k * k)
    f, g = np.full(k * k, h * h), np.concatenate([-lower, upper])
    u = solve_high_fidelity(VariationalInequality(A, f, sp.csr_array(sp.vstack([-B, B])), g)).u
    assert 0.5 * u @ (A @ u) - f @ u == pytest.approx(value, abs=2e-8)


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


def test_options_change_what_they_name_and_their_entries() -> None:
    loaded = Obstacle("coarse", load=-2.0, obstacle=-2.5)
    one, two = OBSTACLE().assemble(OFF), loaded.assemble(OFF)
    assert np.allclose(two.f, 2.0 * one.f)
    assert np.allclose(two.g, 2.0 * one.g)
    u, v = active_set.solve_high_fidelity(one).u, active_set.solve_high_fidelity(two).u
    assert np.allclose(v, 2.0 * u, atol=1e-12)
    mu, places = np.array([1.1, 0.02, -0.03]), (np.arange(6), np.zeros(6, np.intp))
    one, two = (Obstacle(200, load=load, obstacle=load) for load in (-1.0, -3.0))
    assert np.allclose(two.sampler({"f": places})(mu)["f"], 3.0 * one.sampler({"f": places})(mu)["f"], rtol=1e-14)
    assert np.allclose(two.affine["g"].at(mu), 3.0 * one.affine["g"].at(mu), rtol=1e-14)


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


@given(seeds, st.sampled_from([0, 1, 20, 1000]))
def test_entries_of_the_obstacle_are_those_of_what_is_assembled(seed: int, count: int) -> None:
    """Some entries or nearly all, several of them twice, diagonal ones and those at the boundary among them."""
    rng, A = np.random.default_rng(seed), SMALL().assemble(SMALL().training_set()[0]).A.tocoo()
    chosen, diagonal = rng.integers(A.nnz, size=count), np.arange(seed % 7, seed % 7 + 3)
    rows, columns = (np.append(places[chosen], diagonal) for places in A.coords)
    of_f = rng.integers(SMALL().V.dim, size=count), np.zeros(count, dtype=np.intp)
    wanted = {"A": (rows, columns), "f": of_f}
    sample = SMALL().sampler(wanted)
    for mu in SMALL().parameters.sample(2, seed):
        found, vi = sample(mu), SMALL().assemble(mu)
        assert set(found) == set(wanted)
        for name, (rows, columns) in wanted.items():
            member = getattr(vi, name)
            exact = member[rows] if member.ndim == 1 else member.toarray()[rows, columns]
            assert np.allclose(found[name], exact, rtol=1e-11, atol=1e-14)


@given(seeds)
def test_forms_are_those_of_a_finite_element_library_and_declared_sums_what_is_assembled(seed: int) -> None:
    mu = OBSTACLE().parameters.sample(1, seed)[0]
    vi, basis = OBSTACLE().assemble(mu), Basis(MeshTri(OBSTACLE().points(mu), OBSTACLE().mesh.t), ElementTriP1())
    free = OBSTACLE().free
    assert abs(vi.A - laplace.assemble(basis)[free][:, free]).max() < 1e-13 * abs(vi.A).max()
    assert np.allclose(vi.f, -unit_load.assemble(basis)[free], rtol=1e-13, atol=0.0)
    assert vi.A.has_canonical_format
    assert abs(OBSTACLE().affine["B"].at(mu) - vi.B).max() <= 1e-15 * abs(vi.B).max()
    assert np.allclose(OBSTACLE().affine["g"].at(mu), vi.g, rtol=1e-14)


@pytest.mark.parametrize("make", [SMALL, cache(partial(Hertz, 300)), cache(partial(Radial, 200))])
@given(seeds)
def test_the_constraint_on_the_contact_is_the_whole_one(make: Callable[[], Problem], seed: int) -> None:
    problem = make()
    mu = problem.parameters.sample(1, seed)[0]
    contact, vi = problem.contact(mu), problem.assemble(mu)
    np.testing.assert_allclose(contact.B.toarray(), vi.B.toarray()[:, problem.contact_dofs], rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(contact.g, vi.g, rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize("names", [("A",), ("f",), ("A", "f"), ()])
def test_only_what_is_wanted_is_evaluated(names: tuple[str, ...]) -> None:
    places = np.array([3, 5]), np.array([3, 5])
    sample = OBSTACLE().sampler(dict.fromkeys(names, places))
    assert sorted(sample(OBSTACLE().parameters.lower)) == sorted(names)


@pytest.mark.parametrize("weights", [(1.0, 0.0), (1.0, 0.5), (2.0, -1.0)])
def test_a_right_triangle_by_hand(weights: tuple[float, float]) -> None:
    """With legs a along x and b along y: ∇φ of the node at the right angle is −(1/a, 1/b), area ab/2."""
    triangles, (a, b) = np.array([[0], [1], [2]]), weights @ np.array([[4.0, 3.0], [1.0, 1.0]])
    exact = 0.5 * np.array([
        [b / a + a / b, -b / a, -a / b],
        [-b / a, b / a, 0.0],
        [-a / b, 0.0, a / b],
    ])  # fmt: skip
    rows, columns = np.indices((3, 3)).reshape(2, -1)
    for order in ([0, 1, 2], [1, 2, 0], [0, 2, 1]):  # the last is clockwise
        found = StiffnessEntries(TRIANGLE, triangles[order], rows, columns)(np.array(weights))
        assert np.allclose(found.reshape(3, 3), exact)
        assert np.allclose(LoadEntries(TRIANGLE, triangles[order], np.arange(3))(np.array(weights)), a * b / 6.0)


def test_what_has_no_contact_or_no_sampler_says_so() -> None:
    problem, mu = Put(cells=20), np.array([0.3, 0.06])
    assert not problem.has_contact
    assert problem.contact(mu) is None
    (B, g), vi = problem.constraint(mu), problem.assemble(mu)
    assert abs(B - vi.B).max() == 0.0
    assert np.array_equal(g, vi.g)
    with pytest.raises(NotImplementedError, match=r"Hertz declares \[\] and has no sampler"):
        Hertz("coarse").sampler({"A": (np.zeros(1, np.intp), np.zeros(1, np.intp))})
