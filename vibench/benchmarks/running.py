"""Which benchmarks there are, and running them in a watched process on one thread, pass by pass."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

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
from vibench.benchmarks.formulations import FORMULATIONS
from vibench.benchmarks.inputs import StageInputs
from vibench.benchmarks.measure import PASSES, PassTimes, Timing, measure
from vibench.benchmarks.offline import OFFLINE
from vibench.benchmarks.online import ONLINE, LeftOutError
from vibench.errors import VibenchError
from vibench.execution.isolated import IsolatedWork, run_isolated
from vibench.plugins.kinds import DUAL, FORMULATION, PRIMAL, PROBLEM, SOLVER
from vibench.plugins.registry import registered
from vibench.qp.solve import installed_solvers
from vibench.qp.status import Status
from vibench.stages.base import Failed

BENCHMARKS: Mapping[str, Callable[..., Timing]] = {
    function.__name__.removeprefix("time_"): function for function in OFFLINE + ONLINE + FORMULATIONS
}
"""What is timed, by the names of the benchmarks."""


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
        """Its name in files and on the terminal."""
        return f"{self.what}[{self.parameters}]"


def planned(
    chosen: Mapping[str, Sequence[str]], resolutions: Sequence[Resolution], setting: Setting
) -> list[Benchmark]:
    """The benchmarks in which one of the plugins takes part; of all that is registered where none is chosen.

    `chosen` has names of plugins by the word for their kind (`kinds.CHECKED`). Problems that are needed and not named
    are those of the setting, which completes what is timed. Problems are timed at those of the resolutions that they
    know, QP solvers at the first of these alone.
    """
    every = setting.problems if chosen else filter(takes_no_option, registered(PROBLEM))
    problems = [at_resolutions(name, resolutions) for name in chosen.get("problem", every)]
    choices: dict[str, Sequence[Any]] = {
        "size": SIZES,
        "dual": chosen.get("dual", [*registered(DUAL)]),
        "primal": at_tolerances(chosen.get("primal", [*registered(PRIMAL)])),
        "formulation": chosen.get("formulation", [*registered(FORMULATION)]),
        "solver": chosen.get("solver", installed_solvers(registered(SOLVER))),
        "accuracy": ACCURACIES,
    }
    benchmarks = []
    for what, function in BENCHMARKS.items():
        axes = [*inspect.signature(function).parameters][1:]
        if chosen and not chosen.keys() & {"problem", *axes}:
            continue
        for cases in problems:
            for case, values in product(cases[: 1 if "size" in axes else None], product(*(choices[a] for a in axes))):
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
class TimedBenchmarks(IsolatedWork):
    """All benchmarks once, then all once more, and so on; `seconds` are for each of them, about."""

    label = "benchmarks"

    benchmarks: tuple[Benchmark, ...]
    setting: Setting
    seconds: float

    @property
    def items(self) -> int:
        """Number of turns."""
        return PASSES * len(self.benchmarks)

    @cached_property
    def _inputs(self) -> dict[TimedProblem, StageInputs]:
        return {one.case: StageInputs(one.case, self.setting) for one in self.benchmarks}

    def do(self, number: int, done: Mapping[int, Turn]) -> Turn:
        """One pass of a benchmark, unless an earlier one failed, was left out or is enough."""
        turn, which = divmod(number, len(self.benchmarks))
        benchmark = self.benchmarks[which]
        earlier = [done[k].times for k in range(which, number, len(self.benchmarks))]
        if any(times is None or times.slow for times in earlier):
            return Turn(benchmark.name, turn)
        inputs = self._inputs[benchmark.case]
        try:
            timing = BENCHMARKS[benchmark.what](inputs, *(value for _, value in benchmark.axes))
        except LeftOutError as error:
            return Turn(benchmark.name, turn, left_out=str(error))
        times = measure(timing, self.seconds, first=not turn)
        return Turn(benchmark.name, turn, times if turn else replace(times, info={**inputs.about(), **times.info}))

    def instead(self, number: int, failed: Failed) -> Turn:
        """Why a benchmark failed."""
        turn, which = divmod(number, len(self.benchmarks))
        late = failed.status is Status.TIMEOUT
        reason = f"stopped after {self.setting.seconds:g} s" if late else failed.reason
        return Turn(self.benchmarks[which].name, turn, failed=reason)


class BenchmarkResults:
    """What comes of benchmarks, each told to `show` in a line when it ends.

    `passes` has those of every benchmark that was timed, by name, `failed` and `left_out` why others were not.
    """

    def __init__(self, count: int, show: Callable[[str], None]) -> None:
        self.passes: dict[str, list[PassTimes]] = {}
        self.failed, self.left_out = dict[str, str](), dict[str, str]()
        self._count, self._show = count, show
        self._ended: set[str] = set()
        self._pass = 0

    def take(self, turn: Turn) -> None:
        """Note how a benchmark ended in its pass."""
        self._ended.add(turn.name)
        ended = f"[{len(self._ended)}/{self._count}]"
        if turn.failed:
            self.failed[turn.name] = turn.failed
            self._show(f"{ended} failed: {turn.name}: {turn.failed}")
        elif turn.left_out:
            self.left_out[turn.name] = turn.left_out
        elif turn.times:
            self.passes.setdefault(turn.name, []).append(turn.times)
            if not turn.number:
                self._show(f"{ended} {turn.name}")
            elif turn.number > self._pass:
                self._pass = turn.number
                self._show(f"pass {self._pass + 1} of {PASSES}")


def check_installed() -> None:
    """Refuse to go on without pytest-benchmark, which has the statistics and the format of the file.

    Raises a `VibenchError` if it is not installed; the message has the command that installs it.
    """
    if importlib.util.find_spec("pytest_benchmark") is None:
        raise VibenchError("`vibench bench` needs pytest-benchmark: pip install 'vibench[bench]'")


def run_benchmarks(
    benchmarks: Sequence[Benchmark], setting: Setting, seconds: float, show: Callable[[str], None]
) -> BenchmarkResults:
    """Run benchmarks; one that ends its process, or takes longer than a stage of the study may, has failed.

    Raises a `VibenchError` if no benchmark can be begun.
    """
    work, results = TimedBenchmarks(tuple(benchmarks), setting, seconds), BenchmarkResults(len(benchmarks), show)
    turns = run_isolated(work, setting.seconds, results.take, in_all=setting.seconds * work.items)
    if isinstance(turns, Failed):
        raise VibenchError(f"the process of the benchmarks failed: {turns.reason}")
    return results
