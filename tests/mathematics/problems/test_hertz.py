"""Hertz contact of two discs, at a fixed approach and at one that is a parameter, and its coupling of meshes."""

import shutil
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from vibench import HighFidelitySolver, NumericalError, solve_high_fidelity
from vibench.model.affine import Evaluation, affine_decomposition
from vibench.offline.compiled import compiled_contact
from vibench.reduction.supremizers import constraint_classes, proportionality
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import measured, theory
from vibench_problems.mortar import Pairing

RADII = (0.7, 1.0, 1.3)


def differences(problem: Hertz, solver: HighFidelitySolver, mu: float) -> tuple[float, float]:
    """Relative differences of half-width and peak pressure from the theory of line contact."""
    found = solver.solve(np.array([mu]))
    return measured(problem, np.array([mu]), found.lam).differences(theory(problem, np.array([mu]), found.u))


@pytest.fixture(scope="module")
def coarse() -> Hertz:
    return Hertz("coarse")


def test_sizes_and_resolutions() -> None:
    for resolution, nodes in (("coarse", 1000), (2000, 2000), (4000, 4000)):
        assert Hertz(resolution).nodes == pytest.approx(nodes, rel=0.05)
    problem = Hertz("paper")
    assert problem.nodes == pytest.approx(6130, rel=0.03)
    assert problem.W.dim == 280
    assert len(problem.slave.zone) == 561
    assert problem.training_set().ravel() == pytest.approx(0.7 + 0.0075 * np.arange(81))


@pytest.mark.long
def test_small_loads_agree_with_the_theory_and_larger_ones_less() -> None:
    problem = Hertz(3065, growth=1.05, approach=0.01)
    assert problem.W.dim == 140
    solver = HighFidelitySolver(problem)
    for mu in RADII:
        assert np.abs(differences(problem, solver, mu)).max() < 0.005
    before = np.full(2, 0.05)
    for approach in (0.09, 0.045, 0.02):
        problem = Hertz(3065, growth=1.2, approach=approach)
        errors = np.abs(differences(problem, HighFidelitySolver(problem), 1.0))
        assert np.all(errors < before)
        before = errors


@pytest.mark.parametrize("options", [{}, {"flats": "clamped"}, {"approach": "parameter"}], ids=str)
@pytest.mark.parametrize("point", [(0.7, 0.075), (1.0, 0.15), (1.3, 0.09)], ids=str)
def test_equilibrium_and_no_interpenetration(options: dict[str, Any], point: tuple[float, float]) -> None:
    problem = Hertz("coarse", **options)
    mu = np.array(point)[: problem.parameters.dim]
    found, vi, moving = HighFidelitySolver(problem).solve(mu), problem.assemble(mu), mu[1] if len(mu) > 1 else 0.09
    assert found.residuals.worst <= 1e-10
    upper, lower = problem.resultants(mu, found.u)
    assert upper == pytest.approx(lower, rel=1e-8)
    assert upper == pytest.approx(problem.macro_lengths @ found.lam, rel=1e-8)
    assert np.max((vi.B @ found.u - vi.g) / problem.macro_lengths) < 1e-10
    assert np.all(found.lam >= 0.0)
    moved = problem.displacement(mu, found.u)
    second = problem.slave.mesh.p.shape[1]
    assert np.allclose(moved[1, problem.slave.flat], -moving)
    assert np.allclose(moved[1, second + problem.master.flat], moving)
    assert np.allclose(moved[0, problem.slave.axis], 0.0)
    assert np.allclose(moved[0, problem.slave.flat], 0.0) == ("flats" in options)
    points = problem.picture(mu, found.u, found.lam).points
    assert (points[1].min(), points[1].max()) == pytest.approx((moving - mu[0], 1.001 - moving))


def test_a_and_f_are_constant_and_b_truly_varies(coarse: Hertz) -> None:
    one, two = (coarse.assemble(np.array([mu])) for mu in (0.8, 1.1))
    assert coarse.constant == {"A", "f"}
    assert abs(one.A - two.A).max() == 0.0
    assert np.array_equal(one.f, two.f)
    assert proportionality(one.B, two.B) is None
    assert not np.allclose(one.g, two.g)


def test_condensed_and_sparse_solutions_agree_and_loads_scale_with_youngs_modulus(coarse: Hertz) -> None:
    mu = np.array([0.93])
    condensed, sparse = HighFidelitySolver(coarse).solve(mu), solve_high_fidelity(coarse.assemble(mu))
    assert np.allclose(condensed.u, sparse.u, atol=1e-12)
    assert np.allclose(condensed.lam, sparse.lam, atol=1e-9)
    stiff = HighFidelitySolver(Hertz("coarse", young=30.0)).solve(mu)
    assert np.allclose(condensed.u, stiff.u, atol=1e-12)
    assert np.allclose(2.0 * condensed.lam, stiff.lam, rtol=1e-8)


def test_contact_beyond_the_zone_and_pairing_beyond_the_disc_are_refused(coarse: Hertz) -> None:
    with pytest.raises(NumericalError, match="reaches the end of the potential contact zone"):
        HighFidelitySolver(Hertz("coarse", approach=0.3)).solve(np.array([1.0]))
    with pytest.raises(NumericalError, match="the radius of disc 2 is too small"):
        coarse.assemble(np.array([0.6]))
    # From where each flat moves by 0.22 m and more: what Benaceur's grid would be if d were that.
    solver = HighFidelitySolver(LOADED())
    solver.solve(np.array([1.125, 0.2]))
    with pytest.raises(NumericalError, match=r"at mu = \[1.125, 0.25\]: the contact reaches the end of the potential"):
        solver.solve(np.array([1.125, 0.25]))
    slave, master = polygons(1)
    with pytest.raises(NumericalError, match=r"the pairing ends at x = .* the radius of disc 2 is too small"):
        coupling(slave, 0.5 * master, "exact")


def test_the_picture_shows_deformed_discs_and_pressures(coarse: Hertz) -> None:
    mu = np.array([1.2])
    found = HighFidelitySolver(coarse).solve(mu)
    picture = coarse.picture(mu, found.u, found.lam)
    assert picture.points.shape == (2, coarse.nodes)
    assert picture.triangles.max() == coarse.nodes - 1
    assert picture.positions.shape == (1, 45)
    assert picture.positions[0, np.argmax(picture.multiplier)] < 0.1


@pytest.mark.parametrize("options", [{}, {"quadrature": 3}, {"approach": "parameter"}, {"ratio": 2.0}], ids=str)
@pytest.mark.parametrize("rows", [slice(0, 1), slice(3, 11), slice(None), slice(0)], ids=str)
def test_loads_of_multipliers_are_those_of_the_matrix_at_every_radius(options: dict[str, Any], rows: slice) -> None:
    problem = Hertz(resolution="coarse", **options)
    eta = np.zeros((problem.W.dim, 3))
    eta[rows] = np.random.default_rng(0).random(eta[rows].shape)
    loads = problem.contact_loads(eta)
    slaves = len(problem.slave.zone)
    for radius in (0.68, 0.7, 0.93, 1.0, 1.3, 4.0):  # the first and the last are outside the box
        mu = np.array([radius, 0.11])[: problem.parameters.dim]
        contact, (varying, bounds) = problem.contact(mu), loads.varying(mu)
        expected = contact.B.T @ eta
        assert np.allclose(loads.fixed[:slaves], expected[:slaves], rtol=0.0, atol=1e-16)
        assert not loads.fixed[slaves:].any()
        assert len(varying) <= loads.reach
        assert np.allclose(varying, expected[slaves : slaves + len(varying)], rtol=0.0, atol=1e-16)
        assert not expected[slaves + len(varying) :].any()
        assert np.allclose(bounds, eta.T @ contact.g, rtol=1e-13, atol=1e-16)
    with pytest.raises(NumericalError, match="the radius of disc 2 is too small"):
        loads.varying(np.array([0.5, 0.11])[: problem.parameters.dim])


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize("options", [{}, {"quadrature": 3, "ratio": 3.0}, {"approach": "parameter"}], ids=str)
def test_c_code_has_the_constraint_at_every_radius(options: dict[str, Any]) -> None:
    problem = Hertz(300, **options)
    evaluate = compiled_contact(problem.contact_source(), (problem.W.dim, len(problem.contact_dofs)))
    for radius in (0.68, 0.7, 0.93, 1.0, 1.3, 4.0):  # the first and the last are outside the box
        mu = np.array([radius, 0.11])[: problem.parameters.dim]
        contact, found = problem.contact(mu), evaluate(mu)
        assert abs(found.B - contact.B).max() <= 1e-15 * abs(contact.B).max()
        assert found.g == pytest.approx(contact.g, rel=0.0, abs=1e-15 * np.abs(contact.g).max())
    assert evaluate(np.array([0.5, 0.11])[: problem.parameters.dim]) is None  # disc 2 is too small


LOADED, PAPER = cache(partial(Hertz, "coarse", approach="parameter")), cache(partial(Hertz, "coarse"))


def test_the_grid_is_that_of_the_total_approach_and_those_of_one_radius_share_supremizers() -> None:
    training = LOADED().training_set()
    assert training.shape == (192, 2)
    assert np.unique(2.0 * training[:, 1].round(12)) == pytest.approx(0.15 + 0.01 * np.arange(16))
    assert np.unique(training[:, 0].round(12)) == pytest.approx(np.linspace(0.905, 1.125, 12))
    assert LOADED().parameters.names == ("radius", "approach")
    assert LOADED().validation_set(5, 1).shape == (5, 2)
    classes = constraint_classes([LOADED().assemble(mu).B for mu in training])
    assert len(classes.representatives) == 12
    assert np.array_equal(classes.members, np.repeat(np.arange(12), 16))


@pytest.mark.parametrize("radius", [0.905, 1.1])
def test_the_approach_is_taken_from_the_gap_and_changes_nothing_else(radius: float) -> None:
    before = PAPER().assemble(np.array([radius]))
    for approach in (0.075, 0.09, 0.15):
        vi = LOADED().assemble(np.array([radius, approach]))
        assert abs(vi.B - before.B).max() == 0.0
        assert abs(vi.A - before.A).max() == 0.0
        assert not np.any(vi.f)
        taken = 2.0 * (approach - 0.09) * LOADED().macro_lengths  # both flats move
        assert np.allclose(vi.g, before.g - taken, rtol=1e-13, atol=1e-15)
        assert np.allclose(vi.dirichlet_lift, before.dirichlet_lift * approach / 0.09, rtol=1e-14)
    assert LOADED().constant == {"A", "f"}


def test_at_the_approach_of_the_paper_it_is_the_problem_of_the_paper() -> None:
    mu = np.array([1.05, 0.09])
    one, two = HighFidelitySolver(LOADED()).solve(mu), HighFidelitySolver(PAPER()).solve(mu[:1])
    assert np.array_equal(one.u, two.u)
    assert np.array_equal(one.lam, two.lam)
    assert LOADED().resultants(mu, one.u) == PAPER().resultants(mu[:1], two.u)


def test_contact_grows_with_the_approach_as_hertz_says() -> None:
    problem = Hertz("medium", approach="parameter", growth=1.2)
    solver, rows = HighFidelitySolver(problem), []
    for approach in np.linspace(0.075, 0.15, 6):
        found = solver.solve(mu := np.array([1.015, approach]))
        measures = measured(problem, mu, found.lam)
        rows.append((sum(problem.resultants(mu, found.u)), measures.half_width, np.count_nonzero(found.lam)))
        # the theory is one of contacts that are small against the radii
        assert np.abs(measures.differences(theory(problem, mu, found.u))).max() < 0.01 + 0.5 * approach
    assert np.all(np.diff(rows, axis=0) > 0.0)
    loads, widths, _ = np.array(rows).T
    assert (widths / widths[0]) ** 2 == pytest.approx(loads / loads[0], rel=0.06)  # a² = 4PR*/(πE*)


@pytest.mark.parametrize("options", [{}, {"flats": "clamped"}, {"quadrature": 1, "ratio": 2.0}])
def test_contact_stays_inside_the_zone_over_the_whole_box(options: dict[str, object]) -> None:
    problem = Hertz("coarse", approach="parameter", **options)
    found = HighFidelitySolver(problem).solve(problem.parameters.upper)  # the longest contact
    ends = problem.points(problem.parameters.upper)[0][0, problem.slave.zone[2::2]]
    assert 0.35 < ends[np.flatnonzero(found.lam)[-1]] < 0.42


def test_members_are_constant_or_left_to_the_contact() -> None:
    members = affine_decomposition(LOADED(), LOADED().training_set()[::5], 1e-6)
    assert {name: member.way for name, member in members.items()} == {
        "A": Evaluation.CONSTANT, "f": Evaluation.CONSTANT, "B": Evaluation.CONTACT, "g": Evaluation.CONTACT,
    }  # fmt: skip


@dataclass(frozen=True)
class Sides:
    slave: sp.csr_array
    master: sp.csr_array
    gap: np.ndarray


def coupling(slave: np.ndarray, master: np.ndarray, quadrature: str | int) -> Sides:
    found = Pairing(slave, quadrature).couple(master)
    assert found.jump.has_canonical_format
    return Sides(-found.jump[:, : slave.shape[1]], found.jump[:, slave.shape[1] :], found.gap)


def polygons(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A slave of eight edges and a master that reaches beyond it, with kinks at other abscissae."""
    rng = np.random.default_rng(seed)
    slave = np.stack([np.concatenate([[0.0], np.cumsum(0.05 + rng.random(8))]), rng.random(9)])
    steps = np.cumsum(0.05 + rng.random(30))
    master = np.stack([np.concatenate([[0.0], steps * slave[0, -1] * 1.1 / steps[-1]]), -rng.random(31)])
    return slave, master


def quadrature(slave: np.ndarray, master: np.ndarray, function) -> np.ndarray:
    """Integrals of a function of the abscissa over the macro-edges along the slave's arc length, by brute force."""
    lengths = np.linalg.norm(np.diff(slave, axis=1), axis=0)
    found = np.zeros((slave.shape[1] - 1) // 2)
    for edge, length in enumerate(lengths):
        t = (np.arange(20_000) + 0.5) / 20_000
        x = slave[0, edge] + t * (slave[0, edge + 1] - slave[0, edge])
        found[edge // 2] += length * function(x).mean()
    return found


@given(st.integers(0, 1000))
def test_values_that_are_linear_are_integrated_exactly(seed: int) -> None:
    slave, master = polygons(seed)
    found = coupling(slave, master, "exact")
    lengths = np.linalg.norm(np.diff(slave, axis=1), axis=0).reshape(-1, 2).sum(axis=1)
    for side, nodes in ((found.slave, slave), (found.master, master)):
        assert np.allclose(side @ np.ones(nodes.shape[1]), lengths)
        assert np.allclose(side @ (1.0 + 2.0 * nodes[0]), found.slave @ (1.0 + 2.0 * slave[0]))


def test_exact_integrals_against_brute_force_and_gauss_points_tend_to_them() -> None:
    slave, master = polygons(3)
    values = np.random.default_rng(0).random(master.shape[1])
    exact = coupling(slave, master, "exact")
    brute = quadrature(slave, master, lambda x: np.interp(x, master[0], values))
    assert np.allclose(exact.master @ values, brute, rtol=1e-6)
    gap = quadrature(slave, master, lambda x: np.interp(x, *slave) - np.interp(x, *master))
    assert np.allclose(exact.gap, gap, rtol=1e-6)
    errors = [np.abs(coupling(slave, master, k).gap - exact.gap).max() for k in (1, 2, 20)]
    assert errors[2] < errors[0]
    assert errors[2] < 0.02 * np.abs(exact.gap).max()
    assert errors[1] > 0.0


def test_matching_nodes_are_exact_with_two_gauss_points() -> None:
    slave, _ = polygons(5)
    master = slave + np.array([[0.0], [-0.5]])
    one, two = coupling(slave, master, "exact"), coupling(slave, master, 2)
    assert np.allclose(one.master.toarray(), two.master.toarray())
    assert np.allclose(one.gap, 0.5 * one.slave @ np.ones(9))
