import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerics import space

from vibench.model.certificates import residual
from vibench.model.certificates.residual import ColumnBlock, ResidualBasis, residual_basis

X = space(40, 5)
rng = np.random.default_rng(1)
DECAY = np.exp(-0.25 * np.arange(60))
BLOCKS = [rng.standard_normal((40, 50)), rng.standard_normal((40, 10)), np.zeros((40, 2))]


def block_of(values: np.ndarray) -> ColumnBlock:
    """Columns that are what they stand for."""
    return ColumnBlock(values, np.zeros(values.shape[1]), len(values))


WHITENED = [block_of(X.whiten_functional(block)) for block in BLOCKS]
SAMPLES = np.append(DECAY, [1.0, 0.0])[:, None] * rng.standard_normal((62, 30))


def norm(basis: ResidualBasis, z: np.ndarray) -> float:
    coordinates, beside, missing = basis.parts(z)
    return float(np.hypot(np.linalg.norm(coordinates), beside)) * (1.0 + basis.distortion) + missing


def exact(z: np.ndarray) -> float:
    return float(np.linalg.norm(X.whiten_functional(np.hstack(BLOCKS) @ z)))


@given(st.integers(0, 10_000), st.sampled_from([0.0, 1.0, 30.0]))
def test_norms_are_never_below_the_exact_ones(seed: int, unseen: float) -> None:
    """Whatever the coefficients are: those of terms that no sample has, and others much larger than in the samples."""
    own = np.random.default_rng(seed)
    z = SAMPLES[:, own.integers(30)] * own.standard_normal(62)
    z += unseen * own.standard_normal(62) * (own.random(62) < 0.3)
    for basis in (WHOLE, TRUNCATED):
        assert norm(basis, z) >= exact(z) * (1.0 - 1e-12)


def test_norms_are_sharp_where_samples_are_typical() -> None:
    for z in SAMPLES.T:
        assert norm(TRUNCATED, z) == pytest.approx(exact(z), rel=0.5)
    typical = np.median([norm(TRUNCATED, z) / exact(z) for z in SAMPLES.T])
    assert typical <= 1.05


def test_small_residuals_of_large_terms_keep_their_digits() -> None:
    """Two terms that cancel to 1e-9: the square root of a sum of products would see 1e-8 of noise."""
    term = rng.standard_normal((40, 1))
    blocks = [term, term * (1.0 + 1e-9)]
    basis, _ = residual_basis([block_of(X.whiten_functional(block)) for block in blocks], np.ones((2, 3)), 0.0)
    difference = np.array([1.0, -1.0])
    assert norm(basis, difference) == pytest.approx(1e-9 * float(np.linalg.norm(X.whiten_functional(term))), rel=1e-5)

    # what is left out is small beside what else enters the bound
    loose, _ = residual_basis(WHITENED, SAMPLES, 100.0)
    assert len(loose.kept) < len(TRUNCATED.kept) <= 60


def test_few_directions_are_enough_for_many_terms() -> None:
    """More than 1,000 terms, of which a randomised method finds the directions."""
    terms = X.whiten_functional(rng.standard_normal((40, 40)) * 0.5 ** np.arange(40) @ rng.standard_normal((40, 1100)))
    samples = rng.standard_normal((1100, 30))
    found, U = residual_basis([block_of(terms)], samples, 1.0)
    assert len(found.factor) < 40 < len(found.kept)
    assert found.remainder > 0.0
    np.testing.assert_allclose(U.T @ U, np.eye(U.shape[1]), atol=1e-12)
    # The last one is what the directions leave out most of, which no sample is.
    scale = np.abs(samples).max(axis=1)
    left_out = scale * np.linalg.svd((terms - U @ (U.T @ terms)) * scale, full_matrices=False)[2][0]
    for z in [*samples.T, left_out]:
        assert np.linalg.norm(terms @ z) * (1.0 - 1e-12) <= norm(found, z)


def test_a_random_range_leaves_what_it_says() -> None:
    S = np.linalg.qr(rng.standard_normal((50, 50)))[0] * 0.5 ** np.arange(50) @ rng.standard_normal((50, 80))
    found = residual._random_range(S, np.ones(S.shape[1]), 1e-3, limit=900, block=6)
    Q, small, rest = found
    np.testing.assert_allclose(Q.T @ Q, np.eye(Q.shape[1]), atol=1e-12)
    assert np.linalg.norm(S - Q @ small) == pytest.approx(rest, rel=1e-6)
    assert rest <= 0.5e-3
    assert Q.shape[1] < 40
    assert residual._random_range(S, np.ones(S.shape[1]), 1e-3, limit=12, block=6) is None


def test_rows_that_few_terms_enter_are_made_fewer() -> None:
    """Norms are the same as from all rows, and directions those of the functionals on the last ones."""
    last, few = 7, np.zeros((40, 12))
    few[:33, :4] = rng.standard_normal((33, 4))
    few[33:] = rng.standard_normal((7, 12))
    samples = rng.standard_normal((12, 20))
    whole, U = residual_basis([block_of(few)], samples, 0.0)
    reduced, tail = residual_basis([block_of(few)], samples, 0.0, last)
    assert tail.shape[0] == last
    functional = rng.standard_normal(last)
    for z in rng.standard_normal((5, 12)):
        exact = float(np.linalg.norm(few @ z))
        assert norm(reduced, z) == pytest.approx(exact, rel=1e-10)
        products = [(functional @ rows) @ basis.parts(z)[0] for basis, rows in ((whole, U[33:]), (reduced, tail))]
        assert products == pytest.approx([functional @ few[33:] @ z] * 2)


WHOLE, _ = residual_basis(WHITENED, np.ones((62, 1)), 0.0)
TRUNCATED, _ = residual_basis(WHITENED, SAMPLES, 0.0)
