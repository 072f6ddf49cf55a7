import pickle

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import space, spd

from vibench import NumericalError
from vibench.linalg.inner_product import InnerProduct, factorised_later, orthonormal_range, project_out, singular_values

seeds = st.integers(0, 10_000)


@given(seeds, st.integers(1, 20))
def test_whitening_carries_the_inner_product_and_riesz_representers_represent(seed: int, n: int) -> None:
    X, rng = space(n, seed), np.random.default_rng(seed)
    u, v, functional = rng.standard_normal((n, 3)), rng.standard_normal((n, 2)), rng.standard_normal(n)
    assert np.allclose(X.whiten(u).T @ X.whiten(v), X.gram(u, v), atol=1e-11)
    assert np.allclose(X.gram(u, v), u.T @ X.matrix.toarray() @ v, atol=1e-11)
    assert np.allclose(X.unwhiten(X.whiten(u)), u, atol=1e-12)
    assert np.allclose(X.norm(u), np.sqrt(np.diag(X.gram(u, u))))
    assert np.allclose(X.gram(X.riesz(functional), v), functional @ v, atol=1e-11)
    whitened = X.whiten_functional(functional)
    assert np.allclose(whitened, X.whiten(X.riesz(functional)), atol=1e-12)
    assert np.isclose(np.linalg.norm(whitened), np.sqrt(functional @ X.riesz(functional)))


@given(seeds)
def test_orthonormalisation_keeps_the_span_and_leaves_out_what_is_there(seed: int) -> None:
    X, rng = space(15, seed), np.random.default_rng(seed)
    first = X.orthonormalise(rng.standard_normal((15, 4)))
    added = X.orthonormalise(np.hstack([rng.standard_normal((15, 3)), first]), first)
    Z = np.hstack([first, added])
    assert Z.shape == (15, 7)
    assert np.allclose(X.gram(Z, Z), np.eye(7), atol=1e-12)


def test_empty_bases_are_fine_and_inner_products_travel_between_processes() -> None:
    X, nothing = space(5), np.zeros((5, 0))
    assert X.orthonormalise(nothing).shape == X.orthonormalise(np.zeros((5, 2))).shape == (5, 0)
    assert X.gram(nothing, nothing).shape == (0, 0)
    assert X.whiten_functional(nothing).shape == (5, 0)
    assert singular_values(np.zeros((4, 0))).shape == (0,)
    u = np.arange(5.0)
    assert np.array_equal(pickle.loads(pickle.dumps(X)).whiten(u), X.whiten(u))


def test_what_is_no_inner_product_is_refused_at_once_or_later() -> None:
    for matrix, message in (
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive definite"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "not symmetric"),
        (np.ones((2, 3)), "must be square"),
        (np.array([[np.nan, 0.0], [0.0, 1.0]]), "not finite"),
        (np.zeros((2, 2)), "factorised|not positive definite"),
        (-spd(3, np.random.default_rng(0)), "not positive definite"),
    ):
        with pytest.raises(NumericalError, match=message):
            InnerProduct(sp.csc_array(matrix))
    indefinite, made = sp.csc_array([[1.0, 2.0], [2.0, 1.0]]), []
    with pytest.raises(NumericalError, match="X is not positive definite"), factorised_later():
        made.append(InnerProduct(indefinite, "X"))
    assert len(made) == 1
    with pytest.raises(NumericalError, match="must be square"), factorised_later():
        InnerProduct(sp.csc_array(np.ones((2, 3))))
    with pytest.raises(NumericalError, match="not positive definite"):
        InnerProduct(indefinite)


@given(seeds, st.integers(1, 5))
def test_range_has_the_rank_of_its_vectors(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((12, rank)) @ rng.standard_normal((rank, 9))
    assert (q := orthonormal_range(y)).shape == (12, rank)
    assert np.allclose(q.T @ q, np.eye(rank), atol=1e-13)
    assert np.allclose(q @ (q.T @ y), y, atol=1e-12 * np.abs(y).max())


def test_ranges_drop_duplicates_and_are_orthogonal_to_a_given_space() -> None:
    e = np.eye(6)
    y = np.column_stack([e[0], e[0], np.zeros(6), 1e-9 * e[1], e[0] + 1e-15 * e[2]])
    assert (q := orthonormal_range(y)).shape[1] == 2
    assert np.allclose(np.abs(q.T @ e[:, :2]), np.eye(2), atol=1e-9)
    rng = np.random.default_rng(1)
    fixed, _ = np.linalg.qr(rng.standard_normal((20, 5)))
    nearly = fixed @ rng.standard_normal((5, 3)) + 1e-8 * rng.standard_normal((20, 3))
    inside = fixed @ rng.standard_normal((5, 2))
    assert (q := orthonormal_range(np.hstack([nearly, inside]), fixed)).shape[1] == 3
    assert np.abs(fixed.T @ q).max() < 1e-14
    assert np.allclose(q.T @ q, np.eye(3), atol=1e-13)
    rest = project_out(fixed, y := rng.standard_normal((20, 2)))
    assert np.abs(fixed.T @ rest).max() < 1e-15
    assert np.allclose(fixed @ (fixed.T @ y) + rest, y)
