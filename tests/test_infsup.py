from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st

from numerics import Varying, space
from vibench.infsup import (
    beta_span,
    cone_interval,
    inf_sup_full,
    inf_sup_on,
    multipliers,
    nodal_multipliers,
    simplex_minimiser,
)
from vibench.space import InnerProduct
from vibench.supremizer import supremizers

seeds = st.integers(0, 10_000)


def cone_minimum_by_faces(M: np.ndarray, G: np.ndarray) -> float:
    """min √(αᵀMα / αᵀGα) over α ≥ 0: on the face where it sits, α is a positive generalised eigenvector."""
    best = np.inf
    for size in range(1, len(G) + 1):
        for face in combinations(range(len(G)), size):
            pick = np.ix_(face, face)
            values, vectors = scipy.linalg.eigh(M[pick], G[pick])
            for value, vector in zip(values, vectors.T, strict=True):
                if np.all(vector >= -1e-10) or np.all(vector <= 1e-10):
                    best = min(best, np.sqrt(max(value, 0.0)))
    return best


def random_pair(seed: int, rows: int, count: int, shift: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    chi = rng.random((10, count))
    chi /= np.linalg.norm(chi, axis=0)
    return rng.standard_normal((rows, count)) + shift, chi.T @ chi


@given(seeds, st.integers(2, 6), st.integers(1, 5), st.sampled_from([0.0, 0.5, 3.0]))
def test_the_cone_interval_holds_the_minimum_over_all_faces(seed: int, rows: int, count: int, shift: float) -> None:
    C, G = random_pair(seed, rows, count, shift)
    span = float(np.sqrt(max(scipy.linalg.eigh(C.T @ C, G, eigvals_only=True)[0], 0.0)))
    lower, upper, sharp = cone_interval(C, G, span)
    exact = cone_minimum_by_faces(C.T @ C, G)
    assert lower <= exact * (1.0 + 1e-7) + 1e-7  # the brute force squares: it knows zero only to 1e-8
    assert exact <= upper * (1.0 + 1e-7) + 1e-7
    assert sharp.split("/")[0] in ("L0", "L½", "L1")
    assert sharp.split("/")[1] in ("U0", "U1")


def test_the_interval_is_a_point_where_the_minimum_sits_on_a_generator() -> None:
    C = np.array([[1.0, 0.9], [0.0, 1.5]])
    G = np.array([[1.0, 0.2], [0.2, 1.0]])
    lower, upper, sharp = cone_interval(C, G, 0.1)
    assert lower == upper == 1.0
    assert sharp == "L½/U0"


def test_opposite_images_leave_no_stability_over_the_cone() -> None:
    C, G = np.array([[1.0, -1.0], [0.0, 0.0]]), np.eye(2)
    lower, upper, _ = cone_interval(C, G, 0.0)
    assert lower == 0.0
    assert upper < 1e-12


@given(seeds)
def test_the_simplex_minimiser_beats_every_other_point(seed: int) -> None:
    C, _ = random_pair(seed, 4, 5, 0.5)
    alpha = simplex_minimiser(1e-3 * C)
    assert np.isclose(alpha.sum(), 1.0)
    assert np.all(alpha >= 0.0)
    others = np.random.default_rng(seed).dirichlet(np.ones(5), 200)
    assert np.linalg.norm(C @ alpha) <= np.linalg.norm(C @ others.T, axis=0).min() + 1e-9


@given(seeds)
def test_the_span_constant_is_the_smallest_generalised_singular_value(seed: int) -> None:
    W = space(6, seed)
    rng = np.random.default_rng(seed)
    chi = rng.random((6, 3))
    cone = multipliers(chi / W.norm(chi), W)
    image = rng.standard_normal((5, 6))
    smallest = scipy.linalg.eigh(
        (image @ cone.chi).T @ (image @ cone.chi), cone.gram, eigvals_only=True, subset_by_index=[0, 0]
    )[0]
    assert np.isclose(beta_span(image @ cone.span), np.sqrt(max(smallest, 0.0)), rtol=1e-6, atol=1e-7)


def test_the_span_constant_is_zero_exactly_below_the_rank_and_honest_at_it() -> None:
    W = space(6)
    chi = np.random.default_rng(0).random((6, 3))
    chi = np.column_stack([chi, chi[:, 0] + chi[:, 1]])  # rank 3 of 4
    cone = multipliers(chi / W.norm(chi), W)
    assert cone.rank == 3
    assert beta_span(np.ones((2, 3))) == 0.0
    assert beta_span(np.eye(3)) == 1.0
    assert beta_span(np.zeros((4, 0))) == np.inf


@pytest.mark.parametrize("mu", [0.0, 0.5, 1.0])
def test_the_order_of_the_constants(mu: float) -> None:
    """Full ≥ own ≥ plain, full ≥ high-fidelity, own = full with all supremizers, cone ≥ span."""
    problem = Varying()
    B = problem.assemble(np.array([mu])).B
    rng = np.random.default_rng(1)
    chi = rng.random((8, 3))
    cone = multipliers(chi / problem.W.norm(chi), problem.W)
    V = problem.V
    plain = V.orthonormalise(rng.standard_normal((30, 2)))
    own = np.hstack([plain, V.orthonormalise(supremizers(V, B, cone.span[:, :2]), plain)])
    online = np.hstack([plain, V.orthonormalise(supremizers(V, B, cone.span), plain)])
    small, middle, large = (inf_sup_on(Z, B, cone) for Z in (plain, own, online))
    full, hf = inf_sup_full(V, B, cone), inf_sup_full(V, B, nodal_multipliers(problem.W))
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
    found = inf_sup_full(problem.V, B, nodal_multipliers(problem.W))
    assert np.isclose(found.span, np.sqrt(smallest), rtol=1e-8)


def test_nearly_parallel_generators_do_not_push_the_constant_below_the_high_fidelity_one() -> None:
    V, W = InnerProduct(sp.eye_array(6)), InnerProduct(sp.eye_array(4))
    B = sp.csr_array(np.eye(4, 6) * np.array([[1.0], [0.5], [0.1], [0.01]]))
    base = np.array([1.0, 1.0, 1.0, 0.0])
    chi = np.column_stack([base, base + 1e-9 * np.array([0.0, 1.0, 0.0, 0.0]), base + np.array([0.0, 0.0, 1.0, 0.0])])
    cone = multipliers(chi / W.norm(chi), W)
    assert cone.rank == 3
    assert inf_sup_full(V, B, cone).span >= 0.1 * (1.0 - 1e-6)
