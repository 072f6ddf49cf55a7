from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench.errors import NumericalError
from vibench.linalg.definite import connected_blocks, dense_cholesky, dense_inverse


def mixed_blocks(seed: int, sizes: list[int]) -> tuple[np.ndarray, list[set[int]]]:
    """A matrix of blocks whose unknowns are mixed, and the unknowns of each."""
    rng = np.random.default_rng(seed)
    count = sum(sizes)
    place, block = rng.permutation(count), scipy.linalg.block_diag(np.zeros((0, 0)), *(spd(k, rng) for k in sizes))
    X = np.zeros((count, count))
    X[np.ix_(place, place)] = block
    return X, [set(part.tolist()) for part in np.split(place, np.cumsum(sizes)[:-1]) if len(part)]


@given(st.integers(0, 10_000), st.lists(st.integers(1, 4), max_size=4))
def test_factor_and_inverse_are_those_of_the_whole_matrix(seed: int, sizes: list[int]) -> None:
    X, blocks = mixed_blocks(seed, sizes)
    assert sorted(map(sorted, blocks)) == sorted(block.tolist() for block in connected_blocks(X))
    F = dense_cholesky(X, "X")
    assert np.allclose(F.T @ F, X)
    assert np.array_equal(F, np.triu(F))
    inverse = dense_inverse(X, "X")
    assert np.allclose(inverse @ X, np.eye(len(X)))
    assert np.array_equal(inverse, inverse.T)


def test_unknowns_in_a_chain_are_one_block() -> None:
    assert [block.tolist() for block in connected_blocks(np.eye(4) + np.eye(4, k=1) + np.eye(4, k=-1))] == [
        [0, 1, 2, 3]
    ]


@pytest.mark.parametrize("bad", [-1.0, 0.0, np.nan])
@pytest.mark.parametrize("function", [dense_cholesky, dense_inverse])
def test_what_is_not_positive_definite_is_refused_by_name(function: object, bad: float) -> None:
    for X in (np.diag([1.0, bad]), np.array([[1.0, 0.5], [0.5, bad]])):
        with pytest.raises(NumericalError, match="the thing is not positive definite"):
            function(X, "the thing")  # type: ignore[operator]
