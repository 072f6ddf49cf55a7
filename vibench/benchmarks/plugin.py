"""The pytest plugin of the benchmarks: their options, what they are made of, and the machine they ran on."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar

import pytest
from threadpoolctl import threadpool_limits

from vibench import provenance
from vibench.benchmarks.cases import (
    DIMENSIONS,
    Case,
    Primal,
    Resolution,
    Setting,
    Size,
    primal_cases,
    problem_cases,
    setting,
    takes_no_option,
)
from vibench.benchmarks.material import Material
from vibench.benchmarks.measure import PASSES
from vibench.benchmarks.passes import plain_name
from vibench.errors import in_a_line
from vibench.qp.solve import installed_solvers
from vibench.study import registry

KINDS: Mapping[str, str] = {
    "case": "problem", "size": "problem", "dual": "dual", "primal": "primal", "solver": "solver",
}  # fmt: skip
"""The word for the kind of plugin (`registry.WORDS`) that an argument of a benchmark is about."""

Chosen = Mapping[str, Sequence[str]]
"""Names of the plugins to time, by the word for their kind; all that are registered where there is none of any kind."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options; `vibench bench` checks what it gives them."""
    group = parser.getgroup("benchmarks of vibench")
    group.addoption("--chosen", type=json.loads, default={}, help="plugins by the word for their kind, as JSON")
    group.addoption("--resolutions", default="coarse", help="names or numbers of nodes, separated by commas")
    group.addoption("--study", default="quick", help="study whose strategies complete what is timed")
    group.addoption("--progress", type=int, default=None, help="descriptor to write a line to for every event")
    group.addoption("--had", type=json.loads, default={}, help="passes of benchmarks that need no other, as JSON")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Make a case of whatever is registered; nothing is loaded that a failure of could stop."""
    config = metafunc.config
    chosen: Chosen = config.getoption("chosen")
    resolutions = [int(name) if name.isdigit() else name for name in config.getoption("resolutions").split(",")]
    axes: dict[str, Callable[[], list[Any]]] = {
        "case": lambda: problem_cases(_problems(chosen, config), resolutions),
        "size": lambda: _sizes(_problems(chosen, config), resolutions),
        "dual": lambda: list(chosen.get("dual", registry.names("dual strategy"))),
        "primal": lambda: [one for one in primal_cases() if one.name in chosen.get("primal", [one.name])],
        "solver": lambda: list(chosen.get("solver", installed_solvers(registry.names("QP solver")))),
    }
    for name, values in axes.items():
        if name in metafunc.fixturenames:
            metafunc.parametrize(name, values(), ids=str)
    metafunc.parametrize("number", range(PASSES), ids="@{}".format)


def _problems(chosen: Chosen, config: pytest.Config) -> Sequence[str]:
    """Those chosen; those of the study, if plugins of other kinds are; otherwise all that need no option."""
    if "problem" in chosen:
        return chosen["problem"]
    return _setting(config).problems if chosen else list(filter(takes_no_option, registry.names("problem")))


def _sizes(problems: Sequence[str], resolutions: Sequence[Resolution]) -> list[Size]:
    """Sizes of reduced programs of every problem at the first resolution that it knows."""
    cases = [problem_cases([problem], resolutions)[0] for problem in problems]
    return [Size(case, N, R) for case in cases for N, R in DIMENSIONS]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out benchmarks in which no chosen plugin takes part; all others once, then all once more, and so on.

    What processes before this one have timed is left out, too.
    """
    chosen: Chosen = config.getoption("chosen")
    had = config.getoption("had")
    kept = [item for item in items if not chosen or _kinds(item) & chosen.keys()]
    left = [item for item in kept if _pass(item) >= had.get(plain_name(item.nodeid), 0)]
    items[:] = sorted(left, key=_pass)


def _pass(item: pytest.Item) -> int:
    return int(_parameters(item)["number"])


def _kinds(item: pytest.Item) -> set[str]:
    return {KINDS[name] for name in _parameters(item) if name in KINDS}


def _parameters(item: Any) -> Mapping[str, Any]:
    call = getattr(item, "callspec", None)
    return {} if call is None else dict(call.params)


@cache
def _setting(config: pytest.Config) -> Setting:
    return setting(config.getoption("study"))


class _Session:
    """What the hooks of this process have in common, some of which do not know its configuration.

    `progress` is the descriptor to write to; `done` has the benchmarks that need no other pass.
    """

    progress: int | None = None
    done: ClassVar[set[str]] = set()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Tell how many benchmarks there are in a pass, and what the file says of the machine."""
    config = session.config
    _Session.progress = config.getoption("progress")
    if not config.getoption("had"):
        _tell({"count": len(session.items) // PASSES, "passes": PASSES, "file": _empty_file(config)})


def _empty_file(config: pytest.Config) -> dict[str, Any]:
    """The file of pytest-benchmark, without any benchmark."""
    hook = config.hook
    machine = hook.pytest_benchmark_generate_machine_info(config=config)
    hook.pytest_benchmark_update_machine_info(config=config, machine_info=machine)
    commit = hook.pytest_benchmark_generate_commit_info(config=config)
    found: dict[str, Any] = hook.pytest_benchmark_generate_json(
        config=config, benchmarks=[], include_data=True, machine_info=machine, commit_info=commit
    )
    return found


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out what failed, was left out, or is slow in a pass before; tell what begins."""
    name = plain_name(item.nodeid)
    if name in _Session.done:
        pytest.skip("one pass is enough")
    _tell({"begun": name})


def pytest_keyboard_interrupt(excinfo: pytest.ExceptionInfo[BaseException]) -> None:
    """Tell what ends this process: a plugin may raise what only Ctrl-C should."""
    _tell({"stopped": in_a_line(excinfo.value)})


def pytest_internalerror(excinfo: pytest.ExceptionInfo[BaseException]) -> None:
    """Tell what ends this process."""
    _tell({"stopped": in_a_line(excinfo.value)})


def pytest_sessionfinish(exitstatus: int) -> None:
    """Tell that every benchmark had its turn."""
    if exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED):
        _tell({"finished": True})


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Tell whoever started the benchmarks how one of them ended in its pass."""
    if report.when != "call" and report.outcome == "passed":
        return
    name = plain_name(report.nodeid)
    if name not in _Session.done:
        _tell({"name": name, "outcome": report.outcome, "reason": _reason(report)})
    if report.outcome != "passed":
        _Session.done.add(name)


def _tell(line: Mapping[str, Any]) -> None:
    if _Session.progress is not None:
        os.write(_Session.progress, json.dumps(line, default=str).encode() + b"\n")


def _reason(report: pytest.TestReport) -> str:
    """Why a benchmark failed or was left out."""
    told = report.longrepr
    if isinstance(told, tuple):
        return str(told[2]).removeprefix("Skipped: ")
    crash = getattr(told, "reprcrash", None)
    return str(crash.message if crash is not None else told or "").strip().removeprefix("Failed: ")


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """BLAS on one thread."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def completing(pytestconfig: pytest.Config) -> Primal:
    """The primal strategy of the reduced models whose programs QP solvers are timed on."""
    return _setting(pytestconfig).primal


@pytest.fixture(scope="session")
def materials(pytestconfig: pytest.Config) -> Callable[[Case], Material]:
    """Function that gives the material of a case, the same for all benchmarks."""
    spaces = _setting(pytestconfig).spaces
    return cache(lambda case: Material(case, spaces))


@pytest.fixture
def material(case: Case, materials: Callable[[Case], Material]) -> Material:
    """The material of one case."""
    return materials(case)


@pytest.fixture(autouse=True)
def about(request: pytest.FixtureRequest, benchmark: Any, number: int) -> Iterator[None]:
    """Keep what a benchmark is about beside its seconds, and tell both; what is slow is timed in one pass."""
    parameters = {name: str(value) for name, value in _parameters(request.node).items() if name != "number"}
    benchmark.extra_info.update({"axes": parameters, "pass": number})
    yield
    if benchmark.extra_info.get("slow"):
        _Session.done.add(plain_name(request.node.nodeid))
    if "calibration_s" in benchmark.extra_info:  # the last that is measured
        _tell({"timed": benchmark.stats.as_dict(include_data=True)})


@pytest.hookimpl(optionalhook=True)
def pytest_benchmark_update_machine_info(config: pytest.Config, machine_info: dict[str, Any]) -> None:  # noqa: ARG001  a hook's arguments have fixed names
    """Say where the benchmarks were timed."""
    machine_info["vibench"] = {
        "machine": provenance.machine(),
        "libraries": provenance.libraries(),
        "code": provenance.core_code(),
    }
