"""Where numbers come from: machine, versions, and the code that computed them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath

SOLVER_DISTRIBUTIONS = {"highs": "highspy", "proxqp": "proxsuite"}
"""Distributions of the solvers that are not called like their solver."""


@cache
def machine() -> str:
    """The machine as results quote it: processor, cores usable, memory, system."""
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        processor = models[0] if models else processor
    return f"{processor}, {cores()} cores, {memory() / 2**30:.0f} GiB, {platform.system()} {platform.machine()}"


def memory(groups: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> int:
    """Bytes of memory that this process may use: those of the machine, or what its control groups (v2, v1) allow."""
    amounts = [int(os.sysconf("SC_PAGE_SIZE")) * int(os.sysconf("SC_PHYS_PAGES"))]
    for line in groups.read_text().splitlines() if groups.is_file() else ():
        _, controllers, name = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        top, limit = (root / "memory", "memory.limit_in_bytes") if controllers else (root, "memory.max")
        inside = PurePosixPath(name.lstrip("/"))
        for group in (inside, *inside.parents):  # every group above limits, too; "." is the top, as in a container
            with contextlib.suppress(OSError, ValueError):  # no such file, or "max"
                amounts.append(int((top / group / limit).read_text()))
    return min(amounts)


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(solver: str) -> dict[str, str]:
    """Versions of Python, the numerical libraries, vibench and one solver."""
    numerical = {name: distribution_version(name) for name in ("numpy", "scipy", "scikit-fem", "qpsolvers", "vibench")}
    return {"python": platform.python_version(), **numerical, solver: solver_version(solver)}


@cache
def distribution_version(name: str) -> str:
    """Version of an installed distribution, "" where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def solver_distribution(solver: str) -> str:
    """The distribution a QP solver comes in."""
    return SOLVER_DISTRIBUTIONS.get(solver, solver)


@cache
def solver_version(solver: str) -> str:
    """Version of the distribution a QP solver comes in, "" where it is not installed."""
    return distribution_version(solver_distribution(solver))


LIBRARIES = ("numpy", "scipy", "scikit-fem", "qpsolvers", "piqp", "proxsuite")
"""Libraries that numbers are computed with; the solver of a cell and what a plugin needs count with these."""


@cache
def core_code() -> str:
    """Version of vibench with a hash of all its sources."""
    return f"{distribution_version('vibench')} {source_hash(Path(__file__).parent)}"


@cache
def libraries() -> str:
    """Versions of Python and of the libraries that results of stages depend on."""
    installed = [f"{name} {distribution_version(name)}" for name in LIBRARIES]
    return ", ".join([f"python {platform.python_version()}", *installed])


def source_hash(source: Path) -> str:
    """Short hash of a Python source, or of all of them in a folder and below it."""
    content = hashlib.sha256()
    folder = source if source.is_dir() else source.parent
    for path in sorted(source.rglob("*.py")) if source.is_dir() else [source]:
        content.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return content.hexdigest()[:12]


def package_hash(module: str) -> str:
    """Short hash of the sources of the outermost package that holds an imported module, or of a module in none."""
    source = Path(str(sys.modules[module].__file__))
    while (source.parent / "__init__.py").is_file():
        source = source.parent
    return source_hash(source)
