"""The projected greedy algorithm: one enrichment for all parameters, built offline."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.greedy import TIE, LazyMaximum
from vibench.linalg import orthonormal_range, remove, svd
from vibench.nested import Growth, NestedStrategy
from vibench.strategy import Offline
from vibench.supremizer import constraint_classes, supremizer_coordinates

SMALL = 1e-10
"""Squares of sines below this are computed from residual vectors, not from the downdated Gram matrix."""


class OfflinePGA(NestedStrategy):
    """PGA, Algorithm 1 of Niakh, Drouet, Ehrlacher and Ern (2022).

    The tolerance δ bounds σ_S(mu), equation (21), over the training set; β_S(mu) ≥ √(1 − δ²)·β_on(mu) follows.
    """

    def begin(self, offline: Offline) -> ProjectedGreedy:
        """Represent the supremizers of the training set in coordinates."""
        return ProjectedGreedy(offline)


class ProjectedGreedy(Growth):
    """Adds the worst represented supremizer of the worst parameter.

    Training parameters whose constraint matrices are proportional share one supremizer space and count once. σ only
    falls as S grows (Lemma 3.2), so the maximum is taken lazily.
    """

    def __init__(self, offline: Offline) -> None:
        problem = offline.problem
        different = constraint_classes([problem.constraint(mu)[0] for mu in offline.training]).representatives
        self._space, supremizers = supremizer_coordinates(problem.V, offline.basis, different, offline.span)
        self._grown = self._plain = self._space.plain
        self._targets = [_Target(found, self._plain) for found in supremizers]
        self._maximum = LazyMaximum(np.ones(len(self._targets)))
        self._sigma: list[float] = []
        self._assess()

    @property
    def count(self) -> int:
        """Number of vectors."""
        return int(self._grown.shape[1] - self._plain.shape[1])

    def reached(self, tolerance: float) -> bool:
        """Whether σ ≤ δ everywhere."""
        return bool(self._sigma[-1] <= tolerance)

    def grow(self) -> None:
        """Add a vector, lines 5 to 7.

        Raises
        ------
        NumericalError
            If every supremizer is represented.
        """
        if self._grown.shape[1] == self._grown.shape[0]:
            raise NumericalError(f"all supremizers leave σ = {self._sigma[-1]:.0e}")
        self._grown = np.column_stack([self._grown, self._targets[self._worst].worst_direction(self._grown)])
        self._assess()

    def vectors(self, first: int) -> Array:
        """The vectors from their coordinates."""
        return self._space.vectors(self._grown[:, self._plain.shape[1] + first :])

    def history(self) -> Mapping[str, Array]:
        """σ, the largest over the training set."""
        return {"sigma": np.array(self._sigma)}

    def _assess(self) -> None:
        self._worst, sigma = self._maximum.next(lambda p: self._targets[p].sigma(self._grown))
        self._sigma.append(sigma)


class _Target:
    """One supremizer space S_R(mu): an orthonormal basis Q and the Gram matrix of what V_N + S leaves of it.

    The Gram matrix loses a rank-one term for every vector added to S, brought up to date only when it is looked at.
    Its eigenvalues are squares of sines and keep half their digits, so small ones are computed from residuals again.
    """

    def __init__(self, supremizers: Array, plain: Array) -> None:
        self._basis = orthonormal_range(supremizers)
        self._known = plain.shape[1]
        outside = remove(plain, self._basis)
        self._gram = outside.T @ outside

    def sigma(self, space: Array) -> float:
        """σ_S(mu): the largest sine of the principal angles between S_R(mu) and V_N + S (d×k, orthonormal)."""
        if not self._basis.size:
            return 0.0
        if space.shape[1] < self._basis.shape[1]:  # something in S_R(mu) is orthogonal to all of it
            return 1.0
        square = float(np.linalg.eigvalsh(self._left_by(space))[-1])
        return float(np.sqrt(square)) if square >= SMALL else float(self._sines(space)[0][0])

    def worst_direction(self, space: Array) -> Array:
        """Unit vector (d,) of lines 5 to 7: the normalised residual of the worst v in S_R(mu).

        Many σ equal 1 while V_N + S is smaller than S_R(mu). In a cluster of equal sines the vector is chosen by a rule
        that does not depend on the basis LAPACK happened to return: the projection on the cluster of the basis vector
        of S_R(mu) that is closest to it.
        """
        sines, right = self._sines(space)
        cluster = right[sines >= sines[0] - TIE]
        weight = np.linalg.norm(cluster, axis=0)
        closest = int(np.argmax(weight >= weight.max() - TIE))
        v = remove(space, self._basis @ (cluster.T @ cluster[:, closest]))
        v = remove(space, v / np.linalg.norm(v))
        return np.asarray(v / np.linalg.norm(v))

    def _left_by(self, space: Array) -> Array:
        """Gram matrix (r×r) of what V_N + S leaves of the basis; its eigenvalues are squares of sines."""
        rows = space[:, self._known :].T @ self._basis
        self._gram = self._gram - rows.T @ rows
        self._known = space.shape[1]
        return self._gram

    def _sines(self, space: Array) -> tuple[Array, Array]:
        """Sines (r,), falling, and the directions in S_R(mu) they belong to, as rows (r×r)."""
        squares, vectors = np.linalg.eigh(self._left_by(space))
        if squares[-1] < SMALL:
            _, sines, right = svd(remove(space, self._basis))
            return sines, right
        return np.sqrt(np.maximum(squares[::-1], 0.0)), vectors.T[::-1]
