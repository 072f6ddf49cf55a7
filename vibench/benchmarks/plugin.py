"""Plugin of pytest for `vibench.benchmarks.stages`: parameters, several passes, and another process.

    pytest -p vibench.benchmarks.plugin --pyargs vibench.benchmarks.stages --plugin NAME --benchmark-json a.json

pytest-benchmark has no passes: rounds in succession do not see how a machine changes within minutes. Everything is
timed once, then once more, and the rounds are put together. A plugin that ends its process costs one benchmark.
"""

from __future__ import annotations

import contextlib
import inspect
import math
import os
import re
import resource
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sized
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from _pytest.runner import runtestprotocol
from pytest_benchmark.stats import Metadata, Stats
from threadpoolctl import threadpool_limits

from vibench import benchmarks, guardian, provenance
from vibench.benchmarks import Timing
from vibench.benchmarks.stages import StageInputs
from vibench.errors import VibenchError, in_a_line, message_of
from vibench.execution.supervisor import manner_of_death
from vibench.study.spec import Limits
from vibench.text import printable
from vibench.timing import calibration, timed

PASSES = 5
Work = Callable[..., Any]
Judge = Callable[[Any], Mapping[str, Any]]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of `vibench bench` that say what is timed."""
    group = parser.getgroup("vibench")
    group.addoption("--plugin", action="append", default=[], help="time this plugin (repeatable); all by default")
    group.addoption("--resolution", action="append", default=[], help="resolution of the problems (repeatable)")
    group.addoption("--study", default="quick", help="study whose strategies complete what is timed")
    group.addoption("--seconds", type=float, default=1.0, help="seconds for each benchmark, about")
    group.addoption("--progress", action="store_true", help="a line on the standard error for every benchmark")


def pytest_configure(config: pytest.Config) -> None:
    """Register the plugin with the state of a session."""
    if config.option.progress:
        # The command prints reasons alone: tracebacks took longer than all that is timed.
        config.option.tbstyle = "no"
    config.pluginmanager.register(Passes(config), "vibench-passes")


class Passes:
    """The benchmarks of a session of pytest, in passes and in another process, which is replaced when it ends."""

    def __init__(self, config: pytest.Config) -> None:
        self._config, option = config, config.option
        self._seconds: float = option.seconds
        try:
            chosen, self._setting = benchmarks.chosen_plugins(option.plugin), benchmarks.setting(option.study)
            resolutions = benchmarks.resolutions(option.resolution or ["coarse"])
            self._cases = partial(benchmarks.cases, chosen=chosen, resolutions=resolutions, setting=self._setting)
        except VibenchError as error:
            raise pytest.UsageError(str(error)) from None
        self._inputs: dict[Any, StageInputs] = {}
        self._timed: dict[str, list[dict[str, Any]]] = {}
        self._failed, self._left_out, self._ended = dict[str, str](), dict[str, str](), set[str]()
        self._items: list[pytest.Item] = []
        self._number = 0

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """A pass of every benchmark is a test; all of a pass come before those of the next one."""
        if "timing" not in metafunc.fixturenames:
            return
        axes = [name for name in inspect.signature(metafunc.function).parameters if name not in ("timing", "inputs")]
        several = self._cases(axes)
        values = [(number, *each) for number in range(PASSES) for each in several]
        names = ["-".join(f"{one:.0e}" if isinstance(one, float) else str(one) for one in each) for each in several]
        ids = [f"{name}-pass{number + 1}" for number in range(PASSES) for name in names]
        metafunc.parametrize(["number", "case", *axes], values, ids=ids)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Sort by passes, and leave out benchmarks that none of the plugins takes part in, and other tests."""
        chosen = [item for item in items if isinstance(_pass(item), int)]
        self._config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
        items[:] = sorted(chosen, key=_pass)

    @pytest.fixture
    def inputs(self, case: Any) -> StageInputs:
        """The inputs of the stages of a problem, made once for all benchmarks."""
        return self._inputs.setdefault(case, StageInputs(case, self._setting))

    @pytest.fixture
    def timing(self, benchmark: Any, inputs: StageInputs, number: int) -> Timing:
        """A function that times some work, whose result the first pass judges; if that raises, nothing is timed."""
        # `fresh` gives a new argument of the work for every round, where it takes one. A round has a call for each of
        # the things that the work does `in_turn`.

        def measure(group: str, work: Work, judge: Judge, fresh: Work | None = None, in_turn: Sized = ()) -> None:
            def once() -> tuple[Any, Any]:
                given = () if fresh is None else (fresh(),)
                return timed(lambda: work(*given))

            result, spent = once()
            seconds, budget = spent.wall, self._seconds
            if not number:
                reached = judge(result)
                benchmark.extra_info |= _plain({"n": inputs.problem.V.dim, "m": inputs.problem.W.dim, **reached})
                # The first call may have imported something.
                if spent.cpu < 3.0 * budget:
                    spent = once()[1]
                    seconds = min(seconds, spent.wall)
                # Slow work is timed in one pass.
                benchmark.extra_info["slow"] = spent.cpu >= 3.0 * budget
            rounds, calls = how_often(seconds, budget / PASSES, max(1, len(in_turn)))
            benchmark.group = group
            before = calibration().seconds().cpu
            if fresh is None:
                benchmark.pedantic(work, rounds=rounds, iterations=calls)
            else:
                benchmark.pedantic(work, setup=lambda: ((fresh(),), {}), rounds=rounds)
            benchmark.extra_info["calibration_s"] = (before + calibration().seconds().cpu) / 2.0

        return measure

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self) -> Generator[None, object, object]:
        """Let a plugin that raises what Ctrl-C does fail its benchmark alone."""
        # pytest would take these for the wish to end the session.
        try:
            return (yield)
        except (KeyboardInterrupt, SystemExit) as error:
            raise RuntimeError(in_a_line(error)) from error

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: Any) -> Generator[None, Any, Any]:
        """Attach to the report of a benchmark its rounds and what it reached, or why it was not timed."""
        report = yield
        if call.excinfo is not None:
            error = call.excinfo.value
            told = isinstance(error, VibenchError | RuntimeError | pytest.skip.Exception)
            report.user_properties.append(("reason", message_of(error) if told else in_a_line(error)))
        benchmark: Any = getattr(item, "funcargs", {}).get("benchmark")
        if report.when == "call" and report.passed and benchmark.stats:
            parameters = item.callspec.params  # type: ignore[attr-defined]
            axes = {name: str(value) for name, value in parameters.items() if name != "number"}
            entry = {"group": benchmark.group, "axes": axes, "data": benchmark.stats.stats.data}
            entry |= {"iterations": benchmark.stats.iterations, "extra_info": benchmark.extra_info}
            report.user_properties.append(("benchmark", entry))
        return report

    def pytest_runtestloop(self, session: pytest.Session) -> bool | None:
        """Run the benchmarks in a forked process; where it ends or hangs, another one goes on behind that benchmark."""
        if self._config.option.collectonly or session.testsfailed:
            return None
        self._items, begun = session.items, 0
        while begun < len(self._items):
            begun = self._serve(begun)
        for reason, count in Counter(self._left_out.values()).items():
            self._tell(f"{count} benchmarks left out: {reason}")
        # An entry with an error is in no file, but lets a file without benchmarks be written.
        self._config._benchmarksession.benchmarks += map(self._entry, {**self._timed, **self._failed})  # type: ignore[attr-defined]
        return True

    def _serve(self, begun: int) -> int:
        """Run the items from one on in a process until it ends; returns the next one."""
        items = self._items
        ours, theirs = Pipe(duplex=False)
        # Ctrl-C on the terminal ends this process, with which the other one ends.
        process, reason, status = guardian.fork(), "", 0
        if not process:
            # With its own copy of this end open, a send would wait for ever if the other process has died.
            ours.close()
            self._work(begun, theirs)
        theirs.close()
        limit = self._setting.seconds
        try:
            while True:
                deadline = limit + time.monotonic() - _queued(process)
                while not ours.poll(1.0):
                    if time.monotonic() - _queued(process) > deadline:
                        raise TimeoutError(f"stopped after {limit:g} s")
                message = ours.recv()
                if isinstance(message, int):
                    begun = message
                else:
                    hook = self._config.hook.pytest_report_from_serializable
                    self._report(hook(config=self._config, data=message), _pass(items[begun]))
        except TimeoutError as error:
            reason = str(error)
        except EOFError:
            pass
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)
            status = os.waitpid(process, 0)[1]
            ours.close()
        # The process ended within this benchmark: the report that it owes is made here.
        if begun < len(items):
            item = items[begun]
            reason = reason or f"the worker process died with {manner_of_death(os.waitstatus_to_exitcode(status))}"
            told: list[tuple[str, object]] = [("reason", reason)]
            lost = pytest.TestReport(item.nodeid, item.location, {}, "failed", reason, "call", user_properties=told)
            self._report(lost, _pass(item))
        return begun + 1

    def _work(self, begun: int, connection: Connection) -> None:
        """Run items and send their reports; this process then ends."""
        items, own, memory = self._items, os.getpid(), int(Limits().memory_gib * 2**30)
        resource.setrlimit(resource.RLIMIT_AS, (memory, resource.getrlimit(resource.RLIMIT_AS)[1]))
        serialised = self._config.hook.pytest_report_to_serializable
        try:
            with threadpool_limits(1):
                for number in range(begun, len(items)):
                    if _name(items[number].nodeid) in self._ended:
                        continue
                    connection.send(number)
                    following = items[number + 1] if number + 1 < len(items) else None
                    for report in runtestprotocol(items[number], log=False, nextitem=following):
                        # A plugin forked: the copy must not speak for this process.
                        if os.getpid() != own:
                            return
                        self._note(report)
                        connection.send(serialised(config=self._config, report=report))
            connection.send(len(items))
        finally:
            os._exit(1)

    def _note(self, report: pytest.TestReport) -> str:
        """Note what comes of a benchmark in a pass; returns the line that tells it, if there is one."""
        name, told = _name(report.nodeid), dict(report.user_properties)
        reason = str(told.get("reason", ""))
        if not report.passed:
            (self._failed if report.failed else self._left_out)[name] = reason
            self._ended.add(name)
            return f"failed: {name}: {reason}" if report.failed else ""
        if isinstance(entry := told.get("benchmark"), dict):
            self._timed.setdefault(name, []).append(entry)
            if entry["extra_info"].pop("slow", False):
                self._ended.add(name)
            return name if len(self._timed[name]) == 1 else ""
        return ""

    def _report(self, report: pytest.TestReport, number: int) -> None:
        """Pass a report of the other process on."""
        if line := self._note(report):
            ended, names = {*self._failed, *self._left_out, *self._timed}, {_name(item.nodeid) for item in self._items}
            self._tell(f"[{len(ended)}/{len(names)}] {line}")
        if number > self._number:
            self._number = number
            self._tell(f"pass {number + 1} of {PASSES}")
        self._config.hook.pytest_runtest_logreport(report=report)

    def _tell(self, line: str) -> None:
        if self._config.option.progress:
            sys.stderr.write(f"{printable(line)}\n")
            sys.stderr.flush()

    def _entry(self, name: str) -> Any:
        """The entry of pytest-benchmark for the rounds of all passes of a benchmark, or for one that failed."""
        passes = self._timed.get(name, [])
        first = passes[0] if passes else {"group": None, "extra_info": {}, "axes": {}}
        several = []
        for one in passes:
            stats = Stats()  # type: ignore[no-untyped-call]
            stats.data.extend(one["data"])
            fields = {field: getattr(stats, field) for field in ("q1", "median", "q3", "rounds")}
            several.append(fields | {"calibration_s": one["extra_info"].pop("calibration_s")})
        extra = {**first["extra_info"], "axes": first["axes"], "passes": several}
        fixture = SimpleNamespace(
            name=f"test_{name}", fullname=f"vibench/benchmarks::test_{name}", param=name.partition("[")[2].rstrip("]"),
            group=first["group"], params=None, extra_info=extra, cprofile_stats=None, has_error=name in self._failed,
        )  # fmt: skip
        entry = Metadata(fixture, first.get("iterations", 1), {"timer": time.process_time})  # type: ignore[no-untyped-call]
        entry.stats.data.extend(seconds for one in passes for seconds in one["data"])
        return entry

    @pytest.hookimpl(optionalhook=True)
    def pytest_benchmark_update_machine_info(self, machine_info: dict[str, Any]) -> None:
        """Add machine, libraries and code as `vibench` names them."""
        own = {"machine": provenance.machine(), "libraries": provenance.libraries(), "code": provenance.core_code()}
        machine_info["vibench"] = own

    @pytest.hookimpl(optionalhook=True)
    def pytest_benchmark_update_json(self, output_json: dict[str, Any]) -> None:
        """Add the reasons of benchmarks that failed."""
        output_json["failed"] = self._failed


def _queued(process: int) -> float:
    """Seconds in which a process waited for a core, through no fault of its work; 0 where the system does not tell."""
    try:
        return int(Path(f"/proc/{process}/schedstat").read_text().split()[1]) / 1e9
    except (OSError, IndexError):
        return 0.0


def _pass(item: pytest.Item) -> Any:
    return item.callspec.params.get("number") if hasattr(item, "callspec") else None


def _name(nodeid: str) -> str:
    """Name of a benchmark without its pass and what all begin with."""
    return re.sub(r"-pass\d+\]$", "]", nodeid.split("::test_", 1)[-1])


def how_often(seconds: float, budget: float, together: int) -> tuple[int, int]:
    """Return the rounds, and the calls in each, of work that takes some seconds."""
    seconds = max(seconds, 1e-7)
    # The timer does not resolve less than rounds of 2 ms.
    calls = together * math.ceil(2e-3 / (together * seconds))
    if calls * seconds > budget:
        calls = 1
    return min(30, max(1, int(budget / (calls * seconds)))), calls


def _plain(value: Any) -> Any:
    """Replace NumPy's numbers by Python's, and those that JSON does not know by nothing."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, str | bool | None):
        return value
    number = value.item() if hasattr(value, "item") else value
    return number if math.isfinite(number) else None
