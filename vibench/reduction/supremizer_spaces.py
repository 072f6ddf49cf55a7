"""The supremizer spaces S_R(mu) of the training set, in coordinates: what fixed enrichments by supremizers grow on."""

from __future__ import annotations

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.strategies import Offline
from vibench.linalg.dense import RANK_RTOL, orthonormal_range, project_out, singular_values, svd
from vibench.reduction.lazy_greedy import TIE
from vibench.reduction.nested import Growth
from vibench.reduction.supremizers import constraint_classes, supremizer_coordinates
from vibench.stability.infsup import beta_span

SMALL = 1e-10
"""Squares of sines below this are computed from residual vectors, not from the downdated Gram matrix."""


class SupremizerGrowth(Growth):
    """A growth by vectors out of V_N and the supremizers of the training set, all in coordinates of their sum.

    Training parameters whose constraint matrices are proportional share one supremizer space and count once.

    Attributes
    ----------
    supremizers
        Coordinates (d×k) of T(mu)η, η running through `Offline.span`, for every class of parameters.
    shared_by
        How many training parameters each class has.
    plain, grown
        Orthonormal coordinates of V_N (d×N) and of V_N + S (d×(N+S)).
    """

    def __init__(self, offline: Offline) -> None:
        problem = offline.problem
        classes = constraint_classes([problem.constraint(mu)[0] for mu in offline.training])
        self.shared_by = np.bincount(classes.members)
        self._space, self.supremizers = supremizer_coordinates(
            problem.V, offline.basis, classes.representatives, offline.span
        )
        self.plain = self.grown = self._space.plain

    @property
    def count(self) -> int:
        """Number of vectors."""
        return int(self.grown.shape[1] - self.plain.shape[1])

    def vectors(self, first: int) -> Array:
        """The vectors from their coordinates."""
        return self._space.vectors(self.grown[:, self.plain.shape[1] + first :])

    def add(self, vector: Array, reached: str) -> None:
        """Add what is left of a vector (d,) outside V_N + S, normalised.

        Raises
        ------
        NumericalError
            If that is nothing but round-off; `reached` says how far the vectors so far have come.
        """
        left = project_out(self.grown, vector)
        length = float(np.linalg.norm(left))
        if self.grown.shape[1] == self.grown.shape[0] or length <= RANK_RTOL * float(np.linalg.norm(vector)):
            raise NumericalError(f"all supremizers leave {reached}")
        left = project_out(self.grown, left / length)
        self.grown = np.column_stack([self.grown, left / np.linalg.norm(left)])


class Angles:
    """One supremizer space S_R(mu): an orthonormal basis Q and the Gram matrix of what V_N + S leaves of it.

    The Gram matrix loses a rank-one term for every vector added to S, brought up to date only when it is looked at.
    Its eigenvalues are squares of sines and keep half their digits, so small ones are computed from residuals again.

    Parameters
    ----------
    supremizers
        Coordinates (d×k) of vectors that span S_R(mu).
    plain
        Orthonormal coordinates (d×N) of V_N.
    """

    def __init__(self, supremizers: Array, plain: Array) -> None:
        self._basis = orthonormal_range(supremizers)
        self._known = plain.shape[1]
        outside = project_out(plain, self._basis)
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
        """The worst v (d,) in S_R(mu), of unit norm: it makes the largest angle with V_N + S.

        Many σ equal 1 while V_N + S is smaller than S_R(mu), and then `canonical` chooses.
        """
        sines, right = self._sines(space)
        return np.asarray(self._basis @ canonical(right[sines >= sines[0] - TIE]))

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
            _, sines, right = svd(project_out(space, self._basis))
            return sines, right
        return np.sqrt(np.maximum(squares[::-1], 0.0)), vectors.T[::-1]


class Shares:
    """How much of β_on(mu), what the whole of V gives span χ, is reached by V_N + S at one parameter.

    Parameters
    ----------
    supremizers
        Coordinates (d×k) of T(mu)η for W-orthonormal η.
    """

    def __init__(self, supremizers: Array) -> None:
        self._supremizers = supremizers
        self._images = np.zeros((0, supremizers.shape[1]))
        values = singular_values(supremizers)
        independent = len(values) == supremizers.shape[1] and np.all(values > RANK_RTOL * values[:1])
        self._online = float(values[-1]) if independent and len(values) else 0.0

    def missing(self, space: Array) -> float:
        """1 − β_S(mu)/β_on(mu), which only falls as S grows; 0 where β_on(mu) = 0 and there is nothing to reach."""
        return max(0.0, 1.0 - beta_span(self._on(space)) / self._online) if self._online else 0.0

    def worst_supremizer(self, space: Array) -> Array:
        """T(mu)η* (d,) for the unit η* in span χ at which β_S(mu) is attained; `canonical` if there are several."""
        images = self._on(space)
        padding = np.zeros((max(0, images.shape[1] - images.shape[0]), images.shape[1]))
        _, values, right = svd(np.vstack([images, padding]))
        return np.asarray(self._supremizers @ canonical(right[values <= values[-1] + TIE * self._online]))

    def _on(self, space: Array) -> Array:
        """Coordinates (N'×k) of the supremizers projected on V_N + S (d×N', orthonormal); of what is new alone."""
        new = space[:, self._images.shape[0] :]
        self._images = np.vstack([self._images, new.T @ self._supremizers])
        return self._images


def canonical(cluster: Array) -> Array:
    """Unit vector (k,) of the span of orthonormal rows (c×k) that does not depend on which rows LAPACK returned.

    The projection on the span of the coordinate vector that is closest to it.
    """
    weight = np.linalg.norm(cluster, axis=0)
    closest = int(np.argmax(weight >= weight.max() - TIE))
    chosen = cluster.T @ cluster[:, closest]
    return np.asarray(chosen / np.linalg.norm(chosen))
