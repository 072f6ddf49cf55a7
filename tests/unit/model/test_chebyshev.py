"""Polynomials on a box: exact where the arrays are polynomials, and honest about their error where they are not."""

import numpy as np
import pytest

from vibench.model import chebyshev
from vibench.model.chebyshev import interpolate_on_box

LOWER, UPPER = np.array([0.5, -2.0]), np.array([1.5, 3.0])
UNIT = np.random.default_rng(1).random((50, 2))
POINTS = LOWER + UNIT * (UPPER - LOWER)
MANY = np.linspace(0.5, 1.0, 150)
"""More entries than polynomials of the tests have coefficients."""


def test_polynomials_are_found_with_their_degrees_and_terms() -> None:
    first, second = np.random.default_rng(0).standard_normal((2, 7))

    def evaluate(mu: np.ndarray) -> dict[str, np.ndarray]:
        x, y = mu
        return {"p": (1.0 + x**3) * first + x * y**2 * second, "constant": 3.0 * second, "zero": np.zeros(4)}

    found = interpolate_on_box(evaluate, LOWER, UPPER, 1e-12, 1000)
    assert {name: (p.degrees, len(p.terms)) for name, p in found.items()} == {
        "p": ((3, 2), 2), "constant": ((0, 0), 1), "zero": ((0, 0), 1),
    }  # fmt: skip
    assert len(found["p"].indices) < 12  # products that do not occur are left out
    for name, p in found.items():
        expected = np.array([evaluate(mu)[name] for mu in POINTS])
        assert np.abs(p.evaluate(UNIT) - expected).max() <= 1e-12 * np.abs(first).max() * 30.0
        assert p.error <= 1e-12


def test_degrees_follow_the_decay_in_every_direction() -> None:
    def evaluate(mu: np.ndarray) -> dict[str, np.ndarray]:
        return {"a": np.array([np.exp(mu[0]) / (1.0 + mu[1] ** 2), mu[0]])}

    found, again = (interpolate_on_box(evaluate, LOWER, UPPER, 1e-9, 4000)["a"] for _ in range(2))
    assert np.array_equal(found.coefficients, again.coefficients)
    assert again.error == found.error <= 1e-9
    assert found.degrees[0] < 12 < found.degrees[1]  # the poles ±i are near
    expected = np.array([[np.exp(x) / (1.0 + y**2), x] for x, y in POINTS])
    assert np.linalg.norm(found.evaluate(UNIT) - expected, axis=1).max() <= 2e-9 * np.exp(1.5)


@pytest.mark.parametrize("dimension", [1, 2])
def test_what_is_not_smooth_misses_the_tolerance(dimension: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """And says by how much; arrays that are not accurate enough are not factorised."""
    monkeypatch.setattr(chebyshev, "svd", None)
    lower, upper, budget = LOWER[:dimension], UPPER[:dimension], 100
    evaluated: list[np.ndarray] = []

    def kink(mu: np.ndarray) -> dict[str, np.ndarray]:
        evaluated.append(mu)
        return {"a": np.array([abs(mu[0] - 1.03)]), "b": np.array([1.0 + mu[-1]]), "c": abs(mu[0] - 1.03) * MANY}

    found = interpolate_on_box(kink, lower, upper, 1e-9, budget)
    assert found["b"].error <= 1e-12
    unit = np.random.default_rng(2).random((400, dimension))
    expected = np.abs(lower[0] + unit[:, 0] * (upper[0] - lower[0]) - 1.03)
    true = np.abs(found["a"].evaluate(unit)[:, 0] - expected).max() / expected.max()
    assert 0.2 * true <= found["a"].error <= 5.0 * true
    assert found["a"].error > 1e-4
    assert np.allclose(found["c"].evaluate(unit), np.outer(found["a"].evaluate(unit)[:, 0], MANY), atol=1e-9)
    assert np.prod(np.array(found["a"].degrees) + 1) <= budget
    assert len(evaluated) <= 12 * budget


def test_coefficients_that_no_value_needs_are_zero() -> None:
    """Two entries of different size, each a function of one parameter, disturbed by round-off."""
    decay, noise = 0.5 ** np.arange(30), np.random.default_rng(3)
    decay[0] = 0.0

    def evaluate(mu: np.ndarray) -> dict[str, np.ndarray]:
        x, y = np.polynomial.chebyshev.chebval((2.0 * mu - LOWER - UPPER) / (UPPER - LOWER), decay)
        return {"a": np.array([x, 1e-3 * y]) + 1e-15 * noise.standard_normal(2)}

    found = interpolate_on_box(evaluate, LOWER, UPPER, 1e-11, 2000)["a"]
    assert found.error <= 1e-11
    assert found.coefficients.shape[1] == 2
    needed = found.coefficients != 0.0
    assert needed.sum(axis=1).max() == 1  # no product serves both
    for k, parameter in enumerate(needed[:, np.argsort(-np.abs(found.coefficients).max(axis=0))].T):
        assert np.all(found.indices[parameter, 1 - k] == 0)
    dropped = interpolate_on_box(evaluate, LOWER, UPPER, 1e-5, 2000)["a"]
    assert np.count_nonzero(dropped.coefficients) < np.count_nonzero(found.coefficients)
    assert dropped.error <= 1e-5


def test_given_terms_are_kept_and_their_coefficients_interpolated() -> None:
    """The second coefficient is large and its term small, the last term vanishes; a grid of all is too large."""
    terms = np.vstack([np.random.default_rng(0).standard_normal((2, 6)) * [[1.0], [1e-8]], np.zeros((1, 6))])

    def evaluate(mu: np.ndarray) -> dict[str, np.ndarray]:
        x, y = mu
        of_terms = np.array([1.0 + x * y, 1e8 * np.exp(x), abs(y - 0.3)])
        return {"a": of_terms, "b": np.array([x]), "c": 1.0 / (1.0 + y**2 * MANY)}

    found = interpolate_on_box(evaluate, LOWER, UPPER, 1e-11, 400, terms={"a": terms})
    assert np.array_equal(found["a"].terms, terms)
    expected = np.array([evaluate(mu)["a"] @ terms for mu in POINTS])
    assert np.abs(found["a"].evaluate(UNIT) - expected).max() <= 1e-11 * np.linalg.norm(expected, axis=1).max()
    assert found["a"].error <= 1e-11
    assert (found["b"].degrees, found["c"].degrees[0], found["c"].error <= 1e-11) == ((1, 0), 0, True)
