from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerics import space

from vibench.model.certificates import residual
from vibench.model.certificates.residual import residual_basis

X = space(40, 5)
rng = np.random.default_rng(1)
DECAY = np.exp(-0.25 * np.arange(60))
BLOCKS = [rng.standard_normal((40, 50)), rng.standard_normal((40, 10)), np.zeros((40, 2))]
WHITENED = [X.whiten_functional(block) for block in BLOCKS]
SAMPLES = np.append(DECAY, [1.0, 0.0])[:, None] * rng.standard_normal((62, 30))


def exact(z: np.ndarray) -> float:
    return float(np.linalg.norm(X.whiten_functional(np.hstack(BLOCKS) @ z)))


@given(st.integers(0, 10_000), st.sampled_from([0.0, 1.0, 30.0]))
def test_norms_are_never_below_the_exact_ones(seed: int, unseen: float) -> None:
    """Whatever the coefficients are: those of terms that no sample has, and others much larger than in the samples."""
    own = np.random.default_rng(seed)
    z = SAMPLES[:, own.integers(30)] * own.standard_normal(62) + unseen * own.standard_normal(62) * (
        own.random(62) < 0.3
    )
    for basis in (WHOLE, TRUNCATED):
        assert basis.norm(z) >= exact(z) * (1.0 - 1e-12)


def test_norms_are_sharp_where_samples_are_typical() -> None:
    for z in SAMPLES.T:
        assert TRUNCATED.norm(z) == pytest.approx(exact(z), rel=0.5)
    typical = np.median([TRUNCATED.norm(z) / exact(z) for z in SAMPLES.T])
    assert typical <= 1.05


def test_small_residuals_of_large_terms_keep_their_digits() -> None:
    """Two terms that cancel to 1e-9: the square root of a sum of products would see 1e-8 of noise."""
    term = rng.standard_normal((40, 1))
    blocks = [term, term * (1.0 + 1e-9)]
    basis, _ = residual_basis([X.whiten_functional(block) for block in blocks], np.ones((2, 3)), 0.0)
    difference = np.array([1.0, -1.0])
    assert basis.norm(difference) == pytest.approx(1e-9 * float(np.linalg.norm(X.whiten_functional(term))), rel=1e-5)


def test_what_is_left_out_is_small_beside_what_else_enters_the_bound() -> None:
    loose, _ = residual_basis(WHITENED, SAMPLES, 100.0)
    assert len(loose.kept) < len(TRUNCATED.kept) <= 60


def test_few_directions_are_enough_for_many_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(residual, "FEW", 5)
    found, U = residual_basis(WHITENED, SAMPLES, 1.0)
    assert len(found.factor) < len(found.kept)
    assert found.remainder > 0.0
    np.testing.assert_allclose(U.T @ U, np.eye(U.shape[1]), atol=1e-12)
    for z in SAMPLES.T:
        assert exact(z) * (1.0 - 1e-12) <= found.norm(z)


WHOLE, _ = residual_basis(WHITENED, np.ones((62, 1)), 0.0)
TRUNCATED, _ = residual_basis(WHITENED, SAMPLES, 0.0)
