from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from vibench.stability.infsup import cone_interval, entrywise_bound, semidefinite_bounds, simplex_minimiser

seeds = st.integers(0, 10_000)

HORN = np.array(
    [[1, -1, 1, 1, -1], [-1, 1, -1, 1, 1], [1, -1, 1, -1, 1], [1, 1, -1, 1, -1], [-1, 1, 1, -1, 1]], dtype=float
)
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


@pytest.mark.parametrize("seed", range(30))
def test_hard_cases_are_known_to_one_percent(seed: int) -> None:
    """M changes its sign, and there are fewer primal vectors than generators, or hardly more."""
    count = 4 + seed % 6
    C, G = random_pair(seed, count - 2 + seed % 4, count, 0.0)
    C[:, 0] *= np.sign(-(C[:, 0] @ C[:, 1]))
    assert (C.T @ C).min() < 0.0
    lower, upper, _ = cone_interval(C, G, span_constant(C, G))
    exact = minimum_by_faces(C.T @ C, G)
    assert lower - 1e-7 <= exact <= upper + 1e-7
    if seed != 24:  # there the semidefinite program is not exact
        assert upper - lower <= 0.01 * upper + 1e-7


def test_ten_generators_of_which_the_minimum_needs_many() -> None:
    C, G = random_pair(5, 7, 10, 0.4)
    M = C.T @ C
    lower, upper, sharp = cone_interval(C, G, 0.0)
    exact = minimum_by_faces(M, G)
    assert np.sqrt(np.diag(M).min()) > 1.2 * exact  # no generator alone
    assert lower <= exact <= upper * (1.0 + 1e-9)
    assert upper - lower <= 0.01 * upper
    assert sharp == "SDP/U2"


def test_where_the_semidefinite_program_is_not_exact_the_interval_stays_wide_and_certified() -> None:
    M, G = HORN + 1.5 * np.eye(5), np.eye(5)  # the smallest quotient is 1.5, at two neighbours of the pentagon
    assert minimum_by_faces(M, G) == pytest.approx(np.sqrt(1.5))
    lower, upper, sharp = cone_interval(np.linalg.cholesky(M).T, G, 0.5)
    assert sharp.startswith("SDP/")
    assert lower < 0.99 * np.sqrt(1.5)
    assert np.sqrt(1.5) <= upper * (1.0 + 1e-12)


@given(seeds, st.integers(2, 7))
def test_certificates_hold_whatever_the_iterations_reached(seed: int, count: int) -> None:
    C, G = random_pair(seed, count, count, 0.2)
    M, exact = C.T @ C, minimum_by_faces(C.T @ C, G) ** 2
    assert entrywise_bound(M, G) <= exact * (1.0 + 1e-9) + 1e-12
    lower, upper = semidefinite_bounds(M, G, upper=np.inf, fraction=1.0)
    assert lower <= exact * (1.0 + 1e-9) + 1e-12
    assert exact <= upper * (1.0 + 1e-9) + 1e-12


def test_zeros_of_the_gram_matrix_that_were_rounded_limit_nothing() -> None:
    """Neighbours touch, others do not; the products of the images are all positive."""
    G = np.eye(4) + 0.3 * np.diag(np.ones(3), 1) + 0.3 * np.diag(np.ones(3), -1)
    M = np.ones((4, 4)) + np.diag([1.0, 2.0, 3.0, 4.0])
    for noise in (-1e-17, 1e-17):
        assert entrywise_bound(M, np.where(G == 0.0, noise, G)) == 2.0
    M[0, 3] = M[3, 0] = -0.1
    assert entrywise_bound(M, G) == pytest.approx(2.0 - 4 * 0.1)


def test_the_interval_is_a_point_where_the_minimum_sits_on_a_generator() -> None:
    C = np.array([[1.0, 0.9], [0.0, 1.5]])
    G = np.array([[1.0, 0.2], [0.2, 1.0]])
    assert cone_interval(C, G, 0.1) == (1.0, 1.0, "L½/U0")


def test_opposite_images_leave_no_stability_over_the_cone() -> None:
    C, G = np.array([[1.0, -1.0], [0.0, 0.0]]), np.eye(2)
    lower, upper, _ = cone_interval(C, G, 0.0)
    assert lower == 0.0
    assert upper < 1e-12


def test_without_generators_the_constant_is_infinite_and_without_primal_vectors_zero() -> None:
    assert cone_interval(np.zeros((3, 0)), np.zeros((0, 0)), np.inf)[:2] == (np.inf, np.inf)
    assert cone_interval(np.zeros((0, 2)), np.eye(2), 0.0)[:2] == (0.0, 0.0)


def test_a_lower_bound_above_the_upper_one_is_not_hidden() -> None:
    """Nothing but a bug leads to it, and the invariants of a run are to show it."""
    lower, upper, _ = cone_interval(np.eye(2), np.eye(2), span=2.0)
    assert (lower, upper) == (2.0, 1.0)


@given(seeds)
def test_the_simplex_minimiser_beats_every_other_point(seed: int) -> None:
    C, _ = random_pair(seed, 4, 5, 0.5)
    alpha = simplex_minimiser(1e-3 * C)
    assert np.isclose(alpha.sum(), 1.0)
    assert np.all(alpha >= 0.0)
    others = np.random.default_rng(seed).dirichlet(np.ones(5), 200)
    assert np.linalg.norm(C @ alpha) <= np.linalg.norm(C @ others.T, axis=0).min() + 1e-9
