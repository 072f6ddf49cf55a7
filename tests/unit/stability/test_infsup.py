from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from numerics import Varying, space

from vibench.linalg.inner_product import RANK_RTOL, InnerProduct
from vibench.reduction.supremizers import supremizers
from vibench.stability.infsup import beta_span, cone_basis, inf_sup_full, inf_sup_on, nodal_cone

seeds = st.integers(0, 10_000)


@given(seeds)
def test_the_span_constant_is_the_smallest_generalised_singular_value(seed: int) -> None:
    W = space(6, seed)
    rng = np.random.default_rng(seed)
    chi = rng.random((6, 3))
    cone = cone_basis(chi / W.norm(chi), W)
    image = rng.standard_normal((5, 6))
    smallest = scipy.linalg.eigh(
        (image @ cone.chi).T @ (image @ cone.chi), cone.gram, eigvals_only=True, subset_by_index=[0, 0]
    )[0]
    assert np.isclose(beta_span(image @ cone.span), np.sqrt(max(smallest, 0.0)), rtol=1e-6, atol=1e-7)


def test_the_span_constant_is_zero_exactly_below_the_rank_and_honest_at_it() -> None:
    W = space(6)
    chi = np.random.default_rng(0).random((6, 3))
    chi = np.column_stack([chi, chi[:, 0] + chi[:, 1]])  # rank 3 of 4
    cone = cone_basis(chi / W.norm(chi), W)
    assert cone.rank == 3
    assert beta_span(np.ones((2, 3))) == 0.0
    assert beta_span(np.eye(3)) == 1.0
    assert beta_span(np.zeros((4, 0))) == np.inf


def kahan(n: int, c: float) -> np.ndarray:
    """Kahan's matrix with unit columns: no diagonal entry of its QR factor is small, its last singular value is."""
    s = np.sqrt(1.0 - c**2)
    matrix = np.diag(s ** np.arange(n)) @ (np.eye(n) - c * np.triu(np.ones((n, n)), 1))
    return np.asarray(matrix / np.linalg.norm(matrix, axis=0))


def test_the_rank_is_that_of_the_singular_values() -> None:
    chi = kahan(90, 0.3)
    assert abs(scipy.linalg.qr(chi, pivoting=True)[1][-1, -1]) > RANK_RTOL  # which hides the deficiency
    cone = cone_basis(chi, InnerProduct(sp.eye_array(90)))
    assert cone.rank == 89
    assert np.allclose(cone.span.T @ cone.span, np.eye(89), atol=1e-12)
    assert cone.rank_gap > 1e8


def test_a_rank_without_a_gap_is_seen() -> None:
    """Singular values that fall evenly through the threshold."""
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.standard_normal((20, 16)))[0] for _ in range(2))
    chi = left @ np.diag(10.0 ** -np.arange(16.0)) @ right[:16].T
    cone = cone_basis(chi, InnerProduct(sp.eye_array(20)))
    assert cone.rank in (12, 13)
    assert 5.0 < cone.rank_gap < 20.0


def test_a_full_rank_just_above_the_threshold_is_seen() -> None:
    cone = cone_basis(np.diag([1.0, 0.5, 3.0 * RANK_RTOL]), InnerProduct(sp.eye_array(3)))
    assert cone.rank == 3
    assert cone.rank_gap == pytest.approx(3.0)


@pytest.mark.parametrize("distance", [1e-4, 1e-8, 1e-11, 1e-13])
def test_the_condition_of_nearly_parallel_generators_does_not_saturate(distance: float) -> None:
    """cond G = (1 + cos φ) / (1 − cos φ) of two unit vectors at the angle φ: 4 / φ² for small angles."""
    chi = np.array([[1.0, np.cos(distance)], [0.0, np.sin(distance)]])
    cone = cone_basis(chi, InnerProduct(sp.eye_array(2)))
    assert cone.gram_condition == pytest.approx(4.0 / distance**2, rel=1e-2)


def test_without_generators_there_is_neither_rank_nor_condition() -> None:
    cone = cone_basis(np.zeros((6, 0)), space(6))
    assert (cone.rank, cone.gram_condition, cone.rank_gap) == (0, None, np.inf)
    assert cone.span.shape == (6, 0)


@pytest.mark.parametrize("mu", [0.0, 0.5, 1.0])
def test_the_order_of_the_constants(mu: float) -> None:
    """Full ≥ own ≥ plain, full ≥ high-fidelity, own = full with all supremizers, cone ≥ span."""
    problem = Varying()
    B = problem.assemble(np.array([mu])).B
    rng = np.random.default_rng(1)
    chi = rng.random((8, 3))
    cone = cone_basis(chi / problem.W.norm(chi), problem.W)
    V = problem.V
    plain = V.orthonormalise(rng.standard_normal((30, 2)))
    own = np.hstack([plain, V.orthonormalise(supremizers(V, B, cone.span[:, :2]), plain)])
    online = np.hstack([plain, V.orthonormalise(supremizers(V, B, cone.span), plain)])
    small, middle, large = (inf_sup_on(Z, B, cone) for Z in (plain, own, online))
    full, hf = inf_sup_full(V, B, cone), inf_sup_full(V, B, nodal_cone(problem.W))
    for bigger, smaller in ((middle, small), (full, middle), (full, hf)):
        assert bigger.span >= smaller.span - 1e-12
        assert bigger.cone_upper >= smaller.cone_lower - 1e-12
    assert np.isclose(large.span, full.span, rtol=1e-10)
    assert np.isclose(large.cone_upper, full.cone_upper, rtol=1e-10)
    for found in (small, middle, large, full, hf):
        assert found.cone_upper >= found.span - 1e-12
        assert found.cone_lower <= found.cone_upper
    assert np.isclose(full.scaled(-2.0).span, 2.0 * full.span)


def test_the_high_fidelity_constant_against_the_dense_eigenproblem() -> None:
    problem = Varying()
    B = problem.assemble(np.array([0.7])).B
    S = (B @ np.linalg.solve(problem.V.matrix.toarray(), B.T.toarray())).astype(float)
    smallest = scipy.linalg.eigh(S, problem.W.matrix.toarray(), eigvals_only=True)[0]
    found = inf_sup_full(problem.V, B, nodal_cone(problem.W))
    assert np.isclose(found.span, np.sqrt(smallest), rtol=1e-8)


def test_nearly_parallel_generators_do_not_push_the_constant_below_the_high_fidelity_one() -> None:
    V, W = InnerProduct(sp.eye_array(6)), InnerProduct(sp.eye_array(4))
    B = sp.csr_array(np.eye(4, 6) * np.array([[1.0], [0.5], [0.1], [0.01]]))
    base = np.array([1.0, 1.0, 1.0, 0.0])
    chi = np.column_stack([base, base + 1e-9 * np.array([0.0, 1.0, 0.0, 0.0]), base + np.array([0.0, 0.0, 1.0, 0.0])])
    cone = cone_basis(chi / W.norm(chi), W)
    assert cone.rank == 3
    assert inf_sup_full(V, B, cone).span >= 0.1 * (1.0 - 1e-6)
