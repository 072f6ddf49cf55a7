"""Fingerprints of classes and objects that a study was given in Python, in place of a distribution's version."""

from __future__ import annotations

import dis
import functools
import hashlib
import sys
from collections.abc import Iterator
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from types import CodeType, FunctionType, GetSetDescriptorType, MemberDescriptorType, ModuleType
from typing import Any

from vibench.provenance import package_hash


def fingerprint_of(value: Any) -> tuple[str, dict[str, str]]:
    """Hash of a value and of its code, equal in all processes that make it in the same way.

    Functions and classes of scripts and notebooks count with their bytecode and the global names that it uses, those of
    modules with the `module_version`. Values of cached properties do not count.

    Returns also the versions of the modules that it uses. Raises a `TypeError` if the value cannot be pickled.
    """
    seen: dict[int, tuple[int, Any]] = {}
    own = _hash_of(value, seen)
    modules = [one for _, one in seen.values() if isinstance(one, ModuleType)]
    return own, {one.__name__: version for one in modules if (version := module_version(one))}


def _hash_of(value: Any, seen: dict[int, tuple[int, Any]]) -> str:
    """Hash of a value within another; values `seen` before count with their number."""
    if type(value) in (type(None), bool, int, float, complex, str, bytes):
        words = [repr(value)]
    elif type(value) in (set, frozenset):
        # The order of a set differs between processes, so that its members must not number each other.
        words = sorted(_hash_of(one, dict(seen)) for one in value)
    elif not isinstance(value, tuple) and id(value) in seen:
        words = [f"again {seen[id(value)][0]}"]
    else:
        # Keep the value, too: the identity of a value that is gone is reused.
        seen[id(value)] = len(seen), value
        if type(value) is dict:
            keys = {_hash_of(key, dict(seen)): key for key in value}
            words = [word for name in sorted(keys) for word in (name, _hash_of(value[keys[name]], seen))]
        else:
            words = [part if k == 0 else _hash_of(part, seen) for k, part in enumerate(_parts(value))]
    return hashlib.sha256("\0".join([type(value).__name__, *words]).encode()).hexdigest()[:16]


def _parts(value: Any) -> Iterator[Any]:
    """A value in words, and the values that it consists of."""
    if isinstance(value, property):
        yield from ("", value.fget, value.fset)
    elif isinstance(value, staticmethod | classmethod | functools._lru_cache_wrapper):
        yield from ("", value.__wrapped__)
    elif isinstance(value, cached_property):
        yield from ("", value.func)
    elif isinstance(value, CodeType):
        # Line numbers and names of files are left out: a comment changes no number.
        yield from ("", value.co_code, value.co_consts, value.co_names, value.co_varnames, value.co_freevars)
        yield from (value.co_argcount, value.co_posonlyargcount, value.co_kwonlyargcount, value.co_flags)
    elif isinstance(value, ModuleType):
        yield f"{value.__name__} {module_version(value)}"
    elif isinstance(value, type | FunctionType) and is_importable(value):
        yield from ("", value.__qualname__, sys.modules[value.__module__])
    elif isinstance(value, FunctionType):
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        yield from ("", value.__code__, value.__defaults__, value.__kwdefaults__, cells, _globals(value))
    elif isinstance(value, type):
        members = {name: member for name, member in vars(value).items() if _counts(name, member)}
        yield from (value.__qualname__, type(value), value.__bases__, members)
    elif type(value) in (list, tuple):
        yield from ("", *value)
    else:
        yield from _pickled_parts(value)


def _pickled_parts(value: Any) -> Iterator[Any]:
    """The parts of which pickle would make a value."""
    reduced = value.__reduce_ex__(4)
    if isinstance(reduced, str):
        yield from (reduced, sys.modules.get(getattr(value, "__module__", None) or ""))
        return
    function, arguments, state, items, pairs = (*reduced, None, None, None)[:5]
    if isinstance(state, dict):
        state = {name: one for name, one in state.items() if not is_cached(type(value), name)}
    yield from ("", function, arguments, state, list(items or ()), dict(pairs or ()))


def is_cached(cls: type, name: str) -> bool:
    """Whether an attribute of the objects of a class is the value of a cached property."""
    return isinstance(getattr(cls, name, None), cached_property)


def _globals(function: FunctionType) -> dict[str, Any]:
    """The global names that a function uses, with their values."""
    code = [function.__code__]
    for part in code:
        code += [one for one in part.co_consts if isinstance(one, CodeType)]
    # Names in nested functions and comprehensions count as well.
    loads = (one for part in code for one in dis.get_instructions(part) if one.opname.startswith("LOAD_"))
    names = {str(one.argval) for one in loads if one.opname.endswith(("GLOBAL", "GLOBALS", "NAME"))}
    return {name: function.__globals__[name] for name in names if name in function.__globals__}


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
    source, top = getattr(module, "__file__", None), module.__name__.partition(".")[0]
    if source is None or top in ("vibench", *sys.stdlib_module_names):
        return ""
    # A released package is identified by its version, one in development only by its sources.
    installed = {"site-packages", "dist-packages"} & {*Path(source).parts}
    released = getattr(sys.modules.get(top), "__version__", "") if installed else ""
    return str(released or package_hash(module.__name__))
