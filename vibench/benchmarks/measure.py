"""Timing of work that is judged beforehand: what it reached is kept beside its seconds."""

from __future__ import annotations

import math
import time
import tracemalloc
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vibench.timing import calibration, timed

PASSES = 5
"""Passes over all benchmarks, minutes apart: rounds in succession do not see how a machine changes meanwhile."""

MOST, SLOW = 30, 3
"""Rounds of what is quick in one pass; what takes `SLOW` times what there is for all passes is timed in the first."""

SHORTEST = 2e-3
"""Seconds of a round: as many calls as it takes."""

TRACED = 0.2
"""Seconds up to which the peak of the memory is traced, in a run of its own: tracing slows down."""

TIMER = time.process_time
"""CPU seconds: whoever else uses the machine counts less."""

Info = Mapping[str, Any]
"""What is kept of a benchmark: figures of its size; under "accuracy", those that should be small."""


@dataclass(frozen=True)
class Timing:
    """Some work to be timed."""

    group: str
    work: Callable[..., Any]
    """What is timed."""
    judge: Callable[[Any], Info]
    """What a result has reached; if it raises, nothing is timed."""
    fresh: Callable[[], Any] | None = None
    """Gives, untimed, a new argument of `work` for every round, where it takes one."""
    together: int = 1
    """How many calls in succession make a round, because each does something else."""

    def given(self) -> tuple[Any, ...]:
        """The arguments of a call."""
        return () if self.fresh is None else (self.fresh(),)


@dataclass(frozen=True)
class PassTimes:
    """One pass of a benchmark."""

    group: str
    seconds: tuple[float, ...]
    """CPU seconds of a call, for every round."""
    calls: int
    """Calls in a round."""
    calibration: float
    """CPU seconds of fixed work beside it."""
    slow: bool = False
    """Whether one pass is all that it takes."""
    info: Info = field(default_factory=dict)
    """What the first pass has reached."""


def measure(timing: Timing, budget: float, *, first: bool) -> PassTimes:
    """Do some work once, and time it as often as fits into its share of a budget of seconds for all passes.

    The first pass judges; later ones only time, and not what is slow.
    """
    info: dict[str, Any] = {}
    result, once = timed(lambda: timing.work(*timing.given()))
    seconds, slow = once.wall, False
    if first:
        info.update(plain(timing.judge(result)))
        if seconds <= TRACED:
            info["peak_memory_mib"] = peak_memory(timing.work, timing.given())
        if once.cpu < SLOW * budget:
            once = timed(lambda: timing.work(*timing.given()))[1]  # the first call may have imported something
            seconds = min(seconds, once.wall)
        slow = once.cpu >= SLOW * budget
    rounds, calls = _how_often(seconds, budget / PASSES, timing.together)
    calls = 1 if timing.fresh else calls
    before = calibration().seconds().cpu
    times = tuple(_round(timing, calls) for _ in range(rounds))
    return PassTimes(timing.group, times, calls, (before + calibration().seconds().cpu) / 2.0, slow, info)


def _round(timing: Timing, calls: int) -> float:
    """CPU seconds of a call in one round."""
    work, given = timing.work, timing.given()
    begin = TIMER()
    for _ in range(calls):
        work(*given)
    return (TIMER() - begin) / calls


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


def largest_figures(several: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """The largest of every figure, NaN where one is."""
    largest: dict[str, float] = {}
    for figures in several:
        for name, value in figures.items():
            largest[name] = value if math.isnan(value) else max(largest.get(name, value), value)
    return largest
