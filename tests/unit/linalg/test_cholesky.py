import pickle
from itertools import product

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench import NumericalError
from vibench.linalg import cholesky
from vibench.linalg.cholesky import PartialCholesky, SparseCholesky, elimination_order
from vibench.linalg.definite import BlockDiagonal, connected_blocks


def check_factor(factor: SparseCholesky | PartialCholesky, X: np.ndarray, r: np.ndarray) -> None:
    F = factor.apply_factor(np.eye(len(X)))
    assert np.allclose(F.T @ F, X)
    assert np.allclose(F[:, factor.order], np.triu(F[:, factor.order]))
    assert np.allclose(factor.solve_factor(r), np.linalg.solve(F, r))
    assert np.allclose(factor.solve_factor_transposed(r), np.linalg.solve(F.T, r))


@given(st.integers(0, 10_000))
def test_the_factor_is_upper_triangular_in_its_order_and_gives_the_matrix(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X = spd(7, rng)
    factor, r = pickle.loads(pickle.dumps(SparseCholesky(sp.csc_array(X)))), rng.standard_normal((7, 2))
    assert np.allclose(factor.solve(r), np.linalg.solve(X, r))
    check_factor(factor, X, r)


@pytest.mark.parametrize("order", ["C", "F"])
def test_many_right_hand_sides_are_solved_as_few_are(order: str) -> None:
    for columns in (31, 32, 33, 67):
        rng = np.random.default_rng(columns)
        X, r = spd(9, rng), np.asarray(rng.standard_normal((9, columns)), order=order)
        whole, partial = SparseCholesky(sp.csc_array(X)), PartialCholesky(sp.csc_array(X), np.arange(9), 2)
        assert np.allclose(whole.solve(r), np.linalg.solve(X, r))
        for factor in (whole, partial):
            check_factor(factor, X, r)
        assert np.allclose(partial.eliminate(r)[0], np.linalg.solve(X[:7, :7], r[:7]))
        assert np.allclose(partial.extend(r[:2]), np.vstack([-np.linalg.solve(X[:7, :7], X[:7, 7:] @ r[:2]), r[:2]]))


def partly_eliminated(seed: int, count: int, bodies: bool) -> tuple[np.ndarray, np.ndarray, PartialCholesky]:
    """A matrix of order 9, of two blocks or of one, unknowns that are not eliminated, and what is made of both."""
    rng = np.random.default_rng(seed)
    X = scipy.linalg.block_diag(spd(4, rng), spd(5, rng)) if bodies else spd(9, rng)
    mixed, last = rng.permutation(9), rng.permutation(9)[:count]
    X = X[np.ix_(mixed, mixed)]
    factor = PartialCholesky(sp.csc_array(X), elimination_order(sp.csc_array(X), last), count)
    return X, last, pickle.loads(pickle.dumps(factor))


@given(st.integers(0, 10_000), st.integers(0, 9), st.booleans(), st.integers(0, 3))
def test_partial_factors_give_matrix_and_unknowns(seed: int, count: int, bodies: bool, columns: int) -> None:
    X, last, factor = partly_eliminated(seed, count, bodies)
    assert np.array_equal(factor.order[9 - count :], last)
    check_factor(factor, X, np.random.default_rng(seed).standard_normal((9, columns) if columns else 9))
    rest = np.setdiff1d(np.arange(9), last)
    taken = X[np.ix_(last, rest)] @ np.linalg.solve(X[np.ix_(rest, rest)], X[np.ix_(rest, last)])
    S, F = X[np.ix_(last, last)] - taken, factor.trailing_factor
    assert np.allclose([factor.schur_blocks().toarray(), F.T @ F], S)
    assert np.array_equal(F, np.triu(F))
    rng = np.random.default_rng(seed)
    given_there = rng.standard_normal((count, columns) if columns else count)
    u = factor.extend(given_there)
    assert np.allclose((X @ u)[rest], 0.0)
    assert np.array_equal(u[last], given_there)
    r = rng.standard_normal((9, columns) if columns else 9)
    if columns > 1:
        r[rest, 0] = 0.0  # a load of the last unknowns alone
    solved, load = factor.eliminate(r)
    assert np.allclose(X[np.ix_(rest, rest)] @ solved[np.argsort(factor.order[: 9 - count])], r[rest])
    assert np.allclose(load, r[last] - X[np.ix_(last, rest)] @ np.linalg.solve(X[np.ix_(rest, rest)], r[rest]))


@pytest.mark.parametrize("first", [0, 3], ids=["neighbouring rows", "rows with gaps"])
def test_sparse_and_dense_columns_are_multiplied_alike(first: int) -> None:
    """Most of 600 columns have entries in many of 24 rows: they are multiplied in groups of 256, others as sparse."""
    rng = np.random.default_rng(first)
    columns = np.where(rng.random((24, 600)) < rng.choice([0.05, 0.6], 600), rng.standard_normal((24, 600)), 0.0)
    columns[1 : 1 + first] = 0.0
    corner = spd(24, rng)
    product = cholesky._less_products(sp.csc_array(corner), sp.csc_array(columns))
    assert np.allclose(product, corner - columns @ columns.T)


def test_what_is_not_positive_definite_is_refused_by_name() -> None:
    indefinite = np.array([[1.0, 2.0], [2.0, 1.0]])
    for matrix in (-np.eye(3), np.diag([1.0, 0.0, 1.0]), indefinite):
        with pytest.raises(NumericalError, match="the thing"):
            SparseCholesky(sp.csc_array(matrix), "the thing")
        with pytest.raises(NumericalError, match="the thing"):
            PartialCholesky(sp.csc_array(matrix), np.arange(len(matrix)), 0, "the thing")
    factor = PartialCholesky(sp.csc_array(indefinite), np.arange(2), 1, "the thing")
    with pytest.raises(NumericalError, match="the thing is not positive definite"):
        factor.trailing_factor  # noqa: B018  a Schur complement is refused where it is factorised
    for function, bad in product((BlockDiagonal.cholesky, BlockDiagonal.inverse), (-1.0, 0.0, np.nan)):
        for X in (np.diag([1.0, bad]), np.array([[1.0, 0.5], [0.5, bad]])):
            with pytest.raises(NumericalError, match="the thing is not positive definite"):
                function(BlockDiagonal.of(X), "the thing")


def mixed_blocks(seed: int, sizes: list[int]) -> tuple[np.ndarray, list[set[int]]]:
    """A matrix of blocks whose unknowns are mixed, and the unknowns of each."""
    rng, count = np.random.default_rng(seed), sum(sizes)
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
    assert np.allclose((F := factor.toarray()).T @ F, X)
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
        values, chosen = np.zeros(shape), rng.permutation(len(X))[:acting]
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
