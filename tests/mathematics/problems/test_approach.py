"""The Hertz problem with the approach as its second parameter."""

import numpy as np
import pytest

from vibench.errors import NumericalError
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.model.affine import Evaluation, affine_decomposition
from vibench.reduction.supremizers import constraint_classes
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import measured, theory
from vibench_problems.mortar import Pairing

LOADED, PAPER = Hertz("coarse", approach="parameter"), Hertz("coarse")


@pytest.fixture(scope="module")
def rising() -> list[tuple[np.ndarray, HighFidelitySolution]]:
    """Solutions at one radius and rising approaches."""
    problem = Hertz("medium", approach="parameter", growth=1.2)
    solver = HighFidelitySolver(problem)
    return [(mu, solver.solve(mu)) for mu in np.column_stack([np.full(6, 1.015), np.linspace(0.075, 0.15, 6)])]


def test_the_grid_is_that_of_the_total_approach() -> None:
    training = LOADED.training_set()
    assert training.shape == (192, 2)
    assert np.unique(2.0 * training[:, 1].round(12)) == pytest.approx(0.15 + 0.01 * np.arange(16))
    assert np.unique(training[:, 0].round(12)) == pytest.approx(np.linspace(0.905, 1.125, 12))
    assert LOADED.parameters.names == ("radius", "approach")
    assert LOADED.validation_set(5, 1).shape == (5, 2)


@pytest.mark.parametrize("radius", [0.905, 1.1])
def test_the_approach_is_taken_from_the_gap_and_changes_nothing_else(radius: float) -> None:
    before = PAPER.assemble(np.array([radius]))
    for approach in (0.075, 0.09, 0.15):
        vi = LOADED.assemble(np.array([radius, approach]))
        assert abs(vi.B - before.B).max() == 0.0
        assert abs(vi.A - before.A).max() == 0.0
        assert not np.any(vi.f)
        taken = 2.0 * (approach - 0.09) * LOADED.macro_lengths  # both flats move
        assert np.allclose(vi.g, before.g - taken, rtol=1e-13, atol=1e-15)
        assert np.allclose(vi.dirichlet_lift, before.dirichlet_lift * approach / 0.09, rtol=1e-14)
    assert LOADED.constant == {"A", "f"}


def test_at_the_approach_of_the_paper_it_is_the_problem_of_the_paper() -> None:
    mu = np.array([1.05, 0.09])
    one, two = HighFidelitySolver(LOADED).solve(mu), HighFidelitySolver(PAPER).solve(mu[:1])
    assert np.array_equal(one.u, two.u)
    assert np.array_equal(one.lam, two.lam)
    assert LOADED.resultants(mu, one.u) == PAPER.resultants(mu[:1], two.u)


def test_at_a_fixed_approach_nothing_has_changed_to_the_last_bit() -> None:
    mu = np.array([0.8])
    upper, lower = (x[:, disc.zone] for x, disc in zip(PAPER.points(mu), (PAPER.slave, PAPER.master), strict=True))
    integrals = Pairing(upper, "exact").couple(lower)
    lift = np.repeat([-0.09, 0.09], [upper.shape[1], lower.shape[1]])
    assert np.array_equal(PAPER.assemble(mu).g, integrals.gap - integrals.jump @ lift)
    assert np.array_equal(PAPER.training_set(), PAPER.parameters.grid(81))
    assert PAPER.parameters.names == ("radius",)


def test_contact_grows_with_the_approach_as_hertz_says(rising) -> None:
    problem = Hertz("medium", approach="parameter", growth=1.2)
    loads = [sum(problem.resultants(mu, found.u)) for mu, found in rising]
    widths = [measured(problem, mu, found.lam).half_width for mu, found in rising]
    active = [np.count_nonzero(found.lam) for _, found in rising]
    assert np.all(np.diff(loads) > 0.0)
    assert np.all(np.diff(widths) > 0.0)
    assert np.all(np.diff(active) > 0)
    for mu, found in rising:  # the theory is one of contacts that are small against the radii
        differences = measured(problem, mu, found.lam).differences(theory(problem, mu, found.u))
        assert np.abs(differences).max() < 0.01 + 0.5 * mu[1]
    square = np.array(widths) ** 2
    assert square / square[0] == pytest.approx(np.array(loads) / loads[0], rel=0.06)  # a² = 4PR*/(πE*)


def test_flats_move_by_the_parameter_and_forces_balance(rising) -> None:
    problem = Hertz("medium", approach="parameter", growth=1.2)
    second = problem.slave.mesh.p.shape[1]
    for mu, found in rising[::5]:
        moved = problem.displacement(mu, found.u)
        assert np.allclose(moved[1, problem.slave.flat], -mu[1])
        assert np.allclose(moved[1, second + problem.master.flat], mu[1])
        upper, lower = problem.resultants(mu, found.u)
        assert upper == pytest.approx(lower, rel=1e-8)
        assert upper == pytest.approx(problem.macro_lengths @ found.lam, rel=1e-8)
        picture = problem.picture(mu, found.u, found.lam)
        assert picture.points[1].max() == pytest.approx(1.001 - mu[1])


@pytest.mark.parametrize("options", [{}, {"flats": "clamped"}, {"quadrature": 1, "ratio": 2.0}])
def test_contact_stays_inside_the_zone_over_the_whole_box(options: dict[str, object]) -> None:
    problem = Hertz("coarse", approach="parameter", **options)
    found = HighFidelitySolver(problem).solve(problem.parameters.upper)  # the longest contact
    ends = problem.points(problem.parameters.upper)[0][0, problem.slave.zone[2::2]]
    assert 0.35 < ends[np.flatnonzero(found.lam)[-1]] < 0.42


def test_contact_beyond_the_zone_is_refused_at_its_parameter() -> None:
    """From where each flat moves by 0.22 m and more: what Benaceur's grid would be if d were that."""
    solver = HighFidelitySolver(LOADED)
    solver.solve(np.array([1.125, 0.2]))
    with pytest.raises(NumericalError, match=r"at mu = \[1.125, 0.25\]: the contact reaches the end of the potential"):
        solver.solve(np.array([1.125, 0.25]))


def test_parameters_of_one_radius_share_their_supremizers() -> None:
    training = LOADED.training_set()
    classes = constraint_classes([LOADED.assemble(mu).B for mu in training])
    assert len(classes.representatives) == 12
    assert np.array_equal(classes.members, np.repeat(np.arange(12), 16))


def test_members_are_constant_or_left_to_the_contact() -> None:
    members = affine_decomposition(LOADED, LOADED.training_set()[::5], 1e-6)
    assert {name: member.way for name, member in members.items()} == {
        "A": Evaluation.CONSTANT, "f": Evaluation.CONSTANT, "B": Evaluation.CONTACT, "g": Evaluation.CONTACT,
    }  # fmt: skip
