"""The projected greedy algorithm: one enrichment for all parameters, built offline."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.greedy import TIE, LazyMaximum
from vibench.linalg import orthonormal_range, remove, svd
from vibench.strategy import Enrichment, Kind, Offline, PrimalStrategy
from vibench.supremizer import constraint_classes, supremizer_coordinates

SMALL = 1e-10
"""Squares of sines below this are computed from residual vectors, not from the downdated Gram matrix."""


class OfflinePGA(PrimalStrategy):
    """PGA, Algorithm 1 of Niakh, Drouet, Ehrlacher and Ern (2022).

    The tolerance δ bounds σ_S(mu), equation (21), over the training set; β_S(mu) ≥ √(1 − δ²)·β_on(mu) follows.
    """

    takes_tolerance: ClassVar[bool] = True

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        """Add the worst represented supremizer of the worst parameter until σ ≤ δ everywhere.

        Training parameters whose constraint matrices are proportional share one supremizer space and count once.
        σ only falls as S grows (Lemma 3.2), so the maximum is taken lazily.

        Raises
        ------
        NumericalError
            If the tolerance is not reached with every supremizer there is.
        """
        if tolerance is None:
            raise ValueError("the projected greedy algorithm needs a tolerance")
        problem = offline.problem
        different = constraint_classes([problem.constraint(mu)[0] for mu in offline.training]).representatives
        space, supremizers = supremizer_coordinates(problem.V, offline.basis, different, offline.span)
        targets = [_Target(found, space.plain) for found in supremizers]
        maximum = LazyMaximum(np.ones(len(targets)))
        grown, history = space.plain, []
        while True:
            worst, sigma = maximum.next(lambda p: targets[p].sigma(grown))  # noqa: B023  called at once
            history.append(sigma)
            if sigma <= tolerance:
                break
            if grown.shape[1] == grown.shape[0]:
                raise NumericalError(f"all supremizers leave σ = {sigma:.0e}, above the tolerance {tolerance:g}")
            grown = np.column_stack([grown, targets[worst].worst_direction(grown)])
        added = space.vectors(grown[:, space.plain.shape[1] :])
        return Enrichment(Kind.FIXED, vectors=added, history={"sigma": np.array(history)})


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
