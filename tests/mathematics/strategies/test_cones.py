"""Dual strategies: what all of them promise for every family of snapshots, and what each one is."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import space

from vibench import Array, InnerProduct, NumericalError, QPSolution, VariationalInequality, check_cone
from vibench.interfaces.strategies import DualStrategy, ReducedSet, Stop, rays
from vibench.reduction import cone_subtraction, subtract_cone_component
from vibench.reduction.cones import project_on_cone
from vibench_strategies import enlarged_cpg
from vibench_strategies.angle_greedy import AngleGreedy
from vibench_strategies.cpg import CPG
from vibench_strategies.dictionary import Dictionary
from vibench_strategies.enlarged_cpg import EnlargedCPG
from vibench_strategies.mcpg import ModifiedCPG
from vibench_strategies.nmf import NonnegativeFactors
from vibench_strategies.orthant import Orthant
from vibench_strategies.pod_dual import PODDual

M = 12


def line_mass(m: int, scale: float) -> InnerProduct:
    """The consistent mass matrix of a line: whitening destroys signs, as on the meshes."""
    return InnerProduct(sp.diags_array([4.0 * np.ones(m), np.ones(m - 1), np.ones(m - 1)], offsets=[0, 1, -1]) / scale)


W = line_mass(M, M)


def bumps(count: int = 12, m: int = 40) -> tuple[Array, InnerProduct]:
    """Shifted and scaled bumps with exact zeros, and the mass matrix of their mesh."""
    x = np.linspace(0.0, 1.0, m)
    centres, widths = np.linspace(0.35, 0.65, count), 0.15 + 0.1 * np.sin(np.arange(count))
    return np.maximum(0.0, 1.0 - ((x[:, None] - centres) / widths) ** 2), line_mass(m, 6.0 * m)


@st.composite
def families(draw: st.DrawFn) -> Array:
    """Nonnegative snapshots (12×Q) with exact zeros, some of them zero, copies, multiples or nearly parallel."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    columns: list[Array] = []
    kinds = st.sampled_from(["new", "bump", "zero", "copy", "multiple", "nearly"])
    for kind in draw(st.lists(kinds, min_size=1, max_size=8)):
        source = columns[rng.integers(len(columns))] if columns else rng.random(M)
        columns.append({
            "new": rng.random(M) * (rng.random(M) < 0.6), "zero": np.zeros(M), "copy": source.copy(),
            "bump": np.maximum(0.0, 1.0 - ((np.arange(M) - 11.0 * rng.random()) / 4.0) ** 2),
            "multiple": 10.0 ** rng.integers(-6, 3) * source, "nearly": source * (1.0 + 1e-9 * rng.random(M)),
        }[kind])  # fmt: skip
    return np.column_stack(columns)


# Made in the tests: parallel workers that run none of them import no scikit-learn.
STRATEGIES = [CPG, ModifiedCPG, AngleGreedy, Dictionary, EnlargedCPG, NonnegativeFactors, Orthant, PODDual]
ALL = pytest.mark.parametrize("create", STRATEGIES)
EUCLID = InnerProduct(sp.eye_array(3))


def errors_one_by_one(cone: ReducedSet, theta: Array, X: InnerProduct) -> Array:
    """e(r) for r = 0 … R, every snapshot projected on every cone."""
    largest = float(X.norm(theta).max(initial=0.0)) or 1.0
    cones = [rays(cone.generators[:, :r], cone.free[:r]) for r in range(cone.size + 1)]
    return (
        np.array([max((project_on_cone(chi, q, X).distance for q in theta.T), default=0.0) for chi in cones]) / largest
    )


@ALL
@given(theta=families(), size=st.integers(0, 9))
@settings(max_examples=12)
def test_a_size_gives_a_cone_that_keeps_its_promises(create: type[DualStrategy], theta: Array, size: int) -> None:
    cone = check_cone(create().reduce(theta, W, Stop(size=size)), W)
    assert cone.size <= size
    assert cone.errors.shape == (cone.size + 1,)
    assert np.all(np.diff(cone.errors) <= 1e-9)
    assert np.allclose(cone.errors, errors_one_by_one(cone, theta, W), atol=1e-7)


@ALL
@given(theta=families(), tolerance=st.floats(1e-6, 0.9))
@settings(max_examples=12)
def test_a_tolerance_is_met(create: type[DualStrategy], theta: Array, tolerance: float) -> None:
    strategy = create()
    if isinstance(strategy, NonnegativeFactors):
        tolerance = max(tolerance, 0.3)  # a factorisation may end in a local minimum, see below
    cone = check_cone(strategy.reduce(theta, W, Stop(tolerance=tolerance)), W)
    assert cone.errors[-1] <= tolerance
    assert np.isclose(cone.errors[-1], errors_one_by_one(cone, theta, W)[-1], atol=1e-7)
    if isinstance(strategy, CPG | ModifiedCPG | Orthant | PODDual) and cone.size:
        assert cone.errors[-2] > tolerance


@ALL
@pytest.mark.parametrize("stop", [Stop(size=5), Stop(tolerance=5e-2)])
def test_the_same_snapshots_give_the_same_cone_to_the_last_bit(create: type[DualStrategy], stop: Stop) -> None:
    strategy = create()
    theta, X = bumps()
    one, other = (strategy.reduce(theta.copy(), X, stop) for _ in range(2))
    assert np.array_equal(one.generators, other.generators)
    assert np.array_equal(one.errors, other.errors)
    assert one.fallbacks == other.fallbacks


@ALL
@pytest.mark.parametrize("theta", [np.zeros((12, 0)), np.zeros((12, 3))], ids=["no snapshot", "no contact"])
@pytest.mark.parametrize("stop", [Stop(size=2), Stop(tolerance=0.1)], ids=str)
def test_no_snapshot_and_no_contact_give_an_empty_cone(create: type[DualStrategy], theta: Array, stop: Stop) -> None:
    cone = check_cone(create().reduce(theta, W, stop), W)
    assert cone.size == 0
    assert np.array_equal(cone.errors, [0.0])


@pytest.mark.parametrize("create", STRATEGIES[:-1])
def test_a_negative_snapshot_is_refused(create: type[DualStrategy]) -> None:
    theta = np.eye(12)[:, :3]
    theta[5, 1] = -1e-3
    with pytest.raises(NumericalError, match=r"negative coefficient -1\.0e-03"):
        create().reduce(theta, W, Stop(size=1))


@given(families(), st.floats(1e-3, 0.9))
def test_angle_greedy_stops_at_the_angle_of_every_single_snapshot(theta: Array, tolerance: float) -> None:
    cone = AngleGreedy().reduce(theta, W, Stop(tolerance=tolerance))
    norms = W.norm(theta)
    lengths = norms[norms > 0.0]
    directions, chi = theta[:, norms > 0.0] / lengths, cone.generators
    sines = [[project_on_cone(chi[:, :r], q, W).distance for q in directions.T] for r in range(cone.size + 1)]
    if len(lengths):
        assert max(sines[-1]) <= tolerance + 1e-8
        assert all(max(before) > tolerance - 1e-8 for before in sines[:-1])
    for r, generator in enumerate(cone.generators.T):  # each is the direction that was farthest
        picked = np.flatnonzero(np.abs(directions - generator[:, None]).max(axis=0) < 1e-14)
        assert max(sines[r][q] for q in picked) >= max(sines[r]) - 1e-8


def test_angle_greedy_takes_a_small_snapshot_of_its_own_direction_and_cpg_leaves_it() -> None:
    theta = np.zeros((12, 2))
    theta[2:5, 0], theta[9, 1] = 1.0, 1e-4
    assert CPG().reduce(theta, W, Stop(tolerance=1e-2)).size == 1
    assert AngleGreedy().reduce(theta, W, Stop(tolerance=1e-2)).size == 2


@pytest.mark.parametrize("stop", [Stop(tolerance=0.5), Stop(size=99), Stop(size=3)], ids=str)
def test_the_dictionary_holds_all_snapshots_in_their_order(stop: Stop) -> None:
    theta, X = bumps()
    theta = np.insert(theta, 1, 0.0, axis=1)
    cone = Dictionary().reduce(theta, X, stop)
    expected = np.delete(theta, 1, axis=1)[:, : stop.size]
    assert np.allclose(cone.generators, expected / X.norm(expected), atol=1e-15)


def test_the_orthant_takes_the_direction_that_the_farthest_snapshot_lacks_most() -> None:
    """Brute force: all snapshots projected at every step, all directions compared."""
    theta, X = bumps(6, 20)
    units = np.eye(20) / X.norm(np.eye(20))
    cone = Orthant().reduce(theta, X, Stop(tolerance=1e-9))
    chosen = np.zeros((20, 0))
    for generator in cone.generators.T:
        found = [project_on_cone(chosen, q, X) for q in theta.T]
        worst = int(np.argmax([p.distance for p in found]))
        rest = theta[:, worst] - chosen @ found[worst].coefficients
        i = int(np.flatnonzero(generator)[0])
        assert np.allclose(generator, units[:, i], atol=1e-14)
        assert X.gram(units, rest)[i] >= X.gram(units, rest).max() * (1.0 - 1e-8)
        chosen = np.column_stack([chosen, generator])
    assert cone.size == len(np.flatnonzero(theta.any(axis=1)))
    assert cone.errors[-1] < 1e-9


@given(families())
def test_the_enlarged_cone_contains_that_of_cpg_and_nothing_moves_any_more(theta: Array) -> None:
    given_cone, cone = (s.reduce(theta, W, Stop(size=theta.shape[1])) for s in (CPG(), EnlargedCPG()))
    assert cone.size <= given_cone.size
    for generator in given_cone.generators.T:
        assert project_on_cone(cone.generators, generator, W).distance <= 1e-8
    if not cone.fallbacks:
        for i in range(cone.size):
            rest, _ = subtract_cone_component(cone.generators[:, i], np.delete(cone.generators, i, axis=1), W)
            assert W.norm(cone.generators[:, i] - rest) <= 1e-8


def test_enlarged_generators_are_better_conditioned_and_leave_less_of_the_snapshots() -> None:
    theta, X = bumps(25)
    given_cone, cone = (s.reduce(theta, X, Stop(size=8)) for s in (CPG(), EnlargedCPG()))
    one, other = (np.linalg.cond(X.gram(c.generators, c.generators)) for c in (given_cone, cone))
    assert other < 0.1 * one
    assert cone.errors[-1] <= given_cone.errors[-1] * (1.0 + 1e-9)
    assert cone.fallbacks == ()


def test_sweeps_that_are_not_enough_and_steps_only_feasible_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    theta, X = bumps(25)
    assert EnlargedCPG(sweeps=1).reduce(theta, X, Stop(size=8)).fallbacks == ("generators still changed in sweep 1",)
    whole: Callable[..., tuple[Array, str]] = enlarged_cpg.subtract_cone_component
    monkeypatch.setattr(enlarged_cpg, "subtract_cone_component", lambda *data: (whole(*data)[0], "not optimal"))
    theta, X = bumps(5)
    assert EnlargedCPG().reduce(theta, X, Stop(size=3)).fallbacks[0] == "sweep 1, generator 1: not optimal"


def test_a_generator_that_the_others_contain_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """CPG itself chooses none; a greedy algorithm that knew the others only later would."""
    a, b, c = np.eye(12)[:, 0], np.eye(12)[:, 4], np.eye(12)[:, 8]
    chi = np.column_stack([a, a + b, b, c])
    monkeypatch.setattr(
        enlarged_cpg, "greedy_cone", lambda *_: ReducedSet(chi / W.norm(chi), np.ones(5), np.zeros(4, bool))
    )
    cone = EnlargedCPG().reduce(chi, W, Stop(size=4))
    assert cone.size == 3
    assert cone.errors[-1] < 1e-9


@pytest.mark.long
def test_nmf_takes_the_smallest_number_of_generators_that_meets_the_tolerance() -> None:
    theta, X = bumps(25)
    strategy = NonnegativeFactors()
    cone = strategy.reduce(theta, X, Stop(tolerance=2e-2))
    shorter = [strategy.reduce(theta, X, Stop(size=size)).errors[-1] for size in range(cone.size)]
    assert min(shorter) > 2e-2 >= cone.errors[-1]
    assert cone.size >= 3


def test_nmf_does_not_depend_on_how_long_basis_functions_are() -> None:
    """The lumped norm makes it a factorisation of functions: the same ones in another basis have the same cone."""
    theta, X = bumps()
    sizes = np.linspace(0.1, 10.0, 40)
    scaled = InnerProduct(sp.diags_array(1.0 / sizes) @ X.matrix @ sp.diags_array(1.0 / sizes))
    one = NonnegativeFactors().reduce(theta, X, Stop(size=4))
    other = NonnegativeFactors().reduce(sizes[:, None] * theta, scaled, Stop(size=4))
    assert np.allclose(sizes[:, None] * one.generators, other.generators, rtol=1e-6, atol=1e-9)
    assert np.allclose(one.errors, other.errors, rtol=1e-6)


def test_a_factorisation_that_was_stopped_is_recorded_and_one_that_misses_its_tolerance_refused() -> None:
    theta, X = bumps()
    stopped = NonnegativeFactors(iterations=1).reduce(theta, X, Stop(size=4)).fallbacks
    assert stopped == ("the factorisation was stopped after 1 iterations",)
    assert NonnegativeFactors(iterations=100_000).reduce(theta, X, Stop(size=2)).fallbacks == ()
    reason = r"no factorisation reaches tolerance 1e-14: the best of up to 12 generators"
    with pytest.raises(NumericalError, match=reason):
        NonnegativeFactors(iterations=2).reduce(theta, X, Stop(tolerance=1e-14))


@given(families(), st.integers(0, 8))
def test_pod_dual_is_free_of_signs_and_no_linear_space_leaves_less_in_the_mean(theta: Array, size: int) -> None:
    cone = PODDual().reduce(theta, W, Stop(size=size))
    assert np.all(cone.free)
    assert np.allclose(W.gram(cone.generators, cone.generators), np.eye(cone.size), atol=1e-10)
    rest = W.whiten(theta - cone.generators @ W.gram(cone.generators, theta))
    sigma = np.linalg.svd(W.whiten(theta), compute_uv=False)
    assert np.isclose(np.linalg.norm(rest), np.linalg.norm(sigma[cone.size :]), atol=1e-9 * (1.0 + sigma[0]))


@pytest.mark.parametrize("strategy", [CPG(), ModifiedCPG()], ids=["cpg", "mcpg"])
@given(families())
def test_greedy_cones_are_nested_and_snapshots_are_reproduced(strategy: DualStrategy, theta: Array) -> None:
    cone = strategy.reduce(theta, W, Stop(size=theta.shape[1]))
    chi, errors = cone.generators, cone.errors
    assert np.all(chi >= 0.0)
    assert not np.any(cone.free)
    assert np.allclose(W.norm(chi), 1.0, atol=1e-12)
    assert np.all(np.diff(errors) <= 1e-12)
    for r in range(cone.size):
        shorter = strategy.reduce(theta, W, Stop(size=r)).generators
        assert np.array_equal(shorter, chi[:, :r])
    largest = max(float(W.norm(theta).max()), 1e-300)
    for snapshot in theta.T:
        assert project_on_cone(chi, snapshot, W).distance <= 1e-7 * largest


@given(families())
def test_the_modified_cone_contains_the_snapshots_it_was_made_from(theta: Array) -> None:
    """Remark 4.1: each step keeps the cone of the snapshots chosen so far inside."""
    cone = ModifiedCPG().reduce(theta, W, Stop(size=theta.shape[1]))
    for r in range(1, cone.size + 1):
        inside = sum(project_on_cone(cone.generators[:, :r], q, W).distance <= 1e-7 * W.norm(q) for q in theta.T)
        assert inside >= r


@given(st.integers(0, 10_000))
def test_generators_of_the_plain_greedy_are_normalised_snapshots_the_largest_first(seed: int) -> None:
    X, theta = space(7, seed), np.random.default_rng(seed).random((7, 5))
    cone, norms = CPG().reduce(theta, X, Stop(size=4)), X.norm(theta)
    apart = np.abs((theta / norms)[:, None] - cone.generators[:, :, None]).max(axis=0)
    assert apart.min(axis=1).max() < 1e-13
    assert np.argmin(apart[0]) == np.argmax(norms)
    assert cone.fallbacks == ()


def test_subtraction_in_the_example_that_corrects_remark_4_3_and_where_theta_is_zero() -> None:
    theta = np.array([[1.0, 1.0], [1.0, 2.0], [0.0, 1.0]])
    rest, note = subtract_cone_component(theta[:, 1], theta[:, :1], EUCLID)
    assert np.allclose(rest, [0.0, 1.0, 1.0], atol=1e-10)
    assert note == ""
    cone = ModifiedCPG().reduce(theta[:, ::-1], EUCLID, Stop(size=2))  # the larger snapshot comes first
    assert np.allclose(cone.generators[:, 0], np.array([1.0, 2.0, 1.0]) / np.sqrt(6.0))
    theta, wide = np.array([1.0, 1.0, 0.0]), np.ones((3, 1))
    assert np.array_equal(subtract_cone_component(theta, wide, EUCLID)[0], theta)
    rest, _ = subtract_cone_component(theta, np.hstack([wide, [[1.0], [0.0], [0.0]]]), EUCLID)
    assert np.allclose(rest, [0.0, 1.0, 0.0], atol=1e-6)


@given(st.integers(0, 10_000))
def test_the_removed_part_is_feasible_and_optimal(seed: int) -> None:
    rng, X = np.random.default_rng(seed), space(6, seed)
    chi, theta = rng.random((6, 3)), rng.random(6) + 0.1
    rest, note = subtract_cone_component(theta, chi, X)
    assert note == ""
    assert np.all(rest >= 0.0)
    assert project_on_cone(chi, theta - rest, X).distance < 1e-9
    best = float(X.norm(rest))
    for alpha in rng.random((300, 3)) * rng.choice([0.01, 0.1, 1.0], (300, 1)):
        if np.all(chi @ alpha <= theta):
            assert best <= float(X.norm(theta - chi @ alpha)) + 1e-9


def test_the_modified_greedy_needs_no_more_generators_and_they_are_better_conditioned() -> None:
    theta, X = bumps(25)
    plain, modified = (s.reduce(theta, X, Stop(tolerance=1e-2)) for s in (CPG(), ModifiedCPG()))
    assert modified.size <= plain.size
    conditions = [np.linalg.cond(X.whiten(cone.generators[:, : modified.size])) for cone in (plain, modified)]
    assert conditions[1] < conditions[0]


def test_entries_that_are_round_off_are_exact_zeros() -> None:
    theta, X = bumps()
    cone = ModifiedCPG().reduce(theta, X, Stop(size=12))
    assert cone.fallbacks == ()
    generators = cone.generators[:, :8]
    assert generators[generators > 0.0].min() > 1e-13 * generators.max()
    assert np.any(generators[theta.max(axis=1) > 0.0] == 0.0)


@pytest.mark.parametrize("broken", ["nothing", "nan", "infeasible"])
def test_a_solver_that_fails_leaves_feasible_generators_and_notes(monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    def fails(program: VariationalInequality, solver: str, accuracy: float) -> QPSolution:
        if broken == "nothing":
            return QPSolution(None, None, "failed")
        (rows, count), value = program.B.shape, np.nan if broken == "nan" else 5.0
        return QPSolution(np.full(count, value), np.zeros(rows), "solved")

    theta, X = bumps()
    monkeypatch.setattr(cone_subtraction, "solve_qp", fails)
    rest, note = subtract_cone_component(theta[:, 3], theta[:, 2:3] * (theta[:, 3:4] > 0.0), X)
    assert "line 9" in note
    assert np.all(rest >= 0.0)
    cone = ModifiedCPG().reduce(theta, X, Stop(size=12))
    assert any(line.startswith("generator ") for line in cone.fallbacks)
    for snapshot in theta.T:
        assert project_on_cone(cone.generators, snapshot, X).distance <= (cone.errors[-1] + 1e-9) * X.norm(theta).max()
