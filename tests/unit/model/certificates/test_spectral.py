from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import space, spd

from vibench import InnerProduct, create
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.model.certificates import spectral
from vibench.model.certificates.spectral import anchors, leading_terms, rotated, spectral_bounds
from vibench.stability.coercivity import Constant, operator_norm

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
BOUNDS = spectral_bounds(Curved(), X, ROTATED, lambda mu: T @ theta(mu), 0.0)


def extremes(mu: np.ndarray) -> tuple[float, float]:
    values = scipy.linalg.eigvalsh(Curved().assemble(mu).A.toarray(), X.matrix.toarray())
    return float(values[0]), float(values[-1])


@given(st.floats(0.2, 2.3), st.floats(-1.3, 1.3))
@settings(max_examples=50)
def test_the_spectrum_is_between_the_bounds_also_outside_the_box(a: float, b: float) -> None:
    mu = np.array([a, b])
    low, high = BOUNDS.evaluate(mu, T @ theta(mu))
    smallest, largest = extremes(mu)
    assert low <= smallest
    assert high >= largest


def test_bounds_are_sharp_between_anchors() -> None:
    for mu in Curved.parameters.sample(20, 1):
        low, high = BOUNDS.evaluate(mu, T @ theta(mu))
        smallest, largest = extremes(mu)
        assert low >= 0.8 * smallest
        assert high <= 1.2 * largest
    assert BOUNDS.proved


def test_errors_of_the_terms_widen_the_bounds() -> None:
    mu = np.array([1.1, 0.3])
    narrow = BOUNDS.evaluate(mu, T @ theta(mu))
    wide = spectral_bounds(Curved(), X, ROTATED, lambda mu: T @ theta(mu), 0.01).evaluate(mu, T @ theta(mu))
    assert wide == pytest.approx((narrow[0] - 0.02, narrow[1] + 0.02))


def test_rotated_terms_have_the_same_sum() -> None:
    mu = np.array([1.7, -0.4])
    found = sum(t * term for t, term in zip(T @ theta(mu), ROTATED, strict=True))
    np.testing.assert_allclose(found.toarray(), Curved().assemble(mu).A.toarray(), rtol=1e-12)
    inner = [[float((one * other).sum()) for one in ROTATED] for other in ROTATED]
    np.testing.assert_allclose(inner, np.eye(Q), atol=1e-12)


@pytest.mark.parametrize(("dim", "count"), [(1, 9), (2, 9), (3, 4), (4, 3), (6, 2), (9, 1)])
def test_anchors_are_as_many_as_may_be(dim: int, count: int) -> None:
    box = ParameterBox(tuple("abcdefghi"[:dim]), np.zeros(dim), np.ones(dim), ("1",) * dim)
    points, found = anchors(box)
    assert found == count
    assert len(points) == count**dim <= 81


def test_the_norm_of_an_operator_is_not_below_its_largest_eigenvalue_in_modulus() -> None:
    M = rng.standard_normal((N, N))
    for matrix in (M + M.T, -(M @ M.T)):
        found = operator_norm(sp.csc_array(matrix), X)
        exact = float(np.abs(scipy.linalg.eigvalsh(matrix, X.matrix.toarray())).max())
        assert found.proved
        assert exact <= found.value <= 1.01 * exact
    assert operator_norm(sp.csc_array((N, N)), X).value == 0.0


def test_anchors_at_which_a_is_the_same_share_their_constants(monkeypatch: pytest.MonkeyPatch) -> None:
    """A of `hertz3d` depends on one of four parameters."""
    problem, calls = create("problem", "hertz3d", {"resolution": 1000}), []

    def counted(A: sp.csr_array, X: InnerProduct) -> tuple[Constant, Constant]:
        calls.append(A)
        return Constant(0.5, True), Constant(2.0, True)

    monkeypatch.setattr(spectral, "coercivity_and_continuity", counted)
    A = problem.affine["A"]
    bounds = spectral.spectral_bounds(problem, problem.V, list(A.terms), A.coefficients, 0.0)
    assert len(bounds.alpha) == bounds.count**4
    assert len(calls) == bounds.count


def test_terms_that_are_left_out_are_bounded_by_what_they_are() -> None:
    """The last of three terms, with its largest norm in the place of an error that was measured."""
    points = Curved.parameters.sample(50, 2)
    last = [abs((T @ theta(mu))[2]) * operator_norm(ROTATED[2], X).value for mu in points]
    found = spectral_bounds(Curved(), X, ROTATED[:2], lambda mu: T @ theta(mu), 1.5 * max(last))
    assert found.norms[2] == 0.0
    assert np.array_equal(found.norms[:2], BOUNDS.norms[:2])
    for mu in points:
        low, high = found.evaluate(mu, T @ theta(mu))
        smallest, largest = extremes(mu)
        assert low <= smallest
        assert high >= largest


def test_leading_terms_have_all_but_a_share_of_the_variation() -> None:
    samples = np.array([[9.0, 10.0, 11.0], [0.5, -0.5, 0.0], [0.9, 0.5, -0.9], [0.2, 0.3, 0.1], [0.0, 0.4, 0.0]])
    small = 0.2e-4
    assert leading_terms(samples) == 5
    assert leading_terms(np.vstack([samples, small * samples])) == 5 + 1  # one more varies by more
    assert leading_terms(np.vstack([samples, 0.1 * small * samples[1:]])) == 5
