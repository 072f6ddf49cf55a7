"""Plugins on the axes of a study: registered ones, and classes or objects passed in Python, with their fingerprints."""

from __future__ import annotations

import copy
import functools
import hashlib
import io
import json
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from types import CodeType, FunctionType, GetSetDescriptorType, MemberDescriptorType, ModuleType
from typing import Any

import cloudpickle

from vibench.errors import RequestError, foreign, message_of
from vibench.plugins.kinds import PluginKind
from vibench.plugins.options import named_path, options_as_json
from vibench.plugins.reads import states
from vibench.plugins.registry import RegisteredPlugin, find
from vibench.provenance import distribution_version, package_hash


@dataclass(frozen=True)
class Plugin:
    """A plugin with its options; places of files are not part of its identity."""

    kind: PluginKind
    name: str
    options: str  # canonical JSON
    code: str  # version of its code, with a digest of the files that its options name
    places: str = field(default="{}", compare=False)  # absolute paths of these, as JSON by option

    def __post_init__(self) -> None:
        # The kind is a text in a results file.
        object.__setattr__(self, "kind", PluginKind(self.kind))

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'"

    def __reduce__(self) -> Any:
        # Worker processes receive a given class or object with it. No field holds it, so that no file ever does.
        given = self.registered if self.is_given else None
        return _received, (self.kind, self.name, self.options, self.code, self.places, given)

    @classmethod
    def of(cls, entry: RegisteredPlugin, options: Mapping[str, Any], places: Mapping[str, str] | None = None) -> Plugin:
        """A registered or given plugin with options; `places` are known paths of files and folders, by option."""
        paths = {name: named_path(value) for name, value in options.items() if name in entry.path_options}
        canonical = entry.canonical_options({**options, **{option: name for option, (name, _) in paths.items()}})
        where = json.dumps({option: place for option, (_, place) in paths.items()} | dict(places or {}))
        return cls(entry.kind, entry.name, canonical, entry.code, where).as_installed()

    @property
    def is_given(self) -> bool:
        return self.code.startswith("object ")

    @property
    def registered(self) -> RegisteredPlugin:
        """The registry entry, or the class or object passed in Python."""
        if not self.is_given:
            return find(self.kind, self.name)
        code = self.code.partition(" data ")[0]
        return _given.get((self.kind, self.name, code)) or GivenPlugin(self.kind, self.name, (), code)

    def as_installed(self) -> Plugin:
        """The plugin with the present version of its code and files; a `RequestError` if it or one of these is gone."""
        data = self.registered.data_digest(self.arguments)
        return replace(self, code=self.registered.code + f" data {data}" * bool(data))

    @property
    def arguments(self) -> dict[str, Any]:
        """Its options, with absolute paths of files and folders."""
        places = json.loads(self.places)
        return {name: places.get(name, value) for name, value in json.loads(self.options).items()}

    @property
    def paths(self) -> dict[str, str]:
        """Names in results of the files and folders in its options, by option."""
        known = self.registered.path_options
        return {name: str(value) for name, value in json.loads(self.options).items() if name in known}

    def moved(self, places: Mapping[str, str]) -> Plugin:
        """The plugin with files and folders at other places, by their names in results."""
        there = {option: places[name] for option, name in self.paths.items() if name in places}
        return replace(self, places=json.dumps(json.loads(self.places) | there))

    def create(self) -> Any:
        return self.registered.create(self.arguments)

    @property
    def check(self) -> str:
        """The command that checks the plugin with these options, or the function for a given one."""
        if self.is_given:
            return "vibench.testing.check"
        options = (f"--option={k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in self.arguments.items())
        return shlex.join(["vibench", "check", f"{self.kind.cli_name}:{self.name}", *options])


@dataclass(frozen=True)
class GivenPlugin(RegisteredPlugin):
    """A class or an object passed to a study in Python; known only to that process and to its workers."""

    fingerprint: str = ""  # "object " and the hash of its code and state
    pickled: bytes = b""  # by cloudpickle; empty where only another process has it
    # States of what it reads when it is first used, by its options.
    reads: dict[str, dict[str, str]] = field(default_factory=dict, compare=False)

    def __reduce__(self) -> Any:
        return GivenPlugin, (self.kind, self.name, (), self.fingerprint, self.pickled, self.reads)

    @cached_property
    def given(self) -> Any:
        """The class or the object; a `RequestError` if this process does not have it, or cannot import its modules."""
        if not self.pickled:
            given = f"the {self} is a class or an object that a study was given in another process"
            raise RequestError(f"{given}, or before it was edited: run the study again with what it is now")
        with foreign(f"the {self} cannot be received by a worker process", RequestError):
            return cloudpickle.loads(self.pickled)

    @property
    def is_class(self) -> bool:
        return isinstance(self.given, type)

    @cached_property
    def package(self) -> str:
        """Package of its class; "__main__" in a script or a notebook."""
        return str(self.load().__module__).partition(".")[0]

    @cached_property
    def code(self) -> str:
        """Its fingerprint; a `RequestError` if this process does not have it."""
        self.given  # noqa: B018  raises it
        return self.fingerprint

    def load(self) -> Any:
        return self.given if self.is_class else type(self.given)

    def check_options(self, given: Mapping[str, Any]) -> dict[str, Any]:
        if self.is_class:
            return super().check_options(given)
        if given:
            raise RequestError(f"the {self} is an object, whose options are chosen: give its class with options")
        return {}

    def data_digest(self, options: Mapping[str, Any]) -> str:
        # An object has read its files already.
        own = super().data_digest(options) if self.is_class else ""
        read = states(self.reads.get(options_as_json(options), ()))
        return f"{own} {hashlib.sha256(str(read).encode()).hexdigest()[:16]}".strip() if read else own

    def create(self, options: Mapping[str, Any]) -> Any:
        return super().create(options) if self.is_class else copy.deepcopy(self.given)


# Classes and objects given in this process or received by it, by kind, name and fingerprint.
_given: dict[tuple[str, str, str], GivenPlugin] = {}


def give(kind: PluginKind, name: str, given: Any) -> GivenPlugin:
    """Register a class or an object in its present state as a plugin; a `RequestError` if it cannot be sent."""
    cls, base = given if isinstance(given, type) else type(given), kind.base
    assert base is not None  # plugins of the axes are classes
    if not issubclass(cls, base):
        instead = f"the class {cls.__name__}" if given is cls else f"a {cls.__name__}"
        expected = f"a name, or a class or an object of vibench.{base.__name__}"
        raise RequestError(f"{kind}: expected {expected}, found {instead}")
    try:
        # The study is of the present state of the object, even if the user changes it before the run.
        snapshot = given
        if given is not cls:
            bare: Any = copy.copy(given)
            # Values of cached properties are computed again.
            for one in [one for one in getattr(bare, "__dict__", ()) if is_cached(cls, one)]:
                del bare.__dict__[one]
            snapshot = copy.deepcopy(bare)
        _Pickler(file := io.BytesIO()).dump(snapshot)
        code = fingerprint_of([snapshot, {one: distribution_version(one) for one in getattr(cls, "requires", ())}])
    except Exception as error:  # noqa: BLE001  pickling runs third-party code
        why = f"the {kind} '{name}' cannot be sent to worker processes: {message_of(error)}"
        advice = "keep such objects out of attributes and global names, or make them where they are used"
        raise RequestError(f"{why}; {advice}") from None
    plugin = GivenPlugin(kind, name, (), f"object {code}", file.getvalue())
    # Keep the original: unpickled here, a class of a notebook would lose its global names.
    plugin.__dict__["given"] = snapshot
    return _given.setdefault((kind, name, plugin.fingerprint), plugin)


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    """Cloudpickle for functions and properties that `functools.cache` and `cached_property` decorate, too."""

    def reducer_override(self, obj: Any) -> Any:
        # Cloudpickle takes functions of scripts by value, but not their caches.
        if isinstance(obj, functools._lru_cache_wrapper) and not is_importable(obj):
            return _cached, (obj.__wrapped__, obj.cache_parameters())
        # In Python 3.11 it has a lock, which cannot be pickled.
        if isinstance(obj, cached_property):
            return _computed_once, (obj.func, obj.attrname)
        return super().reducer_override(obj)


def _cached(function: Callable[..., Any], parameters: Mapping[str, Any]) -> Any:
    return functools.lru_cache(**parameters)(function)


def _computed_once(function: Callable[[Any], Any], name: str) -> Any:
    cached = cached_property(function)
    cached.__set_name__(object, name)
    return cached


def _received(kind: PluginKind, name: str, options: str, code: str, places: str, given: GivenPlugin | None) -> Plugin:
    """A plugin that was pickled, with its class or object if it is a given one."""
    if given is not None:
        _given.setdefault((kind, name, given.fingerprint), given).reads.update(given.reads)
    return Plugin(kind, name, options, code, places)


def fingerprint_of(value: Any) -> str:
    """Hash of a value and of its code, equal in all processes that make it in the same way."""
    # Functions and classes of scripts and notebooks count with their bytecode and the global names that occur in it,
    # those of modules with the `module_version`. Values of cached properties do not count.
    return _hash_of(value, {})


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
    """The global names that occur in a function, with their values."""
    code = [function.__code__]
    for part in code:
        code += [one for one in part.co_consts if isinstance(one, CodeType)]
    # Names in nested functions and comprehensions count as well.
    names = {name for part in code for name in part.co_names}
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
    """Version of the package of a module if it is installed and has one, else the hash of its sources."""
    # It is "" for modules of Python and of vibench, whose versions are recorded anyway.
    source, top = getattr(module, "__file__", None), module.__name__.partition(".")[0]
    if source is None or top in ("vibench", *sys.stdlib_module_names):
        return ""
    # A released package is identified by its version, one in development only by its sources.
    installed = {"site-packages", "dist-packages"} & {*Path(source).parts}
    released = getattr(sys.modules.get(top), "__version__", "") if installed else ""
    return str(released or package_hash(module.__name__))
