"""Enrichments that grow vector by vector: one construction serves every tolerance it passes."""

from __future__ import annotations

import operator
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from vibench.arrays import Array, taken
from vibench.errors import NumericalError, RequestError
from vibench.interfaces.strategies import Enrichment, Kind, Offline, PrimalStrategy
from vibench.signatures import refuse_others, rule_of
from vibench.timing import Seconds, Stopwatch


@dataclass(frozen=True)
class Step:
    """A fixed enrichment that grows, after `count` of its vectors.

    A tolerance bounds its `measure` from above, or from below where the strategy says `larger_is_tighter`. `vectors`
    maps k to the vectors (n×(S−k)) from the k-th on, V-orthonormal, orthogonal to V_N and to those before. `history`
    has the values over the steps so far, by quantity.
    """

    count: int
    measure: float
    vectors: Callable[[int], Array]
    history: Mapping[str, Sequence[float]]


class NestedStrategy(PrimalStrategy):
    """A primal strategy whose enrichment at a tolerance is the beginning of that at a tighter one."""

    takes_tolerance: ClassVar[bool] = True

    @abstractmethod
    def steps(self, offline: Offline) -> Iterator[Step]:
        """Yield the enrichment with S = 0, 1, 2, … vectors, until the caller stops at the tightest tolerance.

        Raises a `NumericalError` that says what was reached if there is no further vector.
        """

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        """Grow until the tolerance is reached; raises a `NumericalError` that says why it was not."""
        if tolerance is None:
            raise RequestError(f"{type(self).__name__} needs a tolerance")
        grown = grow_through(self, offline, [tolerance])
        return grown.at(grown.milestone(tolerance))


@dataclass(frozen=True)
class Milestone:
    """Number of vectors, history and seconds at which a growth reached a tolerance."""

    count: int
    history: Mapping[str, Array]
    seconds: Seconds


@dataclass(frozen=True)
class Grown:
    """All vectors (n×S) of a growth, its milestones by tolerance, and why it reached no further ones."""

    vectors: Array
    milestones: Mapping[float, Milestone]
    missed: str

    def milestone(self, tolerance: float) -> Milestone:
        """The milestone of a tolerance; raises a `NumericalError` that says why it was not reached."""
        if tolerance not in self.milestones:
            raise NumericalError(f"the tolerance {tolerance:g} is not reached: {self.missed}")
        return self.milestones[tolerance]

    def at(self, milestone: Milestone) -> Enrichment:
        """The enrichment of a milestone."""
        vectors = np.ascontiguousarray(self.vectors[:, : milestone.count])
        return Enrichment(Kind.FIXED, vectors=vectors, history=milestone.history)


def grow_through(strategy: NestedStrategy, offline: Offline, tolerances: Iterable[float]) -> Grown:
    """Grow one enrichment through all tolerances; the seconds of each are those up to its last vector."""
    watch, ahead = Stopwatch(), list(dict.fromkeys(tolerances))
    vectors = np.zeros((offline.problem.V.dim, 0))
    milestones: dict[float, Milestone] = {}
    steps, begun = strategy.steps(offline), False
    while ahead:
        try:
            step = next(steps)
        except StopIteration:
            return Grown(vectors, milestones, "the strategy has no further vector")
        except NumericalError as error:
            if not begun:  # the construction failed before there was an enrichment at all
                raise
            return Grown(vectors, milestones, str(error))
        begun = True
        what = f"what `steps` of {type(strategy).__name__} yielded"
        refuse_others(what, step, rule_of(Step), NumericalError)
        refuse_others(f"measure of {what}", step.measure, rule_of(float), NumericalError)
        meets = operator.ge if strategy.larger_is_tighter else operator.le
        passed = [tolerance for tolerance in ahead if meets(step.measure, tolerance)]
        if passed:
            known = vectors.shape[1]
            added = taken(step.vectors(known), f"vectors of {what}", len(vectors), step.count - known)
            vectors = np.hstack([vectors, added])
            history = {quantity: np.array(values) for quantity, values in step.history.items()}
            milestones |= dict.fromkeys(passed, Milestone(step.count, history, watch.seconds()))
            ahead = [tolerance for tolerance in ahead if tolerance not in milestones]
    return Grown(vectors, milestones, "")
