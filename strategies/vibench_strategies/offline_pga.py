"""The projected greedy algorithm: one enrichment for all parameters, built offline."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from vibench.arrays import Array
from vibench.greedy import TIE, LazyMaximum
from vibench.linalg import orthonormal_range, remove, singular_values, svd
from vibench.strategy import Enrichment, Kind, Offline, PrimalStrategy
from vibench.supremizer import SupremizerCoordinates, constraint_classes


class OfflinePGA(PrimalStrategy):
    """PGA, Algorithm 1 of Niakh, Drouet, Ehrlacher and Ern (2022).

    The tolerance δ bounds σ_S(mu), equation (21), over the training set; β_S(mu) ≥ √(1 − δ²)·β_on(mu) follows.
    """

    takes_tolerance: ClassVar[bool] = True

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        """Add the worst represented supremizer of the worst parameter until σ ≤ δ everywhere.

        Training parameters whose constraint matrices are proportional share one supremizer space and count once.
        σ only falls as S grows (Lemma 3.2), so the maximum is taken lazily.
        """
        if tolerance is None:
            raise ValueError("the projected greedy algorithm needs a tolerance")
        problem = offline.problem
        classes = constraint_classes([problem.assemble(mu).B for mu in offline.training])
        space = SupremizerCoordinates(problem.V, offline.basis, classes.representatives)
        targets = [orthonormal_range(space.supremizers(B, offline.span)) for B in classes.representatives]
        maximum = LazyMaximum(np.ones(len(targets)))
        grown = space.plain
        history = []
        while True:
            worst, sigma = maximum.next(lambda p: _sigma(grown, targets[p]))  # noqa: B023  called at once
            history.append(sigma)
            if sigma <= tolerance:
                break
            grown = np.column_stack([grown, _worst_direction(grown, targets[worst])])
        added = space.vectors(grown[:, space.plain.shape[1] :])
        return Enrichment(Kind.FIXED, vectors=added, history={"sigma": np.array(history)})


def _sigma(space: Array, target: Array) -> float:
    """σ_S(mu): the largest sine of the principal angles between S_R(mu) and V_N + S."""
    return float(np.max(singular_values(remove(space, target)), initial=0.0))


def _worst_direction(space: Array, target: Array) -> Array:
    """Unit vector (d,) of lines 5 to 7: the normalised residual of the worst v in S_R(mu).

    Many σ equal 1 while V_N + S is smaller than S_R(mu). In a cluster of equal singular values the vector is chosen by
    a rule that does not depend on the basis LAPACK happened to return: the projection on the cluster of the basis
    vector of `target` that is closest to it.
    """
    residual = remove(space, target)
    _, sines, right = svd(residual)
    cluster = right[sines >= sines[0] - TIE]
    weight = np.linalg.norm(cluster, axis=0)
    closest = int(np.argmax(weight >= weight.max() - TIE))
    v = remove(space, residual @ (cluster.T @ cluster[:, closest]))
    return np.asarray(v / np.linalg.norm(v))
