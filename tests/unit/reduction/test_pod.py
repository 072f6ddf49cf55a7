import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numerics import space

from vibench.errors import NumericalError
from vibench.interfaces.strategies import Stop
from vibench.reduction.pod import pod

seeds = st.integers(0, 10_000)


def tail(snapshots: np.ndarray, basis: np.ndarray, X) -> float:
    """Relative projection error of the definition (11)."""
    rest = snapshots - basis @ X.gram(basis, snapshots)
    return float(np.sqrt((X.norm(rest) ** 2).sum() / (X.norm(snapshots) ** 2).sum()))


@given(seeds)
def test_errors_are_the_tails_of_the_nested_bases_and_no_other_basis_does_better(seed: int) -> None:
    X, rng = space(12, seed), np.random.default_rng(seed)
    snapshots = rng.standard_normal((12, 6)) * 10.0 ** -np.arange(6.0)
    found = pod(snapshots, X, Stop(size=6))
    assert np.allclose(X.gram(found.basis, found.basis), np.eye(6), atol=1e-12)
    for k in range(7):
        assert np.isclose(tail(snapshots, found.basis[:, :k], X), found.errors[k], rtol=1e-6, atol=1e-12)
    snapshots = rng.standard_normal((12, 5))
    other = X.orthonormalise(snapshots @ rng.standard_normal((5, 2)))
    assert tail(snapshots, pod(snapshots, X, Stop(size=2)).basis, X) <= tail(snapshots, other, X) + 1e-12
    # the same basis whatever the signs of the snapshots
    one, two = (pod(sign * snapshots, X, Stop(size=3)).basis for sign in (1.0, -1.0))
    assert np.allclose(one, two, atol=1e-12)


@given(seeds, st.integers(1, 6), st.integers(0, 3), st.floats(1e-14, 1e-6))
def test_copies_and_near_copies_add_nothing(seed: int, count: int, copies: int, near: float) -> None:
    X = space(10, seed)
    rng = np.random.default_rng(seed)
    single = rng.standard_normal((10, count))
    repeated = single[:, rng.integers(count, size=copies)] * (1.0 + near * rng.standard_normal((10, copies)))
    found = pod(np.hstack([single, repeated]), X, Stop(tolerance=1e-4)).basis
    assert found.shape[1] <= count
    assert np.allclose(X.gram(found, found), np.eye(found.shape[1]), atol=1e-12)
    if count == 1:
        assert np.isclose(abs(X.gram(found, single)[0, 0]), X.norm(single)[0], rtol=1e-6)


def test_the_smallest_size_of_a_tolerance_is_taken_and_none_above_the_rank() -> None:
    X = space(8)
    q = X.orthonormalise(np.random.default_rng(0).standard_normal((8, 4)))
    for tolerance, size in ((0.5, 1), (1e-3, 2), (1e-5, 3), (1e-7, 4)):
        assert pod(q * np.array([1.0, 1e-2, 1e-4, 1e-6]), X, Stop(tolerance=tolerance)).basis.shape[1] == size
    errors = pod(q[:, :3] * np.array([1.0, 1e-5, 1e-10]), X, Stop(size=3)).errors
    assert np.isclose(errors[2], 1e-10, rtol=1e-4)  # eigenvalues of the Gram matrix would floor at 1e-8
    X = space(6)
    snapshots = np.outer(np.arange(1.0, 7.0), [1.0, 2.0, 3.0])
    assert pod(snapshots, X, Stop(tolerance=1e-9)).basis.shape[1] == 1
    with pytest.raises(NumericalError, match=r"size 2: the 3 snapshots have rank 1"):
        pod(snapshots, X, Stop(size=2))
    for nothing in (np.zeros((6, 0)), np.zeros((6, 3))):
        assert pod(nothing, X, Stop(tolerance=0.1)).basis.shape == (6, 0)
