"""Timing by pytest-benchmark of work that is judged beforehand: what it reached is kept beside its seconds."""

from __future__ import annotations

import math
import time
import tracemalloc
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from vibench.timing import calibration, timed

T = TypeVar("T")

PASSES = 5
"""Passes over all benchmarks, minutes apart: rounds in succession do not see how a machine changes meanwhile."""

MOST, SLOW = 30, 3
"""Rounds of what is quick in one pass; what takes `SLOW` times what there is for all passes is timed in the first."""

SHORTEST = 2e-3
"""Seconds of a round: as many calls as it takes."""

TRACED = 0.2
"""Seconds up to which the peak of the memory is traced, in a run of its own: tracing slows down."""

Info = Mapping[str, Any]
"""What is kept of a benchmark: figures of its size; under "accuracy", those that should be small."""

MARKS = [
    pytest.mark.benchmark(timer=time.process_time),  # CPU seconds: whoever else uses the machine counts less
    pytest.mark.filterwarnings("default", "ignore:Benchmark fixture was not used"),  # plugins may warn, or fail
]
"""For `pytestmark` of every file of benchmarks."""


def measure(
    benchmark: BenchmarkFixture,
    group: str,
    work: Callable[..., T],
    judge: Callable[[T], Info],
    fresh: Callable[[], Any] | None = None,
    together: int = 1,
) -> None:
    """Do some work once to judge it, then, timed, as often as fits into `--benchmark-max-time`, within limits.

    That time is for all passes. The first one judges; later ones only time, and not what is slow.

    Parameters
    ----------
    benchmark
        The fixture.
    group
        The table to list it in.
    work
        What is timed.
    judge
        What a result has reached; if it raises, nothing is timed.
    fresh
        Gives, untimed, a new argument of `work` for every round, where it takes one.
    together
        How many calls in succession make a round, because each does something else.
    """
    given = (lambda: (fresh(),)) if fresh else tuple
    budget = float(benchmark._max_time)
    result, first = timed(lambda: work(*given()))
    seconds = first.wall
    benchmark.group = group
    if benchmark.extra_info["pass"] == 0:
        benchmark.extra_info.update(plain(judge(result)))
        if seconds <= TRACED:
            benchmark.extra_info["peak_memory_mib"] = peak_memory(work, given())
        if first.cpu < SLOW * budget:
            again = timed(lambda: work(*given()))[1]  # the first call may have imported something
            first, seconds = again, min(seconds, again.wall)
        benchmark.extra_info["slow"] = first.cpu >= SLOW * budget
    rounds, calls = _how_often(seconds, budget / PASSES, together)
    before = calibration().seconds().cpu
    if fresh:
        benchmark.pedantic(work, setup=lambda: (given(), {}), rounds=rounds)  # type: ignore[no-untyped-call]
    else:
        benchmark.pedantic(work, rounds=rounds, iterations=calls)  # type: ignore[no-untyped-call]
    benchmark.extra_info["calibration_s"] = (before + calibration().seconds().cpu) / 2.0


def _how_often(seconds: float, budget: float, together: int) -> tuple[int, int]:
    """Rounds, and calls in each, for work that takes some seconds."""
    seconds = max(seconds, 1e-7)
    calls = together * math.ceil(SHORTEST / (together * seconds))
    if calls * seconds > budget:
        calls = 1
    return min(MOST, max(1, int(budget / (calls * seconds)))), calls


def peak_memory(work: Callable[..., object], given: tuple[Any, ...]) -> float:
    """MiB that Python and NumPy have allocated at most for some work."""
    tracemalloc.start()
    try:
        work(*given)
        return tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()


def plain(value: Any) -> Any:
    """What JSON can hold: NumPy's numbers become Python's, those that are not finite become nothing."""
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, str | bool | None):
        return value
    number = value.item() if hasattr(value, "item") else value
    return number if math.isfinite(number) else None
