from __future__ import annotations

import pickle
from unittest import mock

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import spd

from vibench.errors import NumericalError
from vibench.linalg.cholesky import SparseCholesky, elimination_order


@given(st.integers(0, 10_000), st.booleans())
def test_the_factor_is_upper_triangular_in_its_order_and_gives_the_matrix(seed: int, chosen: bool) -> None:
    rng = np.random.default_rng(seed)
    X = spd(7, rng)
    order = rng.permutation(7) if chosen else None
    factor = SparseCholesky(sp.csc_array(X), order=order)
    F = factor.apply_factor(np.eye(7))
    assert np.allclose(F.T @ F, X)
    assert np.allclose(F[:, factor.order], np.triu(F[:, factor.order]))
    if order is not None:
        assert np.array_equal(factor.order, order)
    r = rng.standard_normal((7, 2))
    assert np.allclose(factor.solve(r), np.linalg.solve(X, r))
    assert np.allclose(factor.solve_factor(r), np.linalg.solve(F, r))
    assert np.allclose(factor.solve_factor_transposed(r), np.linalg.solve(F.T, r))


@given(st.integers(0, 10_000), st.integers(0, 7), st.integers(0, 3))
def test_taking_the_last_unknowns_for_coupled_changes_nothing(seed: int, count: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    X, last = sp.csc_array(spd(7, rng)), rng.permutation(7)[:count]
    order = elimination_order(X, last)
    factor = pickle.loads(pickle.dumps(SparseCholesky(X, order=order, dense=count)))
    y = rng.standard_normal((7, columns)) if columns else rng.standard_normal(7)
    assert np.allclose(factor.apply_factor(factor.solve_factor(y)), y)
    assert np.allclose(factor.solve_factor(y), SparseCholesky(X, order=order).solve_factor(y))


@given(st.integers(0, 10_000), st.integers(0, 7), st.integers(0, 3), st.sampled_from([0, 1000]))
def test_all_unknowns_follow_from_the_last(seed: int, count: int, columns: int, denser: int) -> None:
    rng = np.random.default_rng(seed)
    scale, last = np.diag(rng.uniform(0.5, 2.0, 7)), rng.permutation(7)[:count]
    X = sp.csc_array(scale @ (3.0 * np.eye(7) - np.eye(7, k=1) - np.eye(7, k=-1)) @ scale)  # few depend on each other
    given_there = rng.standard_normal((count, columns) if columns else count)
    with mock.patch("vibench.linalg.cholesky.FILL_RATIO", denser):  # by solving, and by a full matrix
        u = SparseCholesky(X, order=elimination_order(X, last), dense=count).extend(given_there)
    rest = np.setdiff1d(np.arange(7), last)
    assert np.allclose((X @ u)[rest], 0.0)
    assert np.array_equal(u[last], given_there)


@given(st.integers(0, 10_000), st.integers(0, 7))
def test_the_tail_is_a_factor_of_the_schur_complement(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    X = spd(7, rng)
    last = rng.permutation(7)[:count]
    factor = SparseCholesky(sp.csc_array(X), order=elimination_order(sp.csc_array(X), last), dense=count)
    assert np.array_equal(factor.order[7 - count :], last)
    rest = np.setdiff1d(np.arange(7), last)
    taken = X[np.ix_(last, rest)] @ np.linalg.solve(X[np.ix_(rest, rest)], X[np.ix_(rest, last)])
    F = factor.trailing_factor()
    assert np.allclose(F.T @ F, X[np.ix_(last, last)] - taken)


@pytest.mark.parametrize("matrix", [-np.eye(3), np.diag([1.0, 0.0, 1.0]), np.array([[1.0, 2.0], [2.0, 1.0]])])
def test_what_is_not_positive_definite_is_refused_by_name(matrix: np.ndarray) -> None:
    with pytest.raises(NumericalError, match="the thing"):
        SparseCholesky(sp.csc_array(matrix), "the thing")
