from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vibench.linalg.inner_product import orthonormal_range, project_out, singular_values, svd

seeds = st.integers(0, 10_000)


@given(seeds, st.integers(1, 8), st.integers(1, 8))
def test_svd_reproduces_the_matrix(seed: int, rows: int, columns: int) -> None:
    a = np.random.default_rng(seed).standard_normal((rows, columns))
    u, s, vt = svd(a)
    assert np.allclose(u * s @ vt, a, atol=1e-13)
    assert np.all(np.diff(s) <= 0.0)
    assert np.allclose(s, singular_values(a), atol=1e-13)


def test_singular_values_of_nothing() -> None:
    assert singular_values(np.zeros((4, 0))).shape == (0,)


@given(seeds, st.integers(1, 5))
def test_range_has_the_rank_of_its_vectors(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((12, rank)) @ rng.standard_normal((rank, 9))
    q = orthonormal_range(y)
    assert q.shape == (12, rank)
    assert np.allclose(q.T @ q, np.eye(rank), atol=1e-13)
    assert np.allclose(q @ (q.T @ y), y, atol=1e-12 * np.abs(y).max())


def test_range_drops_duplicates_and_zero_vectors_but_keeps_small_ones() -> None:
    e = np.eye(6)
    y = np.column_stack([e[0], e[0], np.zeros(6), 1e-9 * e[1], e[0] + 1e-15 * e[2]])
    q = orthonormal_range(y)
    assert q.shape[1] == 2
    assert np.allclose(np.abs(q.T @ e[:, :2]), np.eye(2), atol=1e-9)


def test_range_against_a_space_is_orthogonal_to_it_even_for_nearly_contained_vectors() -> None:
    rng = np.random.default_rng(1)
    fixed, _ = np.linalg.qr(rng.standard_normal((20, 5)))
    nearly = fixed @ rng.standard_normal((5, 3)) + 1e-8 * rng.standard_normal((20, 3))
    inside = fixed @ rng.standard_normal((5, 2))
    q = orthonormal_range(np.hstack([nearly, inside]), fixed)
    assert q.shape[1] == 3
    assert np.abs(fixed.T @ q).max() < 1e-14
    assert np.allclose(q.T @ q, np.eye(3), atol=1e-13)


def test_remove_projects_out() -> None:
    rng = np.random.default_rng(2)
    fixed, _ = np.linalg.qr(rng.standard_normal((9, 4)))
    y = rng.standard_normal((9, 2))
    rest = project_out(fixed, y)
    assert np.abs(fixed.T @ rest).max() < 1e-15
    assert np.allclose(fixed @ (fixed.T @ y) + rest, y)
