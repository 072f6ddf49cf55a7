"""Common to the enrichments by training supremizers: the supremizer space and the share of β_on reached in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from vibench import Array, NumericalError, Offline, Step
from vibench.linalg import RANK_RTOL, project_out, singular_values, svd
from vibench.reduction import TIE, constraint_classes, supremizer_coordinates
from vibench.stability import beta_span


class SupremizerSpace:
    """V_N + S inside V_N + span of all supremizers of the training set, in Euclidean coordinates of that sum.

    Training parameters whose constraint matrices are proportional share one supremizer space and count once.

    Parameters
    ----------
    offline
        What the primal strategy builds on.

    Attributes
    ----------
    supremizers
        Coordinates (d×k) of T(mu)η for all η of `Offline.span`, one array per class of parameters.
    shared_by
        Number of training parameters of each class.
    plain, basis
        Orthonormal coordinates of V_N (d×N) and of V_N + S (d×(N+S)).
    """

    def __init__(self, offline: Offline) -> None:
        problem = offline.problem
        classes = constraint_classes(problem.constraint(mu)[0] for mu in offline.training)
        self.shared_by = np.bincount(classes.members)
        self._coordinates, self.supremizers = supremizer_coordinates(
            problem.V, offline.basis, classes.representatives, offline.span
        )
        self.plain = self.basis = self._coordinates.plain

    @property
    def count(self) -> int:
        """Number S of vectors."""
        return int(self.basis.shape[1] - self.plain.shape[1])

    def step(self, measure: float, history: Mapping[str, Sequence[float]]) -> Step:
        """The enrichment so far, for a nested strategy."""
        return Step(self.count, measure, self._vectors, history)

    def _vectors(self, first: int) -> Array:
        return self._coordinates.vectors(self.basis[:, self.plain.shape[1] + first :])

    def add(self, vector: Array, reached: str) -> None:
        """Add to S the normalised component of a vector (d,) orthogonal to V_N + S.

        Raises
        ------
        NumericalError
            If that component is round-off; `reached` describes what the present vectors have reached.
        """
        left = project_out(self.basis, vector)
        length = float(np.linalg.norm(left))
        if self.basis.shape[1] == self.basis.shape[0] or length <= RANK_RTOL * float(np.linalg.norm(vector)):
            raise NumericalError(f"with all supremizers added, {reached}")
        # Orthogonalised twice: once is not enough if the component is small, because of cancellation.
        left = project_out(self.basis, left / length)
        self.basis = np.column_stack([self.basis, left / np.linalg.norm(left)])


class Shares:
    """Share of β_on(mu), the constant of the whole of V over span χ, that V_N + S reaches at one parameter.

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
        """1 − β_S(mu)/β_on(mu), which does not increase with S; 0 where β_on(mu) = 0."""
        return max(0.0, 1.0 - beta_span(self._on(space)) / self._online) if self._online else 0.0

    def worst_supremizer(self, space: Array) -> Array:
        """T(mu)η* (d,) for the unit η* in span χ at which β_S(mu) is attained; `canonical` if there are several."""
        images = self._on(space)
        # Zero rows make the decomposition return the null space, too, where β_S is attained if N' < k.
        padding = np.zeros((max(0, images.shape[1] - images.shape[0]), images.shape[1]))
        _, values, right = svd(np.vstack([images, padding]))
        return np.asarray(self._supremizers @ canonical(right[values <= values[-1] + TIE * self._online]))

    def _on(self, space: Array) -> Array:
        """Coordinates (N'×k) of the supremizers projected on V_N + S (d×N', orthonormal); computes new rows only."""
        new = space[:, self._images.shape[0] :]
        self._images = np.vstack([self._images, new.T @ self._supremizers])
        return self._images


def canonical(cluster: Array) -> Array:
    """Unit vector (k,) of the span of orthonormal rows (c×k) that does not depend on which rows LAPACK returned.

    It is the normalised projection on the span of the coordinate vector closest to the span.
    """
    weight = np.linalg.norm(cluster, axis=0)
    closest = int(np.argmax(weight >= weight.max() - TIE))
    chosen = cluster.T @ cluster[:, closest]
    return np.asarray(chosen / np.linalg.norm(chosen))
