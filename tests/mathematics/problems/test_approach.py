"""The Hertz problem with the approach as its second parameter."""

import numpy as np
import pytest

from vibench.errors import NumericalError
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.model.affine import Evaluation, affine_decomposition
from vibench.reduction.supremizers import constraint_classes
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import measured, theory

LOADED, PAPER = Hertz("coarse", approach="parameter"), Hertz("coarse")


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
