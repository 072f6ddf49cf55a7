"""The obstacle problem whose disc may bulge: a map that is not affine on the disc."""

from functools import cache, partial
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerics import doubled_areas
from skfem import Basis, ElementTriP1, LinearForm, MeshTri
from skfem.helpers import dot
from skfem.models.poisson import laplace, mass

from vibench import HighFidelitySolver, Stop
from vibench.model.affine import Evaluation, affine_decomposition
from vibench.offline.reduction import Reduction, high_fidelity_sweep
from vibench.reduction.supremizers import constraint_classes, supremizers
from vibench_problems.disc_mesh import aspect_ratios
from vibench_problems.obstacle import RADIUS, Obstacle
from vibench_strategies.mcpg import ModifiedCPG
from vibench_strategies.offline_pga import OfflinePGA

EGG, ROUND = cache(partial(Obstacle, "coarse", bulge=True)), cache(partial(Obstacle, "coarse"))
OFF = np.array([1.1, 0.03, -0.02, 0.25])
seeds = st.integers(0, 10_000)


def corners() -> list[np.ndarray]:
    box = EGG().parameters
    return [np.array(mu) for mu in product(*zip(box.lower, box.upper, strict=True))]


@given(seeds)
def test_forms_are_those_assembled_on_the_moved_mesh(seed: int) -> None:
    """Everything anew on the mesh with its nodes moved; ψ is a function of the reference point, in the same rule."""
    mu = EGG().parameters.sample(1, seed)[0]
    vi, disc = EGG().assemble(mu), EGG().mesh.subdomains["disc"]
    moved = MeshTri(EGG().points(mu), EGG().mesh.t, sort_t=False, validate=False)
    basis = Basis(moved, ElementTriP1())
    inside = basis.with_elements(disc)
    reference = Basis(EGG().mesh, ElementTriP1(), elements=disc)
    points = np.asarray(reference.global_coordinates())
    bound = LinearForm(lambda v, w: 1.25 * dot(w["at"], w["at"]) * v).assemble(inside, at=points)
    coupling = -mass.assemble(inside)[EGG().disc_nodes][:, EGG().free]
    for found, exact in (
        (vi.A, laplace.assemble(basis)[EGG().free][:, EGG().free]),
        (vi.B, coupling),
        (vi.f, -LinearForm(lambda v, _: v).assemble(basis)[EGG().free]),
        (vi.g, bound[EGG().disc_nodes]),
    ):
        assert abs(found - exact).max() <= 1e-12 * abs(exact).max()


@given(seeds)
def test_what_is_assembled_in_parts_is_the_whole(seed: int) -> None:
    rng, mu = np.random.default_rng(seed), EGG().parameters.sample(1, seed)[0]
    vi, contact, dofs = EGG().assemble(mu), EGG().contact(mu), EGG().contact_dofs
    B = vi.B.toarray()
    assert np.array_equal(contact.B.toarray(), B[:, dofs])
    assert not np.any(np.delete(B, dofs, axis=1))
    assert np.array_equal(contact.g, vi.g)
    A = vi.A.tocoo()
    chosen, zero = rng.integers(A.nnz, size=30), np.zeros(30, dtype=np.intp)
    wanted = {"A": (A.coords[0][chosen], A.coords[1][chosen]), "f": (rng.integers(EGG().V.dim, size=30), zero)}
    found = EGG().sampler(wanted)(mu)
    for name, (i, j) in wanted.items():
        exact = getattr(vi, name)
        exact = exact[i] if exact.ndim == 1 else exact.toarray()[i, j]
        assert np.allclose(found[name], exact, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("mu", [OFF, np.array([0.8, -0.05, 0.05, -0.3])])
def test_the_map_is_conformal_on_the_disc_and_fixes_the_boundary(mu: np.ndarray) -> None:
    points, reference = EGG().points(mu), EGG().mesh.p
    z = reference[0] + 1j * reference[1]
    image = mu[0] * (z + mu[3] * z**2 / (2.0 * RADIUS)) + mu[1] + 1j * mu[2]
    disc = EGG().disc_nodes
    assert np.allclose(points[0, disc] + 1j * points[1, disc], image[disc], atol=1e-14)
    boundary = np.abs(reference).max(axis=0) > 0.5 - 1e-9
    assert np.array_equal(points[:, boundary], reference[:, boundary])
    triangles = EGG().mesh.t[:, EGG().mesh.subdomains["disc"]]
    assert aspect_ratios(points, triangles).max() < 1.1 * aspect_ratios(reference, triangles).max()


def test_no_triangle_turns_over_or_degenerates_in_the_whole_box() -> None:
    """With a boundary that stays this makes the map injective."""
    for mu in (*corners(), *EGG().parameters.sample(50, 0)):
        ratio = doubled_areas(EGG().points(mu), EGG().mesh.t) / doubled_areas(EGG().mesh.p, EGG().mesh.t)
        assert ratio.min() > 0.3, mu
        assert EGG().diagnostics(mu)["aspect_ratio"] < 3.2, mu


@pytest.mark.parametrize("bulge", [-0.3, 0.1, 0.3])
def test_integrals_over_the_egg_are_known(bulge: float) -> None:
    """∫ |1 + s z/r̂|² over the disc is πr̂²(1 + s²/2), with |z|² in it πr̂⁴(1/2 + s²/3)."""
    mu = np.array([1.2, 0.01, 0.02, bulge])
    egg, disc = EGG().contact(mu), EGG().contact(np.array([1.0, 0.0, 0.0, 0.0]))
    assert egg.B.sum() / disc.B.sum() == pytest.approx(1.44 * (1.0 + bulge**2 / 2.0), rel=4e-3)
    assert egg.g.sum() / disc.g.sum() == pytest.approx(1.44 * (1.0 + bulge**2 / 1.5), rel=4e-3)


def test_constraints_and_supremizers_truly_vary_with_the_bulge_alone() -> None:
    for problem, rank, classes in ((EGG(), 3, 5), (ROUND(), 1, 1)):
        matrices = [problem.assemble(mu).B for mu in problem.training_set()[::7]]
        stacked = np.stack([matrix.toarray().ravel() for matrix in matrices])
        assert np.linalg.matrix_rank(stacked, rtol=1e-10) == rank
        assert len(constraint_classes(matrices).representatives) == classes
    eta = np.eye(EGG().W.dim)[:, :5]
    representers = [supremizers(EGG().V, EGG().assemble(mu).B, eta) for mu in corners()]
    assert np.linalg.matrix_rank(np.hstack(representers), rtol=1e-8) > np.linalg.matrix_rank(representers[0]) == 5


@pytest.mark.long
def test_online_and_offline_enrichment_differ() -> None:
    added = {}
    for problem in (EGG(), ROUND()):
        reduction = Reduction(problem, ModifiedCPG(), OfflinePGA(), Stop(size=8), Stop(size=8), tolerance=1e-3)
        reduction = reduction.given(snapshots=high_fidelity_sweep(problem, problem.training_set()[::3]))
        assert reduction.multipliers.rank == 8
        added[problem] = reduction.enrichment.vectors
    assert added[EGG()].shape[1] > 8 >= added[ROUND()].shape[1]  # online supremizers are 8 at every parameter


@pytest.mark.long
def test_members_are_sums_of_few_terms() -> None:
    """B and g exactly, f as a polynomial, A to what interpolation leaves between the training parameters."""
    members = affine_decomposition(EGG(), EGG().training_set(), 1e-6)
    ways = dict.fromkeys("Af", Evaluation.INTERPOLATED) | dict.fromkeys("Bg", Evaluation.AFFINE)
    assert {name: member.way for name, member in members.items()} == ways
    assert [len(members[name].terms) for name in "Bg"] == [3, 3]
    sample = EGG().sampler({name: (members[name].rows, members[name].columns) for name in "Af"})
    for mu in EGG().parameters.sample(3, 1):
        vi, theta = EGG().assemble(mu), {**sample(mu), **{name: EGG().affine[name].coefficients(mu) for name in "Bg"}}
        for name, tolerance in (("A", 1e-4), ("f", 1e-10), ("B", 1e-14), ("g", 1e-14)):
            exact = getattr(vi, name)
            found = sum(t * term for t, term in zip(theta[name], members[name].terms, strict=True))
            assert abs(found - exact).max() <= tolerance * abs(exact).max(), name


def test_the_pressure_is_that_of_the_obstacle_carried_along() -> None:
    """In the contact λ = 1 − Δψ, and Δψ is −5/|h'|² as h is conformal."""
    problem = Obstacle("paper", bulge=True)
    solver = HighFidelitySolver(problem)
    for mu in (OFF, np.array([0.9, -0.02, 0.04, -0.3])):
        found = solver.solve(mu)
        assert found.residuals.worst <= 1e-10
        z = (problem.mesh.p[0] + 1j * problem.mesh.p[1])[problem.disc_nodes]
        assert np.abs(z[found.lam > 0.0]).max() < 0.7 * RADIUS  # contact well inside the disc
        exact = 1.0 + 5.0 / (mu[0] * np.abs(1.0 + mu[3] * z / RADIUS)) ** 2
        weights, deep = -problem.contact(mu).B.sum(axis=0), np.abs(z) < 0.3 * RADIUS
        sides = [deep & (mu[3] * z.real < -1e-9), deep & (mu[3] * z.real > 1e-9)]
        carried, expected = ([weights[k] @ p[k] / weights[k].sum() for k in sides] for p in (found.lam, exact))
        assert carried == pytest.approx(expected, rel=0.04)
        assert expected[0] > 1.1 * expected[1]  # lengths are shorter on one side, so the obstacle is steeper
        picture = problem.picture(mu, found.u, found.lam)
        assert np.array_equal(picture.positions, problem.points(mu)[:, problem.disc_nodes])


def test_without_a_bulge_it_is_the_problem_of_the_paper() -> None:
    for mu in EGG().parameters.sample(3, 2):
        one, two = EGG().assemble(np.append(mu[:3], 0.0)), ROUND().assemble(mu[:3])
        for name in ("A", "f", "B", "g"):
            exact = getattr(two, name)
            assert abs(getattr(one, name) - exact).max() <= 1e-13 * abs(exact).max()
    disc = ROUND()
    form, outside = laplace.assemble(Basis(disc.mesh, ElementTriP1())), np.setdiff1d(disc.free, disc.disc_nodes)
    assert np.abs(form[outside] @ (disc.points(OFF[:3]) - disc.mesh.p).T).max() < 1e-13  # harmonic outside the disc
    assert EGG().parameters.names == ("scale", "centre_x", "centre_y", "bulge")
    assert EGG().training_set().shape == (320, 4)
    assert EGG().validation_set(5, 1).shape == (5, 4)
    assert np.array_equal(EGG().V.matrix.data, ROUND().V.matrix.data)
    assert np.array_equal(EGG().W.matrix.data, ROUND().W.matrix.data)
