import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench.errors import NumericalError
from vibench.linalg.definite import BlockDiagonal, connected_blocks


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
    matrix, rng = BlockDiagonal.of(X), np.random.default_rng(seed)
    assert np.array_equal(matrix.toarray(), X)
    factor, inverse = matrix.cholesky("X"), matrix.inverse("X")
    F = factor.toarray()
    assert np.allclose(F.T @ F, X)
    assert np.array_equal(F, np.triu(F))
    assert np.allclose(inverse.toarray() @ X, np.eye(len(X)))
    assert np.array_equal(inverse.toarray(), inverse.toarray().T)
    rows = sp.random_array((3, len(X)), density=0.4, rng=rng)
    assert np.allclose(matrix.congruent(rows), rows @ X @ rows.T)
    for right in (rng.standard_normal(len(X)), rng.standard_normal((len(X), 2))):
        assert np.allclose(matrix @ right, X @ right)
        assert np.allclose(F @ factor.solve_triangular(right), right)
        assert np.allclose(F.T @ factor.solve_triangular(right, transposed=True), right)


@given(st.integers(0, 10_000), st.lists(st.integers(1, 9), min_size=1, max_size=3), st.integers(0, 8))
def test_values_that_are_mostly_zero_have_the_products_of_others(seed: int, sizes: list[int], acting: int) -> None:
    X, _ = mixed_blocks(seed, sizes)
    matrix, rng = BlockDiagonal.of(X), np.random.default_rng(seed)
    for shape in ((len(X),), (len(X), 2)):
        values = np.zeros(shape)
        chosen = rng.permutation(len(X))[:acting]
        values[chosen] = rng.standard_normal((len(chosen), *shape[1:]))
        assert np.allclose(matrix.times_sparse(values), X @ values)


@pytest.mark.parametrize("last", [200, 600])
def test_a_congruence_of_rows_on_a_short_range_of_many_unknowns_is_that_of_all(last: int) -> None:
    rng = np.random.default_rng(last)
    X, rows = spd(600, rng), np.zeros((4, 600))
    rows[:, 100:last] = rng.standard_normal((4, last - 100))
    assert np.allclose(BlockDiagonal.of(X).congruent(sp.csr_array(rows)), rows @ X @ rows.T)
    (chain,) = connected_blocks(np.eye(4) + np.eye(4, k=1) + np.eye(4, k=-1))
    assert chain.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("function", [BlockDiagonal.cholesky, BlockDiagonal.inverse])
def test_what_is_not_positive_definite_is_refused_by_name(function: object) -> None:
    for bad in (-1.0, 0.0, np.nan):
        for X in (np.diag([1.0, bad]), np.array([[1.0, 0.5], [0.5, bad]])):
            with pytest.raises(NumericalError, match="the thing is not positive definite"):
                function(BlockDiagonal.of(X), "the thing")  # type: ignore[operator]
