"""β_span over all parameters while the primal space grows vector by vector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from vibench.arrays import Array
from vibench.reduction.lazy_greedy import LazyMaximum
from vibench.reduction.supremizers import ConstraintClasses
from vibench.stability.infsup import beta_span, share


@dataclass(frozen=True)
class ProjectedSupremizers:
    """Supremizers of an orthonormal multiplier basis η, projected on a nested primal basis Z.

    `of_classes` has one matrix ZᵀBᵀη (N'×k) for each of the classes of constraint matrices.
    """

    of_classes: Sequence[Array]
    classes: ConstraintClasses

    def first(self, count: int) -> ProjectedSupremizers:
        """The projections on the first `count` vectors of Z."""
        return ProjectedSupremizers([projected[:count] for projected in self.of_classes], self.classes)

    def beta_span(self) -> Array:
        """β_span at every parameter (P,)."""
        return self.classes.everywhere([beta_span(projected) for projected in self.of_classes])

    def over_steps(self, first: int) -> Array:
        """The smallest β_span over all parameters with the first `first`, … N' vectors (N' − first + 1,)."""
        factors = np.abs(self.classes.factors)
        weights = [float(np.min(factors[self.classes.members == k])) for k in range(len(self.of_classes))]
        return self._smallest(first, lambda beta, k: weights[k] * beta)

    def shares_over_steps(self, first: int, reachable: Array) -> Array:
        """The smallest `share` of `reachable` (P,), the β_span of the whole of V, likewise (N' − first + 1,)."""
        of_representatives = reachable[self.classes.firsts]
        return self._smallest(first, lambda beta, k: share(beta, of_representatives[k]))

    def _smallest(self, first: int, value: Callable[[float, int], float]) -> Array:
        """The smallest value over all classes, each from the β_span of its representative.

        β_span never decreases as Z grows, so values of earlier steps are lower bounds and the minimum is found lazily.
        """

        def negative(count: int, k: int) -> float:
            return -value(beta_span(self.of_classes[k][:count]), k)

        lazy, last = LazyMaximum(np.zeros(len(self.of_classes))), self.of_classes[0].shape[0]
        return np.array([-lazy.next(partial(negative, count))[1] for count in range(first, last + 1)])
