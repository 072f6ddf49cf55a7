from itertools import combinations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import Varying, space

from vibench.linalg.inner_product import RANK_RTOL, InnerProduct
from vibench.reduction.supremizers import constraint_classes, supremizers
from vibench.stability import infsup
from vibench.stability.infsup import beta_span, cone_basis, cone_interval, inf_sup_full

seeds = st.integers(0, 10_000)


@given(seeds)
def test_the_span_constant_is_the_smallest_generalised_singular_value(seed: int) -> None:
    W, rng = space(6, seed), np.random.default_rng(seed)
    chi = rng.random((6, 3))
    cone, image = cone_basis(chi / W.norm(chi), W), rng.standard_normal((5, 6))
    assert np.isclose(beta_span(image @ cone.span), span_constant(image @ cone.chi, cone.gram), rtol=1e-6, atol=1e-7)


def kahan(n: int, c: float) -> np.ndarray:
    """Kahan's matrix with unit columns: no diagonal entry of its QR factor is small, its last singular value is."""
    s = np.sqrt(1.0 - c**2)
    matrix = np.diag(s ** np.arange(n)) @ (np.eye(n) - c * np.triu(np.ones((n, n)), 1))
    return np.asarray(matrix / np.linalg.norm(matrix, axis=0))


def test_the_rank_is_that_of_singular_values_and_conditions_do_not_saturate() -> None:
    """cond G = (1 + cos φ) / (1 − cos φ) of two unit vectors at the angle φ: 4 / φ² for small angles."""
    chi = kahan(90, 0.3)
    assert abs(scipy.linalg.qr(chi, pivoting=True)[1][-1, -1]) > RANK_RTOL  # which hides the deficiency
    cone = cone_basis(chi, InnerProduct(sp.eye_array(90)))
    assert cone.rank == 89
    assert np.allclose(cone.span.T @ cone.span, np.eye(89), atol=1e-12)
    assert cone.rank_gap > 1e8
    # singular values that fall evenly through the threshold have no gap there
    rng = np.random.default_rng(0)
    left, right = (np.linalg.qr(rng.standard_normal((20, 16)))[0] for _ in range(2))
    cone = cone_basis(left @ np.diag(10.0 ** -np.arange(16.0)) @ right[:16].T, InnerProduct(sp.eye_array(20)))
    assert cone.rank in (12, 13)
    assert 5.0 < cone.rank_gap < 20.0
    # a full rank just above the threshold
    cone = cone_basis(np.diag([1.0, 0.5, 3.0 * RANK_RTOL]), InnerProduct(sp.eye_array(3)))
    assert (cone.rank, cone.rank_gap) == (3, pytest.approx(3.0))
    # three generators and a sum of two of them
    W, chi = space(6), np.random.default_rng(0).random((6, 3))
    chi = np.column_stack([chi, chi[:, 0] + chi[:, 1]])
    assert cone_basis(chi / W.norm(chi), W).rank == 3
    # no generators
    cone = cone_basis(np.zeros((6, 0)), W)
    assert (cone.rank, cone.gram_condition, cone.rank_gap, cone.span.shape) == (0, None, np.inf, (6, 0))
    assert (beta_span(np.ones((2, 3))), beta_span(np.eye(3)), beta_span(np.zeros((4, 0)))) == (0.0, 1.0, np.inf)
    for distance in (1e-4, 1e-8, 1e-11, 1e-13):
        chi = np.array([[1.0, np.cos(distance)], [0.0, np.sin(distance)]])
        cone = cone_basis(chi, InnerProduct(sp.eye_array(2)))
        assert cone.gram_condition == pytest.approx(4.0 / distance**2, rel=1e-2)


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
    small, middle, large = (infsup.inf_sup_on(Z, B, cone) for Z in (plain, own, online))
    full, hf = inf_sup_full(V, B, cone), inf_sup_full(V, B, infsup.nodal_cone(problem.W))
    for bigger, smaller in ((middle, small), (full, middle), (full, hf)):
        assert bigger.span >= smaller.span - 1e-12
        assert bigger.cone_upper >= smaller.cone_lower - 1e-12
    assert np.isclose(large.span, full.span, rtol=1e-10)
    assert np.isclose(large.cone_upper, full.cone_upper, rtol=1e-10)
    for found in (small, middle, large, full, hf):
        assert found.cone_upper >= found.span - 1e-12
        assert found.cone_lower <= found.cone_upper
    assert np.isclose(full.scaled(-2.0).span, 2.0 * full.span)


def test_the_full_constant_against_the_dense_eigenproblem_and_for_nearly_parallel_generators() -> None:
    problem = Varying()
    B = problem.assemble(np.array([0.7])).B
    S = (B @ np.linalg.solve(problem.V.matrix.toarray(), B.T.toarray())).astype(float)
    smallest = scipy.linalg.eigh(S, problem.W.matrix.toarray(), eigvals_only=True)[0]
    found = inf_sup_full(problem.V, B, infsup.nodal_cone(problem.W))
    assert np.isclose(found.span, np.sqrt(smallest), rtol=1e-8)
    V, W = InnerProduct(sp.eye_array(6)), InnerProduct(sp.eye_array(4))
    B = sp.csr_array(np.eye(4, 6) * np.array([[1.0], [0.5], [0.1], [0.01]]))
    base = np.array([1.0, 1.0, 1.0, 0.0])
    chi = np.column_stack([base, base + 1e-9 * np.array([0.0, 1.0, 0.0, 0.0]), base + np.array([0.0, 0.0, 1.0, 0.0])])
    cone = cone_basis(chi / W.norm(chi), W)
    assert cone.rank == 3
    assert inf_sup_full(V, B, cone).span >= 0.1 * (1.0 - 1e-6)


@given(st.integers(0, 10_000), st.integers(0, 3), st.integers(1, 4), st.sampled_from([0.0, 1e-7, 1e-3, 1.0]))
def test_steps_are_the_smallest_constants_of_leading_parts(seed: int, first: int, count: int, small: float) -> None:
    """Columns that nearly coincide would lose digits in Gram matrices."""
    rng = np.random.default_rng(seed)
    one, other = sp.csr_array(rng.standard_normal((3, 5))), sp.csr_array(rng.standard_normal((3, 5)))
    classes = constraint_classes([one, 0.1 * one, other, -2.0 * other])
    projected = [rng.standard_normal((first + 5, count)) for _ in classes.representatives]
    for block in projected:
        block[:, -1] = block[:, 0] + small * block[:, -1]
    found = infsup.ProjectedSupremizers(projected, classes)
    pairs = list(zip(classes.members, classes.factors, strict=True))
    direct = np.array([[abs(c) * beta_span(projected[k][:r]) for k, c in pairs] for r in range(first, first + 6)])
    assert found.over_steps(first) == pytest.approx(direct.min(axis=1), rel=1e-12, abs=1e-14)
    assert found.beta_span() == pytest.approx(direct[-1], rel=1e-12)
    reachable = np.abs(classes.factors) * (1.0 + rng.random(2)[classes.members]) * (1.0 + direct.max())
    shares = (direct / reachable).min(axis=1)  # parameter by parameter: a ratio of minima would be another number
    assert found.stability_ratios(first, reachable) == pytest.approx(shares, rel=1e-12, abs=1e-14)
    assert found.first(first + 2).beta_span() == pytest.approx(direct[2], rel=1e-12)


HORN = scipy.linalg.circulant([1.0, -1.0, 1.0, 1.0, -1.0])
"""Horn's matrix: copositive, but no sum of a positive semidefinite and a nonnegative matrix."""


def minimum_by_faces(M: np.ndarray, G: np.ndarray) -> float:
    """min √(αᵀMα / αᵀGα) over α ≥ 0: on the face where it sits, α is a positive generalised eigenvector."""
    best = np.inf
    for size in range(1, len(G) + 1):
        for face in combinations(range(len(G)), size):
            pick = np.ix_(face, face)
            values, vectors = scipy.linalg.eigh(M[pick], G[pick])
            positive = np.all(vectors >= -1e-10, axis=0) | np.all(vectors <= 1e-10, axis=0)
            best = min(best, float(values[positive].min(initial=np.inf)))
    return float(np.sqrt(max(best, 0.0)))


def random_pair(seed: int, rows: int, count: int, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Projected supremizers of either sign, and the Gram matrix of nonnegative generators."""
    rng = np.random.default_rng(seed)
    chi = rng.random((2 * count, count)) ** 3
    chi /= np.linalg.norm(chi, axis=0)
    return rng.standard_normal((rows, count)) + shift, chi.T @ chi


def span_constant(C: np.ndarray, G: np.ndarray) -> float:
    return float(np.sqrt(max(scipy.linalg.eigh(C.T @ C, G, eigvals_only=True)[0], 0.0)))


@given(seeds, st.integers(2, 6), st.integers(1, 5), st.sampled_from([0.0, 0.5, 3.0]))
def test_the_cone_interval_holds_the_minimum_over_all_faces(seed: int, rows: int, count: int, shift: float) -> None:
    C, G = random_pair(seed, rows, count, shift)
    lower, upper, sharp = cone_interval(C, G, span_constant(C, G))
    exact = minimum_by_faces(C.T @ C, G)
    assert lower <= exact * (1.0 + 1e-7) + 1e-7  # the brute force squares: it knows zero only to 1e-8
    assert exact <= upper * (1.0 + 1e-7) + 1e-7
    assert sharp.split("/")[0] in ("L0", "L½", "L1", "SDP")
    assert sharp.split("/")[1] in ("U0", "U1", "U2")


def test_hard_cases_are_known_to_one_percent() -> None:
    """M changes its sign, and there are fewer primal vectors than generators, or hardly more."""
    for seed in range(30):
        count = 4 + seed % 6
        C, G = random_pair(seed, count - 2 + seed % 4, count, 0.0)
        C[:, 0] *= np.sign(-(C[:, 0] @ C[:, 1]))
        assert (C.T @ C).min() < 0.0
        lower, upper, _ = cone_interval(C, G, span_constant(C, G))
        exact = minimum_by_faces(C.T @ C, G)
        assert lower - 1e-7 <= exact <= upper + 1e-7
        if seed != 24:  # there the semidefinite program is not exact
            assert upper - lower <= 0.01 * upper + 1e-7
    # many generators count, or the program is not exact
    C, G = random_pair(5, 7, 10, 0.4)
    M = C.T @ C
    lower, upper, sharp = cone_interval(C, G, 0.0)
    exact = minimum_by_faces(M, G)
    assert np.sqrt(np.diag(M).min()) > 1.2 * exact  # no generator alone
    assert lower <= exact <= upper * (1.0 + 1e-9)
    assert upper - lower <= 0.01 * upper
    assert sharp == "SDP/U2"
    M, G = HORN + 1.5 * np.eye(5), np.eye(5)  # the smallest quotient is 1.5, at two neighbours of the pentagon
    assert minimum_by_faces(M, G) == pytest.approx(np.sqrt(1.5))
    lower, upper, sharp = cone_interval(np.linalg.cholesky(M).T, G, 0.5)
    assert sharp.startswith("SDP/")
    assert lower < 0.99 * np.sqrt(1.5)
    assert np.sqrt(1.5) <= upper * (1.0 + 1e-12)


@given(seeds, st.integers(2, 7))
@settings(max_examples=12)
def test_certificates_hold_whatever_the_iterations_reached(seed: int, count: int) -> None:
    C, G = random_pair(seed, count, count, 0.2)
    M, exact = C.T @ C, minimum_by_faces(C.T @ C, G) ** 2
    assert infsup.entrywise_bound(M, G) <= exact * (1.0 + 1e-9) + 1e-12
    lower, upper = infsup.semidefinite_bounds(M, G, upper=np.inf, fraction=1.0)
    assert lower <= exact * (1.0 + 1e-9) + 1e-12
    assert exact <= upper * (1.0 + 1e-9) + 1e-12


def test_intervals_of_special_cases_and_rounded_zeros() -> None:
    """Neighbours touch, others do not; the products of the images are all positive."""
    none = infsup.ProjectedSupremizers([np.zeros((4, 0))], constraint_classes([sp.csr_array(np.ones((2, 3)))]))
    assert none.over_steps(2).tolist() == [np.inf] * 3  # without multipliers nothing is unstable
    assert none.stability_ratios(2, np.array([np.inf])).tolist() == [1.0] * 3
    G = np.eye(4) + 0.3 * np.diag(np.ones(3), 1) + 0.3 * np.diag(np.ones(3), -1)
    M = np.ones((4, 4)) + np.diag([1.0, 2.0, 3.0, 4.0])
    for noise in (-1e-17, 1e-17):
        assert infsup.entrywise_bound(M, np.where(G == 0.0, noise, G)) == 2.0
    M[0, 3] = M[3, 0] = -0.1
    assert infsup.entrywise_bound(M, G) == pytest.approx(2.0 - 4 * 0.1)
    G = np.array([[1.0, 0.2], [0.2, 1.0]])
    # a point where the minimum sits on a generator
    assert cone_interval(np.array([[1.0, 0.9], [0.0, 1.5]]), G, 0.1) == (1.0, 1.0, "L½/U0")
    # opposite images leave no stability over the cone
    lower, upper, _ = cone_interval(np.array([[1.0, -1.0], [0.0, 0.0]]), np.eye(2), 0.0)
    assert lower == 0.0
    assert upper < 1e-12
    # without generators, and without primal vectors
    assert cone_interval(np.zeros((3, 0)), np.zeros((0, 0)), np.inf)[:2] == (np.inf, np.inf)
    assert cone_interval(np.zeros((0, 2)), np.eye(2), 0.0)[:2] == (0.0, 0.0)
    # Only a bug leads to a lower bound above the upper one; the invariants of a run are to show it.
    assert cone_interval(np.eye(2), np.eye(2), span=2.0)[:2] == (2.0, 1.0)


@given(seeds)
def test_the_simplex_minimiser_beats_every_other_point(seed: int) -> None:
    C, _ = random_pair(seed, 4, 5, 0.5)
    alpha = infsup.simplex_minimiser(1e-3 * C)
    assert np.isclose(alpha.sum(), 1.0)
    assert np.all(alpha >= 0.0)
    others = np.random.default_rng(seed).dirichlet(np.ones(5), 200)
    assert np.linalg.norm(C @ alpha) <= np.linalg.norm(C @ others.T, axis=0).min() + 1e-9
