"""Seconds: CPU seconds of the process and of children that it waited for, wall seconds beside them."""

from __future__ import annotations

import statistics
from bisect import insort
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import repeat
from resource import RUSAGE_CHILDREN, getrusage
from time import perf_counter, process_time  # bound before plugins are imported, which may replace those of `time`
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

REPEATS = 5
"""Timed repeats after one warm-up; the median counts."""

SLOW = 1.0
"""Seconds of repeats after which there are no more; what takes longer is timed once."""

DISTURBED = 1.3
"""A row is marked as disturbed if the calibration is slower than when the machine is calm by more than this factor."""

CALM = 0.1
"""Share of the runs of the calibration that are taken for those of a calm machine: the very best one is luck."""

WAITED = 1.5
"""Wall seconds above this multiple of the CPU seconds are those of a process that often waits for a core."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")
"""Environment in which numerical libraries start with one thread."""

KEPT_MEMORY = {
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "MALLOC_TRIM_THRESHOLD_": "1073741824",
    "MALLOC_TOP_PAD_": "67108864",
}
"""Environment in which glibc keeps up to 1 GiB that was freed: large arrays are not mapped page by page every time."""


@dataclass(frozen=True)
class Seconds:
    """CPU and wall seconds of some work."""

    cpu: float = 0.0
    wall: float = 0.0

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.cpu + other.cpu, self.wall + other.wall)

    def beyond(self, other: Seconds) -> Seconds:
        """The seconds by which these exceed others, not less than nothing."""
        return Seconds(max(self.cpu - other.cpu, 0.0), max(self.wall - other.wall, 0.0))


NO_TIME = Seconds()


class Stopwatch:
    """Seconds since it was made: those of all threads of the process, and of children that have ended.

    Whoever works in a thread or in a child process works no less. A child that outlives the work is not counted; the
    wall seconds then exceed the CPU seconds.
    """

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
    work: Callable[..., T], given: Iterable[Any] | None = None, enough: float = SLOW
) -> tuple[T, Seconds]:
    """Result of the first run of some work, and its seconds: one warm-up, then the median of at most `REPEATS` repeats.

    Repeats end after `enough` wall seconds; the warm-up counts if it takes longer than that. Every run gets another of
    the arguments `given`, or none; what it takes to make them is not timed.
    """
    arguments = repeat(()) if given is None else ((argument,) for argument in given)

    def once() -> tuple[T, Seconds]:
        return timed(partial(work, *next(arguments)))

    result, first = once()
    if first.wall > enough:
        return result, first
    runs: list[Seconds] = []
    while len(runs) < REPEATS and sum(run.wall for run in runs) < enough:
        runs.append(once()[1])
    return result, median_of(runs)


def median_of(runs: Sequence[Seconds]) -> Seconds:
    """Median CPU and median wall seconds."""
    return Seconds(statistics.median(r.cpu for r in runs), statistics.median(r.wall for r in runs))


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """Interval that contains the median of the distribution of independent values (n,) with probability 0.95.

    Its ends are order statistics, whatever the distribution is (Conover 1999, section 3.2); fewer than six values give
    their range, which has a smaller probability.
    """
    ordered, n = sorted(values), len(values)
    outside, below = 0, 0.0  # values left out on each side; probability that the median is among or below them
    ways, every = 1, 2**n  # to choose as many values, of any number: each follows from the one before
    while (below := below + ways / every) <= 0.025:
        ways = ways * (n - outside) // (outside + 1)
        outside += 1
    first = max(outside - 1, 0)
    return ordered[first], ordered[n - 1 - first]


class Calibration:
    """Fixed numerical work whose CPU time, relative to that on a calm machine, measures how much this one is disturbed.

    Other processes on the core, a shared cache and a lower clock rate slow down all that is timed beside it. That a
    process waits for a core does not: its CPU seconds stop meanwhile.
    """

    def __init__(self) -> None:
        self._matrix = np.random.default_rng(0).standard_normal((160, 160))
        self._sorted: list[float] = []
        self.slowdown()

    def slowdown(self) -> float:
        """CPU seconds of the work, the quicker of two runs, over the lowest `CALM` of all in this process so far."""
        now = self.seconds().cpu
        insort(self._sorted, now)
        return now / self._sorted[int(CALM * len(self._sorted))]

    def seconds(self) -> Seconds:
        """Seconds of the work, the quicker of two runs."""
        runs = [timed(self._work)[1] for _ in range(2)]
        return Seconds(min(run.cpu for run in runs), min(run.wall for run in runs))

    def _work(self) -> float:
        """Dense products, as BLAS does them, and a loop of small calls, as Python does."""
        product, total = self._matrix, 0.0
        for _ in range(4):
            product = self._matrix @ product
            product = product / np.abs(product).max()
        for row in self._matrix:
            total += float(row @ row)
        return total


@cache
def calibration() -> Calibration:
    """The calibration of this process."""
    return Calibration()
