from functools import cache
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import space, spd

from vibench import InnerProduct, ParameterBox, Problem, VariationalInequality
from vibench.model.certificates.spectral import AnchorGrid, TermRanges, leading_terms, rotated, spectral_bounds
from vibench.stability.coercivity import operator_norm

N, Q = 6, 3
rng = np.random.default_rng(7)
TERMS = [sp.csr_array(spd(N, rng, 10.0)) for _ in range(Q)]
X = space(N, 3)


def theta(mu: np.ndarray) -> np.ndarray:
    """Coefficients that are not multilinear."""
    return np.array([1.0, mu[0] ** 2 + 0.1, np.exp(mu[1])])


class Curved(Problem):
    """A(mu) = Σ θ_q A_q; nothing else of it is used."""

    parameters = ParameterBox(("a", "b"), np.array([0.5, -1.0]), np.array([2.0, 1.0]), ("1", "1"))

    V, W = X, space(1, 1)

    def training_set(self) -> np.ndarray:
        return self.parameters.grid(3, 3)

    def assemble(self, mu: np.ndarray) -> VariationalInequality:
        A = sp.csc_array(sum(t * term for t, term in zip(theta(mu), TERMS, strict=True)))
        return VariationalInequality(A, np.ones(N), sp.csr_array(np.eye(1, N)), np.ones(1))


T, ROTATED = rotated(tuple(TERMS), np.column_stack([theta(mu) for mu in Curved().training_set()]))


@cache
def bounds(errors: float = 0.0) -> Any:
    return spectral_bounds(Curved(), X, ROTATED, lambda mu: T @ theta(mu), lambda _: errors)


def extremes(mu: np.ndarray) -> tuple[float, float]:
    values = scipy.linalg.eigvalsh(Curved().assemble(mu).A.toarray(), X.matrix.toarray())
    return float(values[0]), float(values[-1])


@given(st.floats(0.2, 2.3), st.floats(-1.3, 1.3))
def test_the_spectrum_is_between_the_bounds_also_outside_the_box(a: float, b: float) -> None:
    mu = np.array([a, b])
    (low, high), (smallest, largest) = bounds().evaluate(mu, T @ theta(mu)), extremes(mu)
    assert low <= smallest <= largest <= high


def test_bounds_are_sharp_between_anchors() -> None:
    for mu in Curved.parameters.sample(20, 1):
        (low, high), (smallest, largest) = bounds().evaluate(mu, T @ theta(mu)), extremes(mu)
        assert low >= 0.8 * smallest
        assert high <= 1.2 * largest
    assert bounds().proved
    # errors of the terms widen the bounds
    mu = np.array([1.1, 0.3])
    narrow, wide = (bounds(errors).evaluate(mu, T @ theta(mu)) for errors in (0.0, 0.01))
    assert wide == pytest.approx((narrow[0] - 0.02, narrow[1] + 0.02))


def test_rotated_terms_have_the_same_sum() -> None:
    mu = np.array([1.7, -0.4])
    found = sum(t * term for t, term in zip(T @ theta(mu), ROTATED, strict=True))
    np.testing.assert_allclose(found.toarray(), Curved().assemble(mu).A.toarray(), rtol=1e-12)
    inner = [[float((one * other).sum()) for one in ROTATED] for other in ROTATED]
    np.testing.assert_allclose(inner, np.eye(Q), atol=1e-12)


def box(dim: int) -> ParameterBox:
    return ParameterBox(tuple("abcdefghi"[:dim]), np.full(dim, 0.5), np.full(dim, 2.0), ("1",) * dim)


@pytest.mark.parametrize("dim", [1, 2, 3, 4, 6, 9])
def test_anchors_cover_the_parameters_of_a_alone(dim: int) -> None:
    """Of nine parameters some move A, along a curve; there are at most 81 anchors, and one where these are too few."""
    grid = AnchorGrid.of(box(9), lambda mu: np.append(mu[9 - dim :] ** 4, 1.0), np.ones(dim + 1))
    points = grid.points(box(9))
    assert len(points) == np.prod(grid.counts) <= 81
    assert np.array_equal(grid.axes, np.arange(9 - dim, 9) if dim < 9 else [])
    assert np.all(points[:, : 9 - dim] == 1.25)
    for point in points[:: max(1, len(points) // 9)]:
        where, weights = grid.weights(point)
        assert sum(weights) == pytest.approx(1.0)
        assert points[np.array(where)[np.array(weights) > 1e-6]] == pytest.approx(point[None])


def test_a_straight_path_has_four_anchors_and_a_curve_the_others() -> None:
    """1/b² moves A along a line however fast, so that interpolation between its anchors leaves nothing."""
    of = lambda mu: np.outer([1.0, mu[0], mu[0] ** 3], [1.0, mu[1] ** -2]).ravel()  # noqa: E731
    grid = AnchorGrid.of(box(2), of, np.ones(6))
    points = grid.points(box(2))
    assert grid.counts[1] == 4 < grid.counts[0]
    for mu in np.column_stack([np.repeat(points[::4, 0], 3), np.tile([0.523, 1.1, 1.9], len(points) // 4)]):
        where, weights = grid.weights(mu)
        assert weights @ np.array([of(point) for point in points[where]]) == pytest.approx(of(mu), rel=2e-4)


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(0, 3))
@settings(max_examples=10, deadline=None)
def test_ranges_of_terms_bound_any_sum(seed: int, definite: int, others: int) -> None:
    """Semidefinite terms of low rank, and indefinite ones, with coefficients of any sign."""
    rng = np.random.default_rng(seed)
    factors = [rng.standard_normal((N, int(rank))) for rank in rng.integers(1, N + 1, definite)]
    random = rng.standard_normal((others, N, N))
    terms = [*(F @ F.T for F in factors), *(M + M.T for M in random), spd(N, rng, 10.0)]
    reference = rng.uniform(0.5, 2.0, len(terms)) * rng.choice([-1.0, 1.0], len(terms))
    reference[-1] = 1.0 + sum(abs(t) * np.linalg.norm(term, 2) for t, term in zip(reference, terms, strict=True))
    X = InnerProduct(sp.csc_array(sum(theta * term for theta, term in zip(reference, terms, strict=True))))
    ranges = TermRanges.of([sp.csr_array(term) for term in terms], reference, X, 0.0)
    for _ in range(20):
        theta = reference * rng.uniform(-0.2, 3.0, len(terms))
        low, high = ranges.evaluate(theta)
        matrix = sum(t * term for t, term in zip(theta, terms, strict=True))
        values = scipy.linalg.eigvalsh(matrix, X.matrix.toarray())
        assert low <= values[0]
        assert values[-1] <= high


def test_of_patches_alpha_is_the_smallest_quotient_of_coefficients() -> None:
    """The bound min θ_q(µ)/θ_q(µ̄) of semidefinite terms: it is attained where each acts alone."""
    patches = [sp.csr_array(np.diag([float(k == q) for k in range(9)])) for q in range(9)]
    ranges = TermRanges.of(patches, np.full(9, 0.5), InnerProduct(sp.csc_array(0.5 * np.eye(9))), 0.0)
    theta = np.random.default_rng(0).uniform(0.1, 1.0, 9)
    low, high = ranges.evaluate(theta)
    assert theta.min() / 0.5 * (1.0 - 1e-6) <= low <= theta.min() / 0.5 <= theta.max() / 0.5 <= high
    assert high <= theta.max() / 0.5 * (1.0 + 2e-3)
    assert TermRanges.of(patches, np.array([0.0] * 9), X, 0.0) is None


def test_the_norm_of_an_operator_is_not_below_its_largest_eigenvalue_in_modulus() -> None:
    M = rng.standard_normal((N, N))
    for matrix in (M + M.T, -(M @ M.T)):
        found = operator_norm(sp.csc_array(matrix), X)
        exact = float(np.abs(scipy.linalg.eigvalsh(matrix, X.matrix.toarray())).max())
        assert found.proved
        assert exact <= found.value <= 1.01 * exact
    assert operator_norm(sp.csc_array((N, N)), X).value == 0.0
    # the last of three terms is left out, its largest norm takes the place of an error that was measured
    points = Curved.parameters.sample(50, 2)
    last = [abs((T @ theta(mu))[2]) * operator_norm(ROTATED[2], X).value for mu in points]
    found = spectral_bounds(Curved(), X, ROTATED[:2], lambda mu: T @ theta(mu), lambda _: 1.5 * max(last))
    assert found.turn.shape == (2, 3)
    assert not found.turn[:, 2].any()
    for mu in points:
        (low, high), (smallest, largest) = found.evaluate(mu, T @ theta(mu)), extremes(mu)
        assert low <= smallest <= largest <= high


def test_leading_terms_have_all_but_a_share_of_the_variation() -> None:
    samples = np.array([[9.0, 10.0, 11.0], [0.5, -0.5, 0.0], [0.9, 0.5, -0.9], [0.2, 0.3, 0.1], [0.0, 0.4, 0.0]])
    small = 0.2e-4
    assert leading_terms(samples) == 5
    assert leading_terms(np.vstack([samples, small * samples])) == 5 + 1  # one more varies by more
    assert leading_terms(np.vstack([samples, 0.1 * small * samples[1:]])) == 5
