"""The sample problem on which strategies and formulations are tried, its snapshots, and a reduced model of it."""

from __future__ import annotations

from functools import cache
from typing import ClassVar

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.interfaces.formulations import Snapshots
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import Problem, Sampler, VariationalInequality
from vibench.interfaces.strategies import DualStrategy, Enrichment, Kind, Offline, PrimalStrategy, ReducedSet, Stop
from vibench.linalg.inner_product import InnerProduct
from vibench.offline.reduction import Reduction, high_fidelity_sweep
from vibench.reduction.cones import greedy_cone
from vibench.reduction.supremizers import supremizers


class MovingSupport(Problem):
    """A string pressed on a parabolic support that moves and rises with the parameter."""

    # Weighted means around points that move with the support are constrained: B and every supremizer depend on mu.

    elementwise: ClassVar[frozenset[str]] = frozenset({"A", "f"})
    parameters = ParameterBox(("position", "height"), np.array([-0.1, 0.0]), np.array([0.1, 0.04]), ("m", "m"))

    def __init__(self) -> None:
        n, m = 40, 14
        self._h = h = 1.0 / (n + 1)
        self._x = h * np.arange(1, n + 1)
        self._stiffness = _tridiagonal(-1.0, 2.0, n) / h
        self._load = np.full(n, -4.0 * h)
        self._width = 0.5 / (m - 1)
        self.V = InnerProduct(self._stiffness + h * sp.eye_array(n), "X_V")
        self.W = InnerProduct(_tridiagonal(self._width / 6.0, self._width * 2.0 / 3.0, m), "X_W")

    def training_set(self) -> Array:
        return self.parameters.grid(5, 5)

    def assemble(self, mu: Array) -> VariationalInequality:
        """Weighted means of −u around 14 points are at most those of −ψ, where ψ is the support."""
        centres = np.linspace(0.25, 0.75, self.W.dim) + mu[0]
        weights = np.maximum(0.0, 1.0 - np.abs(self._x - centres[:, None]) / self._width) / self.V.dim
        support = -0.2 + mu[1] - 0.8 * (self._x - 0.5 - mu[0]) ** 2
        return VariationalInequality(self._stiffness, self._load, sp.csr_array(-weights), -weights @ support)

    @property
    def element_dofs(self) -> Indices:
        left = np.arange(-1, self.V.dim)
        return np.stack([left, np.where(left + 1 < self.V.dim, left + 1, -1)])

    def element_sampler(self, elements: Indices) -> Sampler:
        h = self._h
        stiffness = np.tile(np.array([[1.0, -1.0], [-1.0, 1.0]]) / h, (len(elements), 1, 1))
        return lambda _: {"A": stiffness, "f": np.full((len(elements), 2), -2.0 * h)}


def _tridiagonal(off: float, diagonal: float, n: int) -> SparseMatrix:
    return sp.csr_array(sp.diags_array([off, diagonal, off], offsets=[-1, 0, 1], shape=(n, n)))


class _Greedy(DualStrategy):
    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        return greedy_cone(snapshots, W, stop)


@cache
def _snapshots() -> Snapshots:
    """High-fidelity solutions of the sample problem at its training parameters; for reading only."""
    problem = MovingSupport()
    return high_fidelity_sweep(problem, problem.training_set())


def sample_snapshots() -> tuple[Array, InnerProduct]:
    """Multipliers λ(mu_p) (m×P) of the sample problem at its training parameters, and their space W."""
    return _snapshots().lam.copy(), MovingSupport().W


def sample_offline() -> Offline:
    """A reduced model of the sample problem to enrich: 4 POD modes and a greedy cone of 6 generators."""
    return Reduction(MovingSupport(), _Greedy(), None, Stop(size=4), Stop(size=6)).given(snapshots=_snapshots()).offline


class _Supremizers(PrimalStrategy):
    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:  # noqa: ARG002
        V, B = offline.problem.V, offline.problem.constraint(offline.training[0])[0]
        return Enrichment(Kind.FIXED, vectors=V.orthonormalise(supremizers(V, B, offline.span), offline.basis))


def sample_reduction() -> Reduction:
    """An offline phase of the sample problem with all its steps, for formulations: V_N of 1e-3, a cone of 1e-2."""
    stops = Stop(tolerance=1e-3), Stop(tolerance=1e-2)
    return Reduction(MovingSupport(), _Greedy(), _Supremizers(), *stops).given(snapshots=_snapshots())
