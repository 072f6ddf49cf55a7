"""Plugins on the axes of a study: registered ones, and classes or objects passed in Python."""

from __future__ import annotations

import copy
import functools
import io
import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from typing import Any

import cloudpickle

from vibench.errors import RequestError, in_a_line, message_of
from vibench.plugins.fingerprint import fingerprint_of, is_cached, is_importable, module_version
from vibench.plugins.kinds import PluginKind
from vibench.plugins.options import named_path
from vibench.plugins.registry import RegisteredPlugin, find
from vibench.provenance import distribution_version


@dataclass(frozen=True)
class Plugin:
    """A plugin with its `options` as canonical JSON.

    `code` is the version of its code, with a digest of the files that its options name. `places` are the absolute paths
    of these files and folders, as JSON by option; they are not part of the identity.
    """

    kind: PluginKind
    name: str
    options: str
    code: str
    places: str = field(default="{}", compare=False)

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
    def of(
        cls, registered: RegisteredPlugin, options: Mapping[str, Any], places: Mapping[str, str] | None = None
    ) -> Plugin:
        """A registered or given plugin with options; `places` are known paths of files and folders, by option."""
        paths = {name: named_path(value) for name, value in options.items() if name in registered.path_options}
        canonical = registered.canonical_options({**options, **{option: name for option, (name, _) in paths.items()}})
        where = json.dumps({option: place for option, (_, place) in paths.items()} | dict(places or {}))
        return cls(registered.kind, registered.name, canonical, registered.code, where).as_installed()

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
        """The plugin with the present version of its code and of the files that its options name.

        Raises a `RequestError` if it is not installed, or one of its files cannot be read.
        """
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
        options = (f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in self.arguments.items())
        check = ["vibench", "check", f"{self.kind.cli_name}:{self.name}", *(f"--option={text}" for text in options)]
        return shlex.join(check)


@dataclass(frozen=True)
class GivenPlugin(RegisteredPlugin):
    """A class or an object passed to a study in Python; known only to that process and to its workers.

    `fingerprint` is "object " and the hash of its code and state. `pickled` is the class or the object by cloudpickle,
    empty where only another process has it. `modules` are versions of the modules that it imports, by name.
    """

    fingerprint: str = ""
    pickled: bytes = b""
    modules: Mapping[str, str] = field(default_factory=dict, compare=False)

    def __reduce__(self) -> Any:
        return GivenPlugin, (self.kind, self.name, (), self.fingerprint, self.pickled, self.modules)

    @cached_property
    def given(self) -> Any:
        """The class or the object.

        Raises a `RequestError` if this process has not received it, or cannot import something that it needs.
        """
        if not self.pickled:
            raise RequestError(
                f"the {self} is a class or an object that a study was given in another process, or before it was "
                "edited: run the study again with what it is now"
            )
        try:
            return cloudpickle.loads(self.pickled)
        except Exception as error:  # noqa: BLE001  importing it runs third-party code
            raise RequestError(f"the {self} cannot be received by a worker process: {in_a_line(error)}") from None

    @property
    def is_class(self) -> bool:
        return isinstance(self.given, type)

    @cached_property
    def package(self) -> str:
        """Package of its class; "__main__" in a script or a notebook."""
        return str(self.load().__module__).partition(".")[0]

    @cached_property
    def code(self) -> str:
        """Its fingerprint; another text if a module was edited since."""
        self.given  # noqa: B018  raises if this process does not have it
        edited = (name for name, version in self.modules.items() if module_version(import_module(name)) != version)
        return " ".join([self.fingerprint, *edited])

    def load(self) -> Any:
        return self.given if self.is_class else type(self.given)

    def check_options(self, given: Mapping[str, Any]) -> dict[str, Any]:
        if self.is_class:
            return super().check_options(given)
        if given:
            raise RequestError(f"the {self} is an object, whose options are chosen: give its class with options")
        return {}

    def data_digest(self, options: Mapping[str, Any]) -> str:
        """Digest of the files that a class reads with these options; an object has read its files already."""
        return super().data_digest(options) if self.is_class else ""

    def create(self, options: Mapping[str, Any]) -> Any:
        return super().create(options) if self.is_class else copy.deepcopy(self.given)


_given: dict[tuple[str, str, str], GivenPlugin] = {}
"""Classes and objects given in this process or received by it, by kind, name and fingerprint."""


def give(kind: PluginKind, name: str, given: Any) -> GivenPlugin:
    """Register a class or an object in its present state as a plugin of this process.

    Raises a `RequestError` if it is not of the kind, or cannot be sent to worker processes.
    """
    cls, base = given if isinstance(given, type) else type(given), kind.base
    # Plugins of the axes are classes.
    assert base is not None
    if not issubclass(cls, base):
        instead = f"the class {cls.__name__}" if given is cls else f"a {cls.__name__}"
        raise RequestError(
            f"{kind}: expected a name, or a class or an object of vibench.{base.__name__}, found {instead}"
        )
    try:
        # The study is of the present state of the object, even if the user changes it before the run.
        snapshot = given if given is cls else copy.deepcopy(_without_cache(given))
        _Pickler(file := io.BytesIO()).dump(snapshot)
        needs = {one: distribution_version(one) for one in getattr(cls, "requires", ())}
        code, modules = fingerprint_of([snapshot, needs])
    except Exception as error:  # noqa: BLE001  pickling runs third-party code
        raise RequestError(
            f"the {kind} '{name}' cannot be sent to worker processes: {message_of(error)}; keep such objects out of "
            "attributes and global names, or make them where they are used"
        ) from None
    plugin = GivenPlugin(kind, name, (), f"object {code}", file.getvalue(), modules)
    # Keep the original: unpickled here, a class of a notebook would lose its global names.
    plugin.__dict__["given"] = snapshot
    return _given.setdefault((kind, name, plugin.fingerprint), plugin)


def _without_cache(given: Any) -> Any:
    """A copy of an object without the values of its cached properties."""
    bare = copy.copy(given)
    for name in [*getattr(bare, "__dict__", ())]:
        if is_cached(type(bare), name):
            del bare.__dict__[name]
    return bare


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
        _given.setdefault((kind, name, given.fingerprint), given)
    return Plugin(kind, name, options, code, places)
