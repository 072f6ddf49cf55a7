"""Options of the benchmarks, what they are made of, and the machine they ran on; one thread for BLAS."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import pytest
from threadpoolctl import threadpool_limits

from benchmarks.cases import SIZES, Case, Resolution, knows, primal_cases, problem_cases, takes_no_option
from benchmarks.material import Material
from vibench import provenance
from vibench.errors import RequestError, unknown_name
from vibench.qp.solve import installed_solvers
from vibench.study import registry
from vibench.timing import ONE_THREAD

os.environ.update(ONE_THREAD)  # for libraries that are loaded later; `one_thread` sees to the others

RESOLUTIONS = "coarse,paper"


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("benchmarks of vibench")
    group.addoption("--problems", metavar="NAME,…", help="problems to time; all that are registered by default")
    group.addoption(
        "--resolutions", metavar="NAME,…", default=RESOLUTIONS, help=f"names or numbers of nodes; {RESOLUTIONS}"
    )
    group.addoption("--solvers", metavar="NAME,…", help="QP solvers to time; all that are installed by default")


def pytest_configure(config: pytest.Config) -> None:
    """Refuse what cannot be timed."""
    if config.getoption("dist", "no") != "no":
        raise pytest.UsageError("benchmarks run one after the other: leave out -n and --dist")
    try:
        _problems(config)
        _solvers(config)
        for resolution in _resolutions(config):
            if not any(knows(problem, resolution) for problem in registry.names("problem")):
                raise RequestError(f"no problem has the resolution {resolution!r}")
    except RequestError as error:
        raise pytest.UsageError(str(error)) from None


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Whatever is registered, a case each; nothing is loaded that a failure of could stop."""
    problems = _problems(metafunc.config)
    axes: dict[str, Callable[[], list[Any]]] = {
        "case": lambda: problem_cases(problems, _resolutions(metafunc.config)),
        "dual": lambda: registry.names("dual strategy"),
        "primal": primal_cases,
        "size": lambda: [size for size in SIZES if size.case.problem in problems],
        "solver": lambda: _solvers(metafunc.config),
    }
    for name, values in axes.items():
        if name in metafunc.fixturenames:
            metafunc.parametrize(name, values(), ids=str)


def _problems(config: pytest.Config) -> list[str]:
    return _chosen(config, "problems", "problem", list(filter(takes_no_option, registry.names("problem"))))


def _solvers(config: pytest.Config) -> list[str]:
    return _chosen(config, "solvers", "QP solver", installed_solvers(registry.names("QP solver")))


def _chosen(config: pytest.Config, option: str, kind: str, known: list[str]) -> list[str]:
    given = config.getoption(option)
    if given is None:
        return known
    for name in given.split(","):
        if name not in known:
            raise unknown_name(kind, name, known)
    return list(given.split(","))


def _resolutions(config: pytest.Config) -> list[Resolution]:
    return [int(name) if name.isdigit() else name for name in config.getoption("resolutions").split(",")]


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def materials() -> Callable[[Case], Material]:
    """Function that gives the material of a case, the same for all benchmarks."""
    return cache(Material)


@pytest.fixture
def material(case: Case, materials: Callable[[Case], Material]) -> Material:
    return materials(case)


@pytest.hookimpl(optionalhook=True)
def pytest_benchmark_update_machine_info(config: pytest.Config, machine_info: dict[str, Any]) -> None:
    machine_info["vibench"] = {
        "machine": provenance.machine(),
        "libraries": provenance.libraries(),
        "code": provenance.core_code(),
    }
