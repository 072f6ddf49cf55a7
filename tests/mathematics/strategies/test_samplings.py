"""Sampling strategies: points of the box, the same in every call, with the property that gives each its name."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vibench import Array, ParameterBox, RequestError, create
from vibench.interfaces.strategies import check_sample
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import registered

BOX = ParameterBox(("a", "b", "c"), np.array([1e-3, -2.0, 5.0]), np.array([1e3, 3.0, 5.5]), ("m", "1", "N"))
DRAWN = ("random", "sobol", "latin-hypercube")


def points(name: str, box: ParameterBox = BOX, **options: object) -> Array:
    strategy = create("sampling strategy", name, options)
    return check_sample(box, strategy.parameters(box))


@pytest.mark.parametrize("name", DRAWN)
@settings(max_examples=20, deadline=None)
@given(size=st.integers(1, 70), seed=st.integers(0, 2**63 - 1), log=st.sampled_from([[], ["a"], ["c", "a"]]))
def test_drawn_points_are_in_the_box_and_follow_the_seed(name: str, size: int, seed: int, log: list[str]) -> None:
    found = points(name, size=size, seed=seed, log=log)
    assert found.shape == (size, 3)
    assert found.tobytes() == points(name, size=size, seed=seed, log=log).tobytes()
    assert found.tobytes() != points(name, size=size, seed=(seed + 1) % 2**63, log=log).tobytes()


@pytest.mark.parametrize("name", DRAWN)
def test_a_log_scale_spreads_the_logarithm_and_leaves_the_other_parameters(name: str) -> None:
    plain, scaled = (points(name, size=64, seed=2, log=log) for log in ([], ["a"]))
    assert np.array_equal(plain[:, 1:], scaled[:, 1:])
    places = (plain[:, 0] - BOX.lower[0]) / (BOX.upper[0] - BOX.lower[0])
    np.testing.assert_allclose(np.log10(scaled[:, 0]), -3.0 + 6.0 * places, atol=1e-9)


@pytest.mark.parametrize("size", [1, 7, 32])
def test_a_latin_hypercube_has_one_point_in_every_interval_of_every_parameter(size: int) -> None:
    found = points("latin-hypercube", size=size, seed=5, log=["a"]).copy()
    found[:, 0] = np.log(found[:, 0])
    lower, upper = BOX.lower.copy(), BOX.upper.copy()
    lower[0], upper[0] = np.log(lower[0]), np.log(upper[0])
    cells = np.floor(size * (found - lower) / (upper - lower)).astype(int)
    assert [sorted(column) for column in cells.T] == [list(range(size))] * 3


def test_a_sobol_sequence_is_balanced_and_its_sizes_are_nested() -> None:
    unit = ParameterBox(("a", "b"), np.zeros(2), np.ones(2), ("1", "1"))
    found = points("sobol", unit, size=64, seed=3)
    assert np.array_equal(points("sobol", unit, size=37, seed=3), found[:37])
    for across in range(7):  # a (0, 6, 2)-net in base 2: one point in each box of volume 1/64
        shape = np.array([2**across, 2 ** (6 - across)])
        assert len(np.unique(np.floor(found * shape), axis=0)) == 64


def test_a_grid_is_that_of_the_box_or_around_the_middle_and_geometric_on_a_log_scale() -> None:
    assert points("grid", counts=[3, 1, 4]).tobytes() == BOX.grid(3, 1, 4).tobytes()
    assert points("grid", counts=[2]).tobytes() == BOX.grid(2, 2, 2).tobytes()
    found = points("grid", counts=[7, 1, 2], log=["a"])
    np.testing.assert_allclose(found[::2, 0], np.geomspace(1e-3, 1e3, 7), rtol=1e-12)
    assert np.array_equal(found[:, 2], [5.0, 5.5] * 7)
    whole, part = points("grid", counts=[3]), points("grid", counts=[3], share=0.5)
    middle = 0.5 * (BOX.lower + BOX.upper)
    assert np.allclose(part - middle, 0.5 * (whole - middle))


def test_a_list_keeps_its_order_and_a_single_parameter_needs_no_brackets() -> None:
    assert points("list", points=[[2, 0.5, 5.5], [1, 0, 5]]).tolist() == [[2, 0.5, 5.5], [1, 0, 5]]
    line = ParameterBox(("a",), np.zeros(1), np.ones(1), ("1",))
    assert points("list", line, points=[0.5, 0.25]).tolist() == [[0.5], [0.25]]


def places(found: Array) -> Array:
    return (found - BOX.lower) / (BOX.upper - BOX.lower)


def test_a_sweep_goes_from_one_end_to_the_other() -> None:
    along = places(points("sweep", size=9))
    np.testing.assert_allclose(along, np.linspace(0.0, 1.0, 9)[:, None].repeat(3, axis=1), atol=1e-12)
    one = places(points("sweep", size=5, parameter="b"))
    np.testing.assert_allclose(one[:, 1], np.linspace(0.0, 1.0, 5), atol=1e-12)
    np.testing.assert_allclose(one[:, [0, 2]], 0.5, atol=1e-12)
    np.testing.assert_allclose(points("sweep", size=7, log=["a"])[:, 0], np.geomspace(1e-3, 1e3, 7))
    thin = ParameterBox(("a", "b"), np.zeros(2), np.array([1.0, 0.0]), ("1", "1"))
    with pytest.raises(RequestError, match="'b' has one value only; there is no path along it"):
        points("sweep", thin, size=3, parameter="b")
    with pytest.raises(RequestError, match="no parameter is called 'd'"):
        points("sweep", size=3, parameter="d")


@given(seed=st.integers(0, 1000), step=st.sampled_from([0.01, 0.2, 1.0]))
@settings(max_examples=20, deadline=None)
def test_a_random_walk_starts_in_the_middle_and_makes_steps_of_the_given_size(seed: int, step: float) -> None:
    walk = places(points("random-walk", size=400, seed=seed, step=step))
    np.testing.assert_allclose(walk[0], 0.5, atol=1e-12)
    steps = np.diff(walk, axis=0)
    drawn = step * np.random.default_rng(seed).standard_normal((400, 3))[1:]
    assert np.all(np.abs(steps) <= np.abs(drawn) + 1e-12)  # a reflection shortens a step
    inside = np.all((walk[:-1] + steps > 5 * step) & (walk[1:] < 1.0 - 5 * step), axis=1)
    if step == 0.01:
        np.testing.assert_allclose(np.abs(steps[inside]), np.abs(drawn[inside]), atol=1e-12)
    assert (
        points("random-walk", size=40, seed=seed, step=step).tobytes()
        == points("random-walk", size=400, seed=seed, step=step)[:40].tobytes()
    )


def test_a_loading_rises_in_equal_steps_while_the_other_parameters_stay() -> None:
    found = places(points("load-steps", parameter="b", loadings=3, steps=4, seed=1)).reshape(3, 4, 3)
    np.testing.assert_allclose(found[:, :, 1], np.linspace(0.0, 1.0, 4)[None].repeat(3, axis=0), atol=1e-12)
    assert np.ptp(found[:, :, [0, 2]], axis=1).max() == 0.0
    assert len(np.unique(found[:, 0, 0])) == 3


def test_only_paths_are_ordered() -> None:
    ordered = {name for name, plugin in registered(PluginKind.SAMPLING).items() if plugin.load().ordered}
    assert ordered == {"sweep", "random-walk", "load-steps"}
