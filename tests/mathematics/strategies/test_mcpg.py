import numpy as np
import pytest
import scipy.sparse as sp
from families import bumps
from hypothesis import given
from hypothesis import strategies as st
from numerics import space

from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.strategies import Stop
from vibench.linalg.inner_product import InnerProduct
from vibench.qp.verification import QPSolution
from vibench.reduction import cone_subtraction, subtract_cone_component
from vibench.reduction.cones import project_on_cone
from vibench_strategies.cpg import CPG
from vibench_strategies.mcpg import ModifiedCPG

seeds = st.integers(0, 10_000)
EUCLID = InnerProduct(sp.eye_array(3))


def test_the_second_generator_of_the_example_that_corrects_remark_4_3() -> None:
    theta = np.array([[1.0, 1.0], [1.0, 2.0], [0.0, 1.0]])
    rest, note = subtract_cone_component(theta[:, 1], theta[:, :1], EUCLID)
    assert np.allclose(rest, [0.0, 1.0, 1.0], atol=1e-10)
    assert note == ""
    cone = ModifiedCPG().reduce(theta[:, ::-1], EUCLID, Stop(size=2))  # the larger snapshot comes first
    assert np.allclose(cone.generators[:, 0], np.array([1.0, 2.0, 1.0]) / np.sqrt(6.0))


def test_generators_positive_where_theta_is_zero_take_no_part() -> None:
    theta = np.array([1.0, 1.0, 0.0])
    wide = np.array([[1.0], [1.0], [1.0]])
    assert np.array_equal(subtract_cone_component(theta, wide, EUCLID)[0], theta)
    rest, _ = subtract_cone_component(theta, np.hstack([wide, [[1.0], [0.0], [0.0]]]), EUCLID)
    assert np.allclose(rest, [0.0, 1.0, 0.0], atol=1e-6)


@given(seeds)
def test_the_removed_part_is_feasible_and_optimal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    W = space(6, seed)
    chi, theta = rng.random((6, 3)), rng.random(6) + 0.1
    rest, note = subtract_cone_component(theta, chi, W)
    assert note == ""
    assert np.all(rest >= 0.0)
    assert project_on_cone(chi, theta - rest, W).distance < 1e-9
    best = float(W.norm(rest))
    for alpha in rng.random((300, 3)) * rng.choice([0.01, 0.1, 1.0], (300, 1)):
        if np.all(chi @ alpha <= theta):
            assert best <= float(W.norm(theta - chi @ alpha)) + 1e-9


def test_cones_contain_those_of_the_snapshots_they_were_made_from() -> None:
    """Remark 4.1, with coefficientwise nonnegative generators and falling errors."""
    theta, W = bumps()
    modified = ModifiedCPG().reduce(theta, W, Stop(size=12))
    assert np.all(modified.generators >= 0.0)
    assert np.allclose(W.norm(modified.generators), 1.0)
    assert np.all(np.diff(modified.errors) <= 1e-12)
    assert modified.fallbacks == ()
    for snapshot in theta.T:
        assert project_on_cone(modified.generators, snapshot, W).distance < 1e-7 * W.norm(snapshot)


def test_it_needs_no_more_generators_than_cpg_and_they_are_better_conditioned() -> None:
    theta, W = bumps(25)
    plain, modified = (s.reduce(theta, W, Stop(tolerance=1e-2)) for s in (CPG(), ModifiedCPG()))
    assert modified.size <= plain.size
    r = modified.size
    conditions = [np.linalg.cond(W.whiten(cone.generators[:, :r])) for cone in (plain, modified)]
    assert conditions[1] < conditions[0]


def test_entries_that_are_round_off_are_exact_zeros() -> None:
    theta, W = bumps()
    generators = ModifiedCPG().reduce(theta, W, Stop(size=8)).generators
    positive = generators[generators > 0.0]
    assert positive.min() > 1e-13 * generators.max()
    assert np.any(generators[theta.max(axis=1) > 0.0] == 0.0)


@pytest.mark.parametrize("broken", ["nothing", "nan", "infeasible"])
def test_a_solver_that_fails_leaves_a_feasible_generator_and_a_note(monkeypatch, broken: str) -> None:
    def fails(program: VariationalInequality, solver: str, accuracy: float) -> QPSolution:
        count, rows = program.B.shape[1], program.B.shape[0]
        if broken == "nothing":
            return QPSolution(None, None, "failed")
        value = np.nan if broken == "nan" else 5.0
        return QPSolution(np.full(count, value), np.zeros(rows), "solved")

    theta, W = bumps()
    monkeypatch.setattr(cone_subtraction, "solve_qp", fails)
    rest, note = subtract_cone_component(theta[:, 3], theta[:, 2:3] * (theta[:, 3:4] > 0.0), W)
    assert "line 9" in note
    assert np.all(rest >= 0.0)
    cone = ModifiedCPG().reduce(theta, W, Stop(size=12))
    assert any(line.startswith("generator ") for line in cone.fallbacks)
    for snapshot in theta.T:
        assert project_on_cone(cone.generators, snapshot, W).distance <= (cone.errors[-1] + 1e-9) * W.norm(theta).max()
