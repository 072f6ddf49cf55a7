"""Inf-sup constants over many parameters, one computation per class of proportional constraint matrices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from vibench.arrays import Array
from vibench.linalg.inner_product import InnerProduct
from vibench.reduction.lazy_greedy import LazyMaximum
from vibench.reduction.supremizers import ConstraintClasses, isometric_supremizers
from vibench.stability.infsup import InfSup, Multipliers, beta_span, inf_sup, inf_sup_on, share


def constants_full(V: InnerProduct, classes: ConstraintClasses, cone: Multipliers) -> list[InfSup]:
    """Constants of the whole of V at every B(mu) (m×n)."""
    image = isometric_supremizers(V, classes.representatives, cone.rank + cone.chi.shape[1])
    found = [inf_sup(image(B, cone.span), image(B, cone.chi), cone) for B in classes.representatives]
    return everywhere(classes, found)


def constants_on(Z: Array, classes: ConstraintClasses, cone: Multipliers) -> list[InfSup]:
    """Constants of one primal space with V-orthonormal basis Z (n×N') at every B(mu)."""
    return everywhere(classes, [inf_sup_on(Z, B, cone) for B in classes.representatives])


def everywhere(classes: ConstraintClasses, found: Sequence[InfSup]) -> list[InfSup]:
    """Constants of all matrices from those of the representatives."""
    return [found[k].scaled(c) for k, c in zip(classes.members, classes.factors, strict=True)]


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
