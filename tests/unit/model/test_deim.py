from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibench.model.affine import interpolate

seeds = st.integers(0, 10_000)
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)


def of_rank(rank: int, seed: int, size: int = 30, count: int = 9) -> np.ndarray:
    """Random vectors (size×count) in a space of few dimensions."""
    rng = np.random.default_rng(seed)
    return rng.standard_normal((size, rank)) @ rng.standard_normal((rank, count))


def family(seed: int, size: int = 40, count: int = 20) -> np.ndarray:
    """Vectors (size×count) that depend on a parameter smoothly, a bump that moves."""
    start = np.random.default_rng(seed).random()
    x, mu = np.linspace(0.0, 1.0, size), np.linspace(start, start + 0.4, count)
    return 3.0 / (1.0 + 20.0 * (x[:, None] - mu) ** 2)


def largest_error(snapshots: np.ndarray, points: np.ndarray, modes: np.ndarray) -> float:
    """Largest error of any column, relative to the longest."""
    rebuilt = [sum(v[p] * mode for p, mode in zip(points, modes.T, strict=True)) for v in snapshots.T]
    errors = [np.linalg.norm(v - w) for v, w in zip(snapshots.T, rebuilt, strict=True)]
    return float(max(errors) / max(np.linalg.norm(v) for v in snapshots.T))


@given(seeds, st.integers(1, 7), st.integers(1, 20))
def test_every_mode_is_one_at_its_own_point_and_zero_at_the_others(seed: int, size: int, count: int) -> None:
    snapshots = np.random.default_rng(seed).standard_normal((size, count))
    found = interpolate(snapshots, 1e-12)
    assert np.all(np.diff(found.points) > 0)
    assert found.modes.shape == (size, len(found.points))
    assert np.allclose(found.modes[found.points], np.eye(len(found.points)), atol=1e-9)


@given(seeds, st.integers(1, 6))
def test_in_a_space_of_few_dimensions_as_many_entries_tell_every_vector(seed: int, rank: int) -> None:
    known = of_rank(rank, seed)
    found = interpolate(known, 1e-10)
    assert len(found.points) == rank
    new = known @ np.random.default_rng(seed + 1).standard_normal(known.shape[1])
    assert np.allclose(found.modes @ new[found.points], new, atol=1e-8 * np.abs(new).max())


@given(seeds, st.floats(1e-9, 0.9))
def test_training_vectors_are_met_to_the_tolerance_and_the_error_is_what_it_says(seed: int, tolerance: float) -> None:
    snapshots = family(seed)
    found = interpolate(snapshots, tolerance)
    assert found.error <= tolerance
    assert np.isclose(found.error, largest_error(snapshots, found.points, found.modes), rtol=1e-3, atol=1e-14)


@given(seeds)
def test_tighter_tolerances_take_more_terms_and_none_while_the_tail_of_the_singular_values_is_small(seed: int) -> None:
    snapshots = family(seed)
    sigma = np.linalg.svd(snapshots, compute_uv=False) / np.linalg.norm(snapshots, axis=0).max()
    counts = [len(interpolate(snapshots, tolerance).points) for tolerance in TOLERANCES]
    assert np.all(np.diff(counts) >= 0)
    assert counts[-1] > counts[0]
    for tolerance, count in zip(TOLERANCES, counts, strict=True):
        assert np.linalg.norm(sigma[count - 1 :]) > tolerance


def test_a_term_is_added_where_few_terms_approximate_well_enough_but_do_not_interpolate_so() -> None:
    """(1.1, 1, …, 1) ± 0.1 in the entry that is sampled: projection errs by 0.05, interpolation from it by 0.09."""
    middle, change = np.append(1.1, np.ones(8)), np.append(0.1, np.zeros(8))
    tiny = 1e-3 * np.eye(9)[5]
    snapshots = np.column_stack([middle + change, middle - change, middle + tiny])
    assert np.sqrt(2.0) * 0.1 < 0.06 * np.linalg.norm(snapshots, axis=0).max()
    one, two = interpolate(snapshots, 0.1), interpolate(snapshots, 0.06)
    assert (len(one.points), len(two.points)) == (1, 2)
    assert 0.06 < one.error < 0.1
    assert 1e-5 < two.error < 1e-3


@given(seeds, st.integers(1, 9), st.floats(1e-12, 0.5))
def test_proportional_vectors_need_one_term(seed: int, count: int, tolerance: float) -> None:
    rng = np.random.default_rng(seed)
    shape, factors = rng.standard_normal(15), rng.uniform(0.1, 10.0, count) * rng.choice([-1.0, 1.0], count)
    found = interpolate(np.outer(shape, factors), tolerance)
    assert len(found.points) == 1
    assert found.points[0] == np.argmax(np.abs(shape))
    assert np.allclose(found.modes[:, 0], shape / shape[found.points[0]])


@pytest.mark.parametrize("rank", [1, 3, 6])
def test_a_tolerance_nobody_can_reach_ends_with_all_there_is(rank: int) -> None:
    known = of_rank(rank, seed=rank)
    found = interpolate(known, 0.0)
    assert rank <= len(found.points) <= known.shape[1]
    assert 0.0 < found.error < 1e-12


def test_errors_are_relative_to_the_longest_vector() -> None:
    long, short = np.array([1e6, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    snapshots = np.column_stack([long, short])
    assert len(interpolate(snapshots, 2e-6).points) == 1
    assert np.isclose(interpolate(snapshots, 2e-6).error, 1e-6)
    assert len(interpolate(snapshots, 0.5e-6).points) == 2


def test_zero_vectors_among_others_do_no_harm() -> None:
    snapshots = np.column_stack([np.zeros(4), np.arange(4.0)])
    found = interpolate(snapshots, 1e-12)
    assert found.points.tolist() == [3]
    assert found.error < 1e-15
