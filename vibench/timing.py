"""Seconds: CPU seconds of the process and of children that it waited for, wall seconds beside them."""

from __future__ import annotations

import statistics
from bisect import insort
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import repeat
from resource import RUSAGE_CHILDREN, getrusage

# Bound before plugins are imported, which may replace the functions of `time`.
from time import perf_counter, process_time
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

# Seconds after which runs are not repeated; work that takes longer is timed once.
SLOW = 1.0

# Rounds of two blocks; fewer do not show the scatter between blocks, so that nothing is decided.
FEWEST_ROUNDS = 6


@dataclass(frozen=True)
class Seconds:
    """CPU and wall seconds of some work."""

    cpu: float
    wall: float

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.cpu + other.cpu, self.wall + other.wall)

    def beyond(self, other: Seconds) -> Seconds:
        """The seconds by which these exceed others, at least 0."""
        return Seconds(max(self.cpu - other.cpu, 0.0), max(self.wall - other.wall, 0.0))


NO_TIME = Seconds(0.0, 0.0)


class Stopwatch:
    """CPU seconds of all threads and of the children that have ended, and wall seconds, since its creation."""

    def __init__(self) -> None:
        self._children, self._wall, self._cpu = _children_seconds(), perf_counter(), process_time()

    def seconds(self) -> Seconds:
        """CPU and wall seconds so far."""
        cpu, wall = process_time() - self._cpu, perf_counter() - self._wall
        return Seconds(cpu + (_children_seconds() - self._children), wall)


def _children_seconds() -> float:
    """CPU seconds of the child processes that this one has waited for."""
    used = getrusage(RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def timed(work: Callable[[], T]) -> tuple[T, Seconds]:
    """Result of some work and its seconds, done once."""
    watch = Stopwatch()
    result = work()
    return result, watch.seconds()


def median_seconds(
    work: Callable[..., T], arguments: Iterable[Any] | None = None, enough: float = SLOW
) -> tuple[T, Seconds]:
    """Result of the first run of some work, and its seconds: one warm-up, then the median of at most five runs.

    No run begins after `enough` wall seconds; the warm-up counts if it takes longer than that. Every run gets the next
    of the `arguments`, if any, whose computation is not timed.
    """
    each = repeat(()) if arguments is None else ((argument,) for argument in arguments)
    result, first = timed(partial(work, *next(each)))
    # Slow work has no warm-up to speak of.
    if first.wall > enough:
        return result, first
    runs: list[Seconds] = []
    while len(runs) < 5 and sum(run.wall for run in runs) < enough:
        runs.append(timed(partial(work, *next(each)))[1])
    return result, median_of(runs)


def median_of(runs: Sequence[Seconds]) -> Seconds:
    """Median CPU and median wall seconds."""
    return Seconds(statistics.median(r.cpu for r in runs), statistics.median(r.wall for r in runs))


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """Interval that contains the median of the distribution of independent values (n,) with probability 0.95.

    Its ends are order statistics, for any distribution (Conover 1999, section 3.2). Fewer than six values give their
    range, which has a smaller probability.
    """
    from scipy.special import bdtr  # noqa: PLC0415  not needed to time anything

    ordered, n = sorted(values), len(values)
    # The number of values below the median is binomial.
    first = max(int(np.searchsorted(bdtr(np.arange(n), n, 0.5), 0.025)) - 1, 0)
    return ordered[first], ordered[n - 1 - first]


class Calibration:
    """Fixed numerical work whose CPU time, relative to a calm machine, measures how much this machine is disturbed.

    Hyperthreads, a shared cache and a lower clock rate slow down all that is timed beside it. Waiting for a core does
    not count: CPU seconds stop meanwhile.
    """

    def __init__(self) -> None:
        self._matrix = np.random.default_rng(0).standard_normal((160, 160))
        self._sorted: list[float] = []
        self.slowdown()

    def slowdown(self) -> float:
        """CPU seconds of the work relative to a calm machine, from all its runs in this process."""
        now = self.seconds().cpu
        insort(self._sorted, now)
        # The lowest 10 % stand for a calm machine: the very best run is luck.
        return now / self._sorted[int(0.1 * len(self._sorted))]

    def seconds(self) -> Seconds:
        """Seconds of the quicker of two runs."""
        runs = [timed(self._work)[1] for _ in range(2)]
        return Seconds(min(run.cpu for run in runs), min(run.wall for run in runs))

    def _work(self) -> float:
        """Dense products, whose time is that of BLAS, and a loop of small calls, whose time is that of Python."""
        product, total = self._matrix, 0.0
        for _ in range(4):
            product = self._matrix @ product
            product = product / np.abs(product).max()
        for row in self._matrix:
            total += float(row @ row)
        return total


def is_disturbed(slowdown: float) -> bool:
    """Whether a slowdown of the calibration marks a row as disturbed."""
    return slowdown > 1.3


@cache
def calibration() -> Calibration:
    """The calibration of this process."""
    return Calibration()
