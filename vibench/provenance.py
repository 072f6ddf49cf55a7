"""Where numbers come from: machine, versions, and the code that computed them."""

from __future__ import annotations

import dis
import functools
import hashlib
import os
import platform
import sys
from collections.abc import Iterator
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from operator import attrgetter
from pathlib import Path
from types import CodeType, FunctionType, GetSetDescriptorType, MemberDescriptorType, ModuleType
from typing import Any

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
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{processor}, {cores()} cores, {memory:.0f} GiB, {platform.system()} {platform.machine()}"


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(solver: str) -> dict[str, str]:
    """Versions of Python, the numerical libraries, vibench and one solver."""
    found = {name: distribution_version(name) for name in ("numpy", "scipy", "scikit-fem", "qpsolvers", "vibench")}
    return {"python": platform.python_version(), **found, solver: solver_version(solver)}


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
    found = [f"{name} {distribution_version(name)}" for name in LIBRARIES]
    return ", ".join([f"python {platform.python_version()}", *found])


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


def fingerprint(value: Any) -> tuple[str, dict[str, str]]:
    """Hash of a value and of the code that it runs, equal in all processes that make it in the same way.

    Functions and classes of scripts and notebooks count with their bytecode and the global names that it uses, those of
    modules with the `module_version`. What is computed again when it is asked for (`functools.cached_property`) does
    not count.

    Returns
    -------
    hash, modules
        The hash, and the versions of the modules that it names.

    Raises
    ------
    TypeError
        If it holds something that cannot be pickled.
    """
    met: dict[int, tuple[int, Any]] = {}
    found = _fingerprint(value, met)
    modules = [one for _, one in met.values() if isinstance(one, ModuleType)]
    return found, {one.__name__: version for one in modules if (version := module_version(one))}


def _fingerprint(value: Any, met: dict[int, tuple[int, Any]]) -> str:
    """The same within a value; what was met before is named by its number, and kept, since identities are reused."""
    if type(value) in (type(None), bool, int, float, complex, str, bytes):
        words = [repr(value)]
    elif type(value) in (set, frozenset):
        words = sorted(_fingerprint(one, dict(met)) for one in value)
    elif not isinstance(value, tuple) and id(value) in met:
        words = [f"again {met[id(value)][0]}"]
    else:
        met[id(value)] = len(met), value
        if type(value) is dict:
            keys = {_fingerprint(key, dict(met)): key for key in value}
            words = [word for name in sorted(keys) for word in (name, _fingerprint(value[keys[name]], met))]
        else:
            words = [part if k == 0 else _fingerprint(part, met) for k, part in enumerate(_parts(value))]
    return hashlib.sha256("\0".join([type(value).__name__, *words]).encode()).hexdigest()[:16]


def _parts(value: Any) -> Iterator[Any]:
    """What a value is, in words, and what it consists of."""
    if isinstance(value, ModuleType):
        yield f"{value.__name__} {module_version(value)}"
    elif isinstance(value, type | FunctionType) and is_importable(value):
        yield from (value.__qualname__, sys.modules[value.__module__])
    elif isinstance(value, FunctionType):
        used = {name: value.__globals__[name] for name in _globals(value.__code__) if name in value.__globals__}
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        yield from ("", value.__code__, value.__defaults__, value.__kwdefaults__, cells, used)
    elif isinstance(value, CodeType):
        yield f"{value.co_argcount} {value.co_posonlyargcount} {value.co_kwonlyargcount} {value.co_flags}"
        yield from (value.co_code, value.co_consts, value.co_names, value.co_varnames, value.co_freevars)
    elif isinstance(value, type):
        members = {name: member for name, member in vars(value).items() if _counts(name, member)}
        yield from (value.__qualname__, type(value), value.__bases__, members)
    elif isinstance(value, list | tuple) and type(value) in (list, tuple):
        yield from ("", *value)
    elif isinstance(value, property):
        yield from ("", value.fget, value.fset)
    elif isinstance(value, staticmethod | classmethod | functools._lru_cache_wrapper):
        yield from ("", value.__wrapped__)
    elif isinstance(value, cached_property):
        yield from ("", value.func)
    else:
        yield from _pickled_parts(value)


def _pickled_parts(value: Any) -> Iterator[Any]:
    """What pickle would make a value of."""
    reduced = value.__reduce_ex__(4)
    if isinstance(reduced, str):
        yield from (reduced, sys.modules.get(str(value.__module__)))
        return
    function, arguments, state, items, pairs = (*reduced, None, None, None)[:5]
    if isinstance(state, dict):
        cached = {
            name for cls in type(value).__mro__ for name, one in vars(cls).items() if type(one) is cached_property
        }
        state = {name: one for name, one in state.items() if name not in cached}
    yield from ("", function, arguments, state, list(items or ()), dict(pairs or ()))


def _globals(code: CodeType) -> set[str]:
    """Global names that a function uses, or one within it."""
    loads = (one for one in dis.get_instructions(code) if one.opname.startswith("LOAD_"))
    names = {str(one.argval) for one in loads if one.opname.endswith(("GLOBAL", "GLOBALS", "NAME"))}
    return names.union(*(_globals(one) for one in code.co_consts if isinstance(one, CodeType)))


def _counts(name: str, member: Any) -> bool:
    """Whether a member of a class is part of its code, and not made by Python."""
    special = name.startswith("__") and name.endswith("__")
    made = isinstance(member, GetSetDescriptorType | MemberDescriptorType) or name == "_abc_impl"
    return not made and (not special or callable(member) or isinstance(member, staticmethod | classmethod))


def is_importable(value: Any) -> bool:
    """Whether another process can import a class or a function by its name."""
    module = sys.modules.get(str(value.__module__))
    if module is None or module.__name__ == "__main__":
        return False
    try:
        return attrgetter(value.__qualname__)(module) is value
    except AttributeError:
        return False


def module_version(module: ModuleType) -> str:
    """Version of the package of a module if it is installed and has one, else the hash of its sources.

    It is "" for modules of Python and of vibench, whose versions are recorded anyway.
    """
    top, source = module.__name__.partition(".")[0], getattr(module, "__file__", None)
    if source is None or top == "vibench" or top in sys.stdlib_module_names:
        return ""
    installed = {"site-packages", "dist-packages"} & {*Path(source).parts}
    released = getattr(sys.modules.get(top), "__version__", "") if installed else ""
    return str(released or package_hash(module.__name__))
