"""Running the benchmarks in a watched process on one thread, pass by pass; the file of pytest-benchmark they make."""

from __future__ import annotations

import importlib.util
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from itertools import product
from typing import Any

from vibench import provenance
from vibench.benchmarks.cases import (
    ACCURACIES,
    SIZES,
    PrimalChoice,
    Resolution,
    Setting,
    Size,
    TimedProblem,
    at_resolutions,
    at_tolerances,
    takes_no_option,
)
from vibench.benchmarks.inputs import StageInputs
from vibench.benchmarks.measure import PASSES, TIMER, PassTimes, measure
from vibench.benchmarks.stages import BENCHMARKS, LeftOutError
from vibench.errors import VibenchError
from vibench.execution.watched import WatchedWork, watched
from vibench.qp.solve import installed_solvers
from vibench.stages.base import Failed
from vibench.study.kinds import DUAL, PRIMAL, PROBLEM, SOLVER
from vibench.study.registry import registered


@dataclass(frozen=True)
class Benchmark:
    """One benchmark: what is timed (a key of `BENCHMARKS`), the problem, and the choices of the axes in their order."""

    what: str
    case: TimedProblem
    axes: tuple[tuple[str, str | float | PrimalChoice | Size], ...]

    @property
    def parameters(self) -> str:
        """The problem and the choices in words."""
        chosen = (f"{value:.0e}" if isinstance(value, float) else str(value) for _, value in self.axes)
        return "-".join([str(self.case), *chosen])

    @property
    def name(self) -> str:
        """The name in the file."""
        return f"{self.what}[{self.parameters}]"


def planned(
    chosen: Mapping[str, Sequence[str]], resolutions: Sequence[Resolution], setting: Setting
) -> list[Benchmark]:
    """The benchmarks in which one of the plugins takes part; of all that is registered where none is chosen.

    Parameters
    ----------
    chosen
        Names of plugins by the word for their kind (`kinds.CHECKED`). Problems that are needed and not named are those
        of the setting.
    resolutions
        Resolutions at which problems are timed that know them; QP solvers at the first of these alone.
    setting
        What completes what is timed.
    """
    every = setting.problems if chosen else filter(takes_no_option, registered(PROBLEM))
    cases = [at_resolutions(name, resolutions) for name in chosen.get("problem", every)]
    choices: dict[str, Sequence[Any]] = {
        "size": SIZES,
        "dual": chosen.get("dual", [*registered(DUAL)]),
        "primal": at_tolerances(chosen.get("primal", [*registered(PRIMAL)])),
        "solver": chosen.get("solver", installed_solvers(registered(SOLVER))),
        "accuracy": ACCURACIES,
    }
    benchmarks = []
    for what, function in BENCHMARKS.items():
        axes = [*inspect.signature(function).parameters][1:]
        if chosen and not chosen.keys() & {"problem", *axes}:
            continue
        for known in cases:
            for case, values in product(known[: 1 if "size" in axes else None], product(*(choices[a] for a in axes))):
                benchmarks.append(Benchmark(what, case, tuple(zip(axes, values, strict=True))))
    return benchmarks


@dataclass(frozen=True)
class Turn:
    """What came of one pass of a benchmark: its times, or why there are none; neither where it needs no other pass."""

    name: str
    number: int
    times: PassTimes | None = None
    failed: str = ""
    left_out: str = ""


@dataclass(frozen=True)
class TimedBenchmarks(WatchedWork):
    """All benchmarks once, then all once more, and so on; `seconds` are for each of them, about."""

    label = "benchmarks"

    benchmarks: tuple[Benchmark, ...]
    setting: Setting
    seconds: float

    @property
    def pieces(self) -> int:
        """Number of turns."""
        return PASSES * len(self.benchmarks)

    @cached_property
    def _inputs(self) -> dict[TimedProblem, StageInputs]:
        return {one.case: StageInputs(one.case, self.setting) for one in self.benchmarks}

    def do(self, number: int, done: Mapping[int, Turn]) -> Turn:
        """One pass of a benchmark, unless an earlier one failed, was left out or is enough."""
        count = len(self.benchmarks)
        benchmark, turn = self.benchmarks[number % count], number // count
        earlier = [done[k].times for k in range(number % count, number, count)]
        if any(times is None or times.slow for times in earlier):
            return Turn(benchmark.name, turn)
        try:
            timing = BENCHMARKS[benchmark.what](self._inputs[benchmark.case], *(value for _, value in benchmark.axes))
            return Turn(benchmark.name, turn, measure(timing, self.seconds, first=not turn))
        except LeftOutError as error:
            return Turn(benchmark.name, turn, left_out=str(error))

    def instead(self, number: int, failed: Failed) -> Turn:
        """Why the benchmark failed."""
        count = len(self.benchmarks)
        return Turn(self.benchmarks[number % count].name, number // count, failed=failed.reason)


class Followed:
    """Tells in a line when a benchmark ends, and when a pass begins."""

    def __init__(self, count: int, show: Callable[[str], None]) -> None:
        self._count, self._show = count, show
        self._pass = 0
        self.told: set[tuple[str, int]] = set()

    def take(self, turn: Turn) -> None:
        """Note how a benchmark ended in its pass."""
        self.told.add((turn.name, turn.number))
        ended = f"[{len({name for name, _ in self.told})}/{self._count}]"
        if turn.failed:
            self._show(f"{ended} failed: {turn.name}: {turn.failed}")
        elif turn.times and not turn.number:
            self._show(f"{ended} {turn.name}")
        elif turn.times and turn.number > self._pass:
            self._pass = turn.number
            self._show(f"pass {self._pass + 1} of {PASSES}")


@dataclass(frozen=True)
class BenchmarkOutcome:
    """What came of the benchmarks: the file of pytest-benchmark, and why some failed or were left out."""

    content: bytes
    failed: Mapping[str, str]
    left_out: Mapping[str, str]


def check_installed() -> None:
    """Refuse to go on without pytest-benchmark, which has the statistics and the format of the file.

    Raises
    ------
    VibenchError
        If it is not installed; the message has the command that installs it.
    """
    if importlib.util.find_spec("pytest_benchmark") is None:
        raise VibenchError("`vibench bench` needs pytest-benchmark: pip install 'vibench[bench]'")


def run_benchmarks(
    benchmarks: Sequence[Benchmark], setting: Setting, seconds: float, show: Callable[[str], None]
) -> BenchmarkOutcome:
    """Run benchmarks, each told to `show` in a line when it ends.

    One that ends its process, or takes longer than a stage of the study may, has failed.

    Raises
    ------
    VibenchError
        If pytest-benchmark is not installed, or no benchmark can be begun.
    """
    check_installed()
    work, followed = TimedBenchmarks(tuple(benchmarks), setting, seconds), Followed(len(benchmarks), show)
    turns = watched(work, setting.seconds, followed.take, in_all=setting.seconds * work.pieces)
    if isinstance(turns, Failed):
        raise VibenchError(f"the process of the benchmarks failed: {turns.reason}")
    for turn in turns:
        if (turn.name, turn.number) not in followed.told:
            followed.take(turn)
    passes: dict[str, list[PassTimes]] = {}
    for turn in turns:
        if turn.times is not None:
            passes.setdefault(turn.name, []).append(turn.times)
    entries = [_entry(one, passes[one.name]) for one in benchmarks if one.name in passes]
    failed = {turn.name: turn.failed for turn in turns if turn.failed}
    content = json.dumps(_described_machine() | {"benchmarks": entries}, indent=4, default=str)
    return BenchmarkOutcome(content.encode(), failed, {turn.name: turn.left_out for turn in turns if turn.left_out})


def _entry(benchmark: Benchmark, passes: Sequence[PassTimes]) -> dict[str, Any]:
    """The entry of a benchmark: its statistics are over the rounds of all passes."""
    axes = {"case": benchmark.case, **dict(benchmark.axes)}
    kept = ("q1", "median", "q3", "rounds")
    several = []
    for one in passes:
        statistics = _statistics(one.seconds)
        several.append({key: statistics[key] for key in kept} | {"calibration_s": one.calibration})
    every = [seconds for one in passes for seconds in one.seconds]
    return {
        "group": passes[0].group,
        "name": f"test_{benchmark.name}",
        "fullname": f"vibench/benchmarks/stages.py::test_{benchmark.name}",
        "params": None,
        "param": benchmark.parameters,
        "extra_info": {
            **passes[0].info,
            "axes": {axis: str(value) for axis, value in axes.items()},
            "passes": several,
        },
        "options": {"timer": TIMER.__name__},
        "stats": {**_statistics(every), "data": every, "iterations": passes[0].calls},
    }


def _statistics(seconds: Sequence[float]) -> dict[str, Any]:
    from pytest_benchmark.stats import Stats  # noqa: PLC0415  it is not installed wherever this module is read

    statistics = Stats()  # type: ignore[no-untyped-call]
    statistics.data.extend(seconds)
    fields: dict[str, Any] = statistics.as_dict()  # type: ignore[no-untyped-call]
    return fields


def _described_machine() -> dict[str, Any]:
    """What a file of pytest-benchmark says beside its benchmarks: where and when they were timed, and what."""
    import pytest_benchmark  # noqa: PLC0415  it is not installed wherever this module is read
    from pytest_benchmark.plugin import pytest_benchmark_generate_machine_info  # noqa: PLC0415  likewise
    from pytest_benchmark.utils import get_commit_info  # noqa: PLC0415  likewise

    own = {
        "machine": provenance.machine(),
        "libraries": provenance.libraries(),
        "code": provenance.core_code(),
    }
    return {
        "machine_info": pytest_benchmark_generate_machine_info() | {"vibench": own},  # type: ignore[no-untyped-call]
        "commit_info": get_commit_info(),  # type: ignore[no-untyped-call]
        "datetime": datetime.now(UTC).isoformat(),
        "version": pytest_benchmark.__version__,
    }
