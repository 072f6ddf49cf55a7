"""Seconds: CPU seconds of the thread that does the work, wall seconds beside them."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")

REPEATS = 5
"""Timed repeats of a query after one warm-up; the median counts."""

SLOW = 1.0
"""A query that takes longer than this many seconds is timed once."""

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Seconds:
    """CPU and wall seconds of some work."""

    cpu: float = 0.0
    wall: float = 0.0

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.cpu + other.cpu, self.wall + other.wall)


NO_TIME = Seconds()


class Stopwatch:
    """Seconds since it was made, counting only the calling thread."""

    def __init__(self) -> None:
        self._cpu, self._wall = time.thread_time(), time.perf_counter()

    def seconds(self) -> Seconds:
        """CPU and wall seconds so far."""
        return Seconds(time.thread_time() - self._cpu, time.perf_counter() - self._wall)


def timed(work: Callable[[], T]) -> tuple[T, Seconds]:
    """Result of some work and its seconds, done once."""
    watch = Stopwatch()
    result = work()
    return result, watch.seconds()


def median_seconds(work: Callable[[], T]) -> tuple[T, Seconds]:
    """Result of some work and its seconds: one warm-up, then the median of `REPEATS`; the first run if it is slow."""
    result, first = timed(work)
    if first.wall > SLOW:
        return result, first
    runs = [timed(work)[1] for _ in range(REPEATS)]
    return result, Seconds(statistics.median(r.cpu for r in runs), statistics.median(r.wall for r in runs))


@contextmanager
def one_thread() -> Iterator[None]:
    """Numerical libraries on one thread in this process and in those started inside."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        with threadpool_limits(1):
            yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
