"""Enrichments that grow vector by vector: one construction serves every tolerance it passes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.strategies import Enrichment, Kind, Offline, PrimalStrategy
from vibench.timing import Seconds, Stopwatch


class Growth(ABC):
    """A fixed enrichment that grows."""

    @property
    @abstractmethod
    def count(self) -> int:
        """Number S of vectors so far."""

    @abstractmethod
    def reached(self, tolerance: float) -> bool:
        """Whether the vectors so far keep a tolerance."""

    @abstractmethod
    def grow(self) -> None:
        """Add a vector.

        Raises
        ------
        NumericalError
            If there is none left, saying what was reached.
        """

    @abstractmethod
    def vectors(self, first: int) -> Array:
        """The vectors (n×k) from number `first` on, V-orthonormal and orthogonal to V_N and to those before."""

    @abstractmethod
    def history(self) -> Mapping[str, Array]:
        """Quantity → values over steps so far."""


@dataclass(frozen=True)
class Milestone:
    """What had been built when a tolerance was reached, and in how many seconds."""

    count: int
    history: Mapping[str, Array]
    seconds: Seconds


@dataclass(frozen=True)
class Grown:
    """All vectors (n×S) of a growth, where it passed its tolerances, and why it passed no others."""

    vectors: Array
    milestones: Mapping[float, Milestone]
    missed: str

    def at(self, tolerance: float) -> tuple[Enrichment, Seconds]:
        """The enrichment of a tolerance, and the seconds it alone would have taken.

        Raises
        ------
        NumericalError
            If the tolerance was not reached.
        """
        if tolerance not in self.milestones:
            raise NumericalError(f"the tolerance {tolerance:g} is not reached: {self.missed}")
        found = self.milestones[tolerance]
        vectors = np.ascontiguousarray(self.vectors[:, : found.count])
        return Enrichment(Kind.FIXED, vectors=vectors, history=found.history), found.seconds


class NestedStrategy(PrimalStrategy):
    """A primal strategy whose enrichment at a tolerance is the beginning of that at a tighter one."""

    takes_tolerance: ClassVar[bool] = True

    @abstractmethod
    def begin(self, offline: Offline) -> Growth:
        """Prepare the construction; nothing is added yet."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        """Grow until the tolerance is kept.

        Raises
        ------
        NumericalError
            If it is not kept with every vector there is.
        """
        if tolerance is None:
            raise ValueError(f"{type(self).__name__} needs a tolerance")
        return grow_through(self, offline, [tolerance]).at(tolerance)[0]


def grow_through(strategy: NestedStrategy, offline: Offline, tolerances: Iterable[float]) -> Grown:
    """Grow one enrichment through all tolerances; the seconds of each are those up to its last vector."""
    watch, ahead = Stopwatch(), list(dict.fromkeys(tolerances))
    growth = strategy.begin(offline)
    vectors = np.zeros((offline.problem.V.dim, 0))
    milestones: dict[float, Milestone] = {}
    while True:
        passed = [tolerance for tolerance in ahead if growth.reached(tolerance)]
        if passed:
            vectors = np.hstack([vectors, growth.vectors(vectors.shape[1])])
            found = Milestone(growth.count, dict(growth.history()), watch.seconds())
            milestones |= dict.fromkeys(passed, found)
            ahead = [tolerance for tolerance in ahead if tolerance not in milestones]
        if not ahead:
            return Grown(vectors, milestones, "")
        try:
            growth.grow()
        except NumericalError as error:
            return Grown(vectors, milestones, str(error))
