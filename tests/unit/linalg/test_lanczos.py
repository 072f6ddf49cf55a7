import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from numerics import spd

from vibench.linalg.lanczos import Lanczos


def pencil(n: int, spectrum: np.ndarray) -> tuple[np.ndarray, sp.csc_array]:
    """K and M (n×n) with these eigenvalues of K against M."""
    rng = np.random.default_rng(n)
    root = scipy.linalg.cholesky(spd(n, rng))
    turned = np.linalg.qr(rng.standard_normal((n, n)))[0] @ root
    return turned.T @ (spectrum[:, None] * turned), sp.csc_array(root.T @ root)


def estimate(K: np.ndarray, M: sp.csc_array, accuracy: float) -> float:
    factor = scipy.linalg.cho_factor(M.toarray())
    return Lanczos(lambda v: scipy.linalg.cho_solve(factor, K @ v), M).largest(accuracy)


@pytest.mark.parametrize("accuracy", [1e-3, 1e-6, 1e-10])
@pytest.mark.parametrize("scale", [1.0, 1e100, 1e-100])
def test_the_eigenvalue_of_largest_magnitude_is_as_accurate_as_asked(accuracy: float, scale: float) -> None:
    n = 60
    multiple = np.concatenate([np.full(3, 5.0), np.linspace(0.1, 4.9, n - 3)])
    dominant = np.append(1.0, np.full(n - 1, 1e-9))
    continuous = np.linspace(0.5, 1.0, n)  # the largest one is at its edge
    for spectrum in (np.linspace(-1.0, 3.0, n), np.linspace(-3.0, 1.0, n), continuous, multiple, dominant):
        found, exact = estimate(*pencil(n, scale * spectrum), accuracy), scale * np.abs(spectrum).max()
        assert (1.0 - 10.0 * accuracy) * exact <= found <= (1.0 + 1e-12) * exact


def test_small_matrices_are_exact_and_what_is_not_definite_has_no_estimate() -> None:
    for n in (1, 2, 3, 7):
        assert estimate(*pencil(n, np.arange(1.0, n + 1.0)), 1e-15) == pytest.approx(n, rel=1e-11)
    M, indefinite = sp.eye_array(40, format="csc"), sp.diags_array(np.append(np.full(39, 1e-3), -1.0), format="csc")
    assert Lanczos(lambda v: v, indefinite).largest(1e-4) == np.inf
    assert Lanczos(lambda v: np.nan * v, M).largest(1e-4) == np.inf
    assert Lanczos(np.zeros_like, M).largest(1e-4) == 0.0
    M = sp.eye_array(400, format="csc")
    for spectrum in (np.geomspace(1e-6, 1.0, 400), np.linspace(-0.5, 1.0, 400), np.full(400, np.nan), np.zeros(400)):
        assert Lanczos(lambda v, spectrum=spectrum: spectrum * v, M).smallest(1e-3) is None
    restarted = Lanczos(lambda v: np.linspace(0.0, 1.0, 400) ** 0.1 * v, M)
    assert restarted.largest(1e-12) == pytest.approx(1.0, rel=1e-11)
    assert restarted.smallest(1e-3) is None


class Counting:
    """Products with a diagonal matrix, which are counted."""

    def __init__(self, spectrum: np.ndarray) -> None:
        self.spectrum, self.M, self.counts = spectrum, sp.eye_array(len(spectrum), format="csc"), list[int]()

    def run(self) -> Lanczos:
        self.counts.append(0)
        return Lanczos(self, self.M)

    def __call__(self, v: np.ndarray) -> np.ndarray:
        self.counts[-1] += 1
        return self.spectrum * v


def test_iterations_end_with_the_accuracy_of_the_eigenvalue() -> None:
    """The residual is still about 0.01 where the eigenvalue has an error of 1e-4."""
    counting = Counting(np.concatenate([[1.0], np.linspace(0.0, 0.8, 399)]))
    for accuracy in (1e-4, 1e-8):
        assert 1.0 - 10.0 * accuracy <= counting.run().largest(accuracy) <= 1.0 + 1e-12
    assert counting.counts[0] < 0.7 * counting.counts[1]


@pytest.mark.parametrize("scale", [1.0, 1e100, 1e-100])
def test_iterations_go_on_to_more_accuracy_and_to_the_other_end(scale: float) -> None:
    """What follows another estimate takes less than it would alone."""
    counting = Counting(scale * np.concatenate([[0.5], np.linspace(0.6, 1.7, 198), [2.0]]))
    both = counting.run()
    for end, accuracy, exact in (("smallest", 1e-3, 0.5), ("largest", 1e-3, 2.0), ("largest", 1e-8, 2.0)):
        assert getattr(both, end)(accuracy) == pytest.approx(exact * scale, rel=10.0 * accuracy)
    for end, accuracy in (("smallest", 1e-3), ("largest", 1e-8)):
        getattr(counting.run(), end)(accuracy)
    assert counting.counts[0] == max(counting.counts[1:])
