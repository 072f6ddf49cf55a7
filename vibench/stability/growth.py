"""β_span of a primal space that grows, over parameters: from images of the multipliers, few of which are asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from vibench.arrays import Array
from vibench.reduction.lazy_greedy import LazyMaximum
from vibench.reduction.supremizers import ConstraintClasses
from vibench.stability.infsup import beta_span

GRAM_RTOL = 1e-8
"""Eigenvalues of a Gram matrix below this fraction of the largest have lost half of their digits to round-off."""


@dataclass(frozen=True)
class Images:
    """ZᵀBᵀη (N'×k) for every class of constraint matrices, Z and η orthonormal bases.

    Attributes
    ----------
    of_classes
        One image per class.
    classes
        The constraint matrices.
    """

    of_classes: Sequence[Array]
    classes: ConstraintClasses

    def first(self, rows: int) -> Images:
        """Those of the first vectors of Z alone."""
        return Images([image[:rows] for image in self.of_classes], self.classes)

    def beta_span(self) -> Array:
        """β_span at every parameter (P,)."""
        return self.classes.everywhere([beta_span(image) for image in self.of_classes])

    def over_steps(self, first: int) -> Array:
        """Over all parameters the smallest β_span of the first `first`, `first` + 1, … N' vectors (N' − first + 1,).

        It only grows with the vectors, so an earlier value bounds it from below and few are computed again. Squares
        come from Gram matrices that grow with the vectors; where they would keep too few digits the images are asked.
        """
        sizes = np.abs(self.classes.factors)
        weights = [float(np.min(sizes[self.classes.members == k])) for k in range(len(self.of_classes))]
        growing = [_Growing(image, weight) for image, weight in zip(self.of_classes, weights, strict=True)]

        def negative(rows: int, k: int) -> float:
            return -growing[k].at(rows)

        smallest, last = LazyMaximum(np.zeros(len(growing))), self.of_classes[0].shape[0]
        return np.array([-smallest.next(partial(negative, rows))[1] for rows in range(first, last + 1)])


class _Growing:
    """β_span, times a weight, of ever more rows of one image (N'×k)."""

    def __init__(self, image: Array, weight: float) -> None:
        self._image, self._weight = image, weight
        self._gram, self._known = np.zeros((image.shape[1],) * 2), 0

    def at(self, rows: int) -> float:
        """β_span of so many rows, no fewer than were asked before."""
        if not self._image.shape[1] or rows < self._image.shape[1]:
            return self._weight * beta_span(self._image[:rows])
        new, self._known = self._image[self._known : rows], rows
        self._gram = self._gram + new.T @ new
        squares = np.linalg.eigvalsh(self._gram)
        sharp = squares[0] > GRAM_RTOL * squares[-1]
        return self._weight * (float(np.sqrt(squares[0])) if sharp else beta_span(self._image[:rows]))
