"""The pytest plugin of the benchmarks: their options, what they are made of, and the machine they ran on."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any

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
    group.addoption("--progress", type=int, default=None, help="descriptor to write a line to for every benchmark")


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
    """Leave out benchmarks in which no chosen plugin takes part."""
    chosen: Chosen = config.getoption("chosen")
    if chosen:
        items[:] = [item for item in items if _kinds(item) & chosen.keys()]


def _kinds(item: pytest.Item) -> set[str]:
    return {KINDS[name] for name in _parameters(item) if name in KINDS}


def _parameters(item: Any) -> Mapping[str, Any]:
    call = getattr(item, "callspec", None)
    return {} if call is None else dict(call.params)


@cache
def _setting(config: pytest.Config) -> Setting:
    return setting(config.getoption("study"))


@pytest.hookimpl
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Tell whoever started the benchmarks how one of them ended, in a line of JSON."""
    if _Progress.descriptor is not None and (report.when == "call" or report.outcome != "passed"):
        line = {"name": plain_name(report.nodeid), "outcome": report.outcome, "reason": _reason(report)}
        os.write(_Progress.descriptor, json.dumps(line).encode() + b"\n")


class _Progress:
    """Where the progress of this process is written; a report does not know its configuration."""

    descriptor: int | None = None


def pytest_collection_finish(session: pytest.Session) -> None:
    """Tell how many benchmarks there are."""
    _Progress.descriptor = session.config.getoption("progress")
    if _Progress.descriptor is not None:
        os.write(_Progress.descriptor, json.dumps({"count": len(session.items)}).encode() + b"\n")


def _reason(report: pytest.TestReport) -> str:
    """Why a benchmark failed or was left out."""
    told = report.longrepr
    if isinstance(told, tuple):
        return str(told[2]).removeprefix("Skipped: ")
    crash = getattr(told, "reprcrash", None)
    return str(crash.message if crash is not None else told or "").strip().removeprefix("Failed: ")


def plain_name(fullname: str) -> str:
    """Name of a benchmark without the file and what every function begins with."""
    return fullname.rsplit("::", 1)[-1].removeprefix("test_")


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
def axes(request: pytest.FixtureRequest, benchmark: Any) -> None:
    """Keep what a benchmark is about beside its seconds."""
    benchmark.extra_info["axes"] = {name: str(value) for name, value in _parameters(request.node).items()}


@pytest.hookimpl(optionalhook=True)
def pytest_benchmark_update_machine_info(config: pytest.Config, machine_info: dict[str, Any]) -> None:  # noqa: ARG001  a hook's arguments have fixed names
    """Say where the benchmarks were timed."""
    machine_info["vibench"] = {
        "machine": provenance.machine(),
        "libraries": provenance.libraries(),
        "code": provenance.core_code(),
    }
