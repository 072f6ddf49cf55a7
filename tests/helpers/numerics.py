"""Test data shared by the numerical tests: random spaces and a small problem whose constraints vary."""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from vibench import Array, InnerProduct, ParameterBox, Problem, VariationalInequality
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.model.errors import EnergyNorm


def spd(n: int, rng: np.random.Generator, spread: float = 10.0) -> Array:
    """A dense symmetric positive definite matrix with eigenvalues in [1, spread]."""
    q, _ = np.linalg.qr(rng.standard_normal((n, n)))
    return (q * np.linspace(1.0, spread, n)) @ q.T


def space(n: int, seed: int = 0) -> InnerProduct:
    return InnerProduct(sp.csc_array(spd(n, np.random.default_rng(seed))))


class Varying(Problem):
    """A string over an obstacle whose constraints rotate with the parameter, so that B(mu) truly varies."""

    parameters = ParameterBox(("angle",), np.array([0.0]), np.array([1.0]), ("1",))

    def __init__(self, n: int = 30, m: int = 8, count: int = 7) -> None:
        self.count = count
        laplacian = sp.diags_array([2.0 * np.ones(n), -np.ones(n - 1), -np.ones(n - 1)], offsets=[0, 1, -1]) * (n + 1)
        self._laplacian = sp.csc_array(laplacian)
        self._n, self._m = n, m
        self.V = InnerProduct(laplacian + sp.eye_array(n) / (n + 1))
        mass = sp.diags_array([4.0 * np.ones(m), np.ones(m - 1), np.ones(m - 1)], offsets=[0, 1, -1]) / (6.0 * m)
        self.W = InnerProduct(mass)

    def training_set(self) -> Array:
        return self.parameters.grid(self.count)

    def assemble(self, mu: Array) -> VariationalInequality:
        x = np.linspace(0.0, 1.0, self._n + 2)[1:-1]
        centres = np.linspace(0.25, 0.75, self._m) + 0.1 * mu[0] * np.sin(7.0 * np.arange(self._m))
        hats = np.maximum(0.0, 1.0 - np.abs(x[None, :] - centres[:, None]) * (self._n + 1) / (2.0 + mu[0]))
        weights, f = hats / self._m, -np.ones(self._n) / (self._n + 1) * 8.0
        A, g = self._laplacian * (1.0 + mu[0]), weights @ (0.3 + 0.2 * x * mu[0])
        return VariationalInequality(A, f, sp.csr_array(-weights), g)


class Tied(Varying):
    """The string with two of its averages prescribed, each by a row and its opposite."""

    def __init__(self, n: int = 30, m: int = 8) -> None:
        super().__init__(n, m)
        self.W = InnerProduct(sp.block_diag([self.W.matrix, np.eye(4) / m]))

    def assemble(self, mu: Array) -> VariationalInequality:
        vi, x = super().assemble(mu), np.linspace(0.0, 1.0, self._n + 2)[1:-1]
        ties = np.array([(x < 0.2) + 0.1 * mu[0], x > 0.8 - 0.1 * mu[0]], float)
        values = np.array([0.3 - 0.5 * mu[0], -0.5])
        B, g = sp.vstack([vi.B, ties, -ties], format="csr"), np.concatenate([vi.g, values, -values])
        return VariationalInequality(vi.A, vi.f, B, g)


def doubled_areas(points: Array, triangles: Array) -> Array:
    a, b, c = (points[:, corner] for corner in triangles)
    return np.asarray((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])


def fitted_rate(widths: Sequence[float], errors: Sequence[float]) -> float:
    """Slope of the errors over the mesh widths, both logarithmic."""
    return float(np.polyfit(np.log(widths), np.log(errors), 1)[0])


def exact(vi: VariationalInequality) -> tuple[np.ndarray, np.ndarray]:
    """Solution by trying every active set, in coordinates in which A is the identity and rows of B have length one."""
    m, half = len(vi.g), np.linalg.cholesky(np.asarray(vi.A))
    whitened, load = np.linalg.solve(half, vi.B.T), np.linalg.solve(half, vi.f)
    lengths = np.linalg.norm(whitened, axis=0)
    rows, g = (whitened / lengths).T, vi.g / lengths
    for bits in range(2**m):
        active = [i for i in range(m) if bits >> i & 1]
        C, lam = rows[active], np.zeros(m)
        y = load + np.linalg.lstsq(C, g[active] - C @ load, rcond=1e-10)[0]  # the nearest point
        lam[active] = np.linalg.lstsq(C.T, load - y, rcond=1e-10)[0]
        size = np.linalg.norm(load) + np.abs(g).max()
        if np.all(lam >= -1e-10 * size) and np.all(rows @ y - g <= 1e-10 * size):
            return np.linalg.solve(half.T, y), lam / lengths
    raise AssertionError("no active set")


def energy(vi: VariationalInequality) -> EnergyNorm:
    return EnergyNorm(vi.A, CondensedStiffness(vi.A))
