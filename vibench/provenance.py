"""Provenance of numbers: machine, versions, and the code that computed them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath

# Version of the benchmark protocol, recorded in results; docs/publishing.md has a line for each. It changes with every
# change after which seconds, or the meaning of a number, can no longer be compared with earlier ones.
PROTOCOL = "4"


@cache
def machine() -> str:
    """The machine as recorded in results: processor with its model and caches, usable cores, memory, system."""
    parts = [processor(), *caches(), f"{cores()} cores", f"{memory() / 2**30:.0f} GiB"]
    return ", ".join([*parts, f"{platform.system()} {platform.machine()}"])


def processor(info: Path = Path("/proc/cpuinfo")) -> str:
    """The name of the processor, with family and model: that of virtual machines is one that many processors share."""
    if not info.is_file():
        return platform.processor() or platform.machine()
    first, *_ = info.read_text().split("\n\n")
    fields = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in first.splitlines())}
    name = fields.get("model name", platform.processor() or platform.machine())
    words = {"cpu family": "family", "model": "model"}
    numbers = [f"{word} {fields[key]}" for key, word in words.items() if key in fields]
    return f"{name} ({' '.join(numbers)})" if numbers else name


def caches(folder: Path = Path("/sys/devices/system/cpu/cpu0/cache")) -> list[str]:
    """Sizes of the data caches of one core, "L2 1024K", from the first level to the last; none if unknown."""
    sizes: dict[str, str] = {}
    for index in sorted(folder.glob("index*")):
        with contextlib.suppress(OSError):
            level, kind, size = ((index / name).read_text().strip() for name in ("level", "type", "size"))
            if kind != "Instruction":
                sizes[f"L{level}"] = size
    return [f"{level} {size}" for level, size in sorted(sizes.items())]


def memory(groups: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> int:
    """Bytes of memory that this process may use: of the machine, or the limit of its control groups (v2, v1)."""
    amounts = [int(os.sysconf("SC_PAGE_SIZE")) * int(os.sysconf("SC_PHYS_PAGES"))]
    for line in groups.read_text().splitlines() if groups.is_file() else ():
        _, controllers, name = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        top, limit = (root / "memory", "memory.limit_in_bytes") if controllers else (root, "memory.max")
        inside = PurePosixPath(name.lstrip("/"))
        # Groups above limit it, too; "." is the top group, as seen in a container.
        for group in (inside, *inside.parents):
            # There may be no such file, or it says "max".
            with contextlib.suppress(OSError, ValueError):
                amounts.append(int((top / group / limit).read_text()))
    return min(amounts)


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(solver: str | None) -> dict[str, str]:
    """Versions of the protocol, Python, the numerical libraries, a solver, and vibench: "0.1.0 at 1a2b3c4d5e"."""
    numerical = {name: distribution_version(name) for name in ("numpy", "scipy", "scikit-fem", "qpsolvers", "vibench")}
    numerical["vibench"] += f" at {commit()}" if commit() else ""
    own = {"protocol": PROTOCOL, "python": platform.python_version(), **numerical}
    return own if solver is None else own | {solver: solver_version(solver)}


@cache
def commit(checkout: Path = Path(__file__).parents[1]) -> str:
    """The commit of a checkout, with "+" if tracked code was changed since; "" elsewhere and without git."""
    if not (checkout / ".git").exists():
        return ""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(checkout), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        # Only code counts: pages that a run wrote do not change the commit of the next ones.
        changed = git("diff", "--name-only", "HEAD", "--", "*.py", "*.toml", "*.template")
        return git("rev-parse", "--short=10", "HEAD") + "+" * bool(changed)
    except (OSError, subprocess.CalledProcessError):  # there is no git, or no repository
        return ""


@cache
def distribution_version(name: str) -> str:
    """Version of an installed distribution, "" where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def solver_distribution(solver: str) -> str:
    """The distribution that provides a QP solver."""
    return {"highs": "highspy", "proxqp": "proxsuite"}.get(solver, solver)


@cache
def solver_version(solver: str) -> str:
    """Version of the distribution of a QP solver, "" where it is not installed."""
    return distribution_version(solver_distribution(solver))


@cache
def core_code() -> str:
    """Version of vibench with a hash of all its sources."""
    return f"{distribution_version('vibench')} {source_hash(Path(__file__).parent)}"


LAYERS = (
    "stages", "calibration", "offline", "results.consistency", "results.pictures", "study.parameter_sets", "packs",
    "model", "highfidelity", "stability", "reduction", "qp", "fem", "interfaces", "linalg", "timing", "arrays",
)  # fmt: skip
"""Packages and modules that determine numbers, from top to bottom as in the contracts of import-linter.

All others only ask for numbers, hand them over, record or show them.
"""


@cache
def numerical_code(below: str = "") -> str:
    """Hash of the sources of `LAYERS`, or of those below one of them."""
    content, core = hashlib.sha256(), Path(__file__).parent
    for layer in LAYERS[LAYERS.index(below) + 1 if below else 0 :]:
        folder = core.joinpath(*layer.split("."))
        source = folder if folder.is_dir() else folder.with_suffix(".py")
        content.update(f"{layer} {source_hash(source)}\n".encode())
    return content.hexdigest()[:12]


@cache
def libraries() -> str:
    """Versions of Python and of the libraries that the results of all stages depend on."""
    names = ("numpy", "scipy", "scikit-fem", "qpsolvers", "piqp", "proxsuite")
    installed = [f"{name} {distribution_version(name)}" for name in names]
    return ", ".join([f"python {platform.python_version()}", *installed])


def source_hash(source: Path) -> str:
    """Short hash of a source, or of all sources and templates in a folder and below it."""
    content, is_folder = hashlib.sha256(), source.is_dir()
    folder = source if is_folder else source.parent
    paths = (p for p in source.rglob("*") if p.suffix in (".py", ".template")) if is_folder else (source,)
    for path in sorted(paths):
        content.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return content.hexdigest()[:12]


def package_hash(module: str) -> str:
    """Short hash of the sources of the outermost package that holds an imported module, or of a module in none."""
    source = Path(str(sys.modules[module].__file__))
    while (source.parent / "__init__.py").is_file():
        source = source.parent
    return source_hash(source)
