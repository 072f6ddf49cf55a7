"""A plugin on an axis of a study: one that is registered, or a class or an object that the study was given."""

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
from vibench.plugins.fingerprint import fingerprint_of, is_computed_again, is_importable, module_version
from vibench.plugins.kinds import PluginKind
from vibench.plugins.options import named
from vibench.plugins.registry import RegisteredPlugin, find
from vibench.provenance import distribution_version


@dataclass(frozen=True)
class Plugin:
    """A plugin with its options as canonical JSON, and the version of its code and of the files that these name."""

    kind: PluginKind
    name: str
    options: str
    code: str
    places: str = field(default="{}", compare=False)
    """Where the files and folders are that its options name, absolute, as JSON by option; no part of the identity."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "kind", PluginKind(self.kind))  # a text, where it is read from a results file

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'"

    def __reduce__(self) -> Any:
        """Worker processes get what was given with it; it is part of no field, so that no file ever holds it."""
        given = self.registered if self.code.startswith(GIVEN) else None
        return _received, (self.kind, self.name, self.options, self.code, self.places, given)

    @classmethod
    def of(
        cls, registered: RegisteredPlugin, options: Mapping[str, Any], places: Mapping[str, str] | None = None
    ) -> Plugin:
        """A registered plugin, or a given one, with options; `places` is where those are that were found before."""
        found = {name: named(given) for name, given in options.items() if name in registered.path_options}
        names, where = {name: one[0] for name, one in found.items()}, {name: one[1] for name, one in found.items()}
        canonical = registered.canonical_options({**options, **names})
        return cls(
            registered.kind, registered.name, canonical, registered.code, json.dumps(where | dict(places or {}))
        ).as_installed()

    @property
    def registered(self) -> RegisteredPlugin:
        """What is registered under its name, or was given."""
        code = self.code.partition(DATA)[0]
        if not code.startswith(GIVEN):
            return find(self.kind, self.name)
        return _given.get((self.kind, self.name, code)) or GivenPlugin(self.kind, self.name, (), code)

    def as_installed(self) -> Plugin:
        """The plugin with the version that its code and the files that its options name have now.

        Raises a `RequestError` if it is not installed, or one of its files cannot be read.
        """
        data = self.registered.data_digest(self.arguments)
        return replace(self, code=self.registered.code + f"{DATA}{data}" * bool(data))

    @property
    def arguments(self) -> dict[str, Any]:
        """Its options, with the places of files and folders."""
        places = json.loads(self.places)
        return {name: places.get(name, value) for name, value in json.loads(self.options).items()}

    @property
    def paths(self) -> dict[str, str]:
        """The names under which results know the files and folders that its options name, by option."""
        known = self.registered.path_options
        return {name: str(value) for name, value in json.loads(self.options).items() if name in known}

    def moved(self, places: Mapping[str, str]) -> Plugin:
        """The plugin whose files and folders are at other places, by the names under which results know them."""
        there = {option: places[name] for option, name in self.paths.items() if name in places}
        return replace(self, places=json.dumps(json.loads(self.places) | there))

    def create(self) -> Any:
        """A new instance."""
        return self.registered.create(self.arguments)

    @property
    def check(self) -> str:
        """What checks the plugin with these options: a command, or a function for what was given."""
        if self.code.startswith(GIVEN):
            return "vibench.testing.check"
        options = (f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in self.arguments.items())
        check = ["vibench", "check", f"{self.kind.cli_name}:{self.name}", *(f"--option={text}" for text in options)]
        return shlex.join(check)


DATA = " data "
"""What stands between the version of a plugin's code and that of its files."""

GIVEN = "object "
"""What the code of a given plugin begins with; that of others begins with a distribution and its version."""


@dataclass(frozen=True)
class GivenPlugin(RegisteredPlugin):
    """A class or an object that a study was given in Python.

    Only the process that has made it knows it, and the workers that this process sends it to.
    """

    fingerprint: str = ""
    """`GIVEN` and the hash of its code and state."""
    pickled: bytes = b""
    """The class or the object by cloudpickle; empty where another process was given it."""
    modules: Mapping[str, str] = field(default_factory=dict, compare=False)
    """Versions of the modules that it uses, which are imported and not pickled, by name."""

    def __reduce__(self) -> Any:
        return GivenPlugin, (self.kind, self.name, (), self.fingerprint, self.pickled, self.modules)

    @cached_property
    def given(self) -> Any:
        """The class or the object.

        Raises a `RequestError` if this process neither was given it nor received it, or cannot import what it is made
        of.
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
        """Whether it is a class, whose options a study sets."""
        return isinstance(self.given, type)

    @cached_property
    def package(self) -> str:
        """The package that its class is in, "__main__" of a script or a notebook."""
        return str(self.load().__module__).partition(".")[0]

    @cached_property
    def code(self) -> str:
        """Its fingerprint; another text if a module was edited since it was given."""
        self.given  # noqa: B018  refuses what another process was given
        edited = (name for name, version in self.modules.items() if module_version(import_module(name)) != version)
        return " ".join([self.fingerprint, *edited])

    def load(self) -> Any:
        """The class, be it given or that of the object."""
        return self.given if self.is_class else type(self.given)

    def check_options(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Options of a class, checked; an object has none."""
        if self.is_class:
            return super().check_options(given)
        if given:
            raise RequestError(f"the {self} is an object, whose options are chosen: give its class with options")
        return {}

    def data_digest(self, options: Mapping[str, Any]) -> str:
        """Digest of the files that a class reads with these options; an object has read its own."""
        return super().data_digest(options) if self.is_class else ""

    def create(self, options: Mapping[str, Any]) -> Any:
        """A new instance of the class, or a copy of the object."""
        return super().create(options) if self.is_class else copy.deepcopy(self.given)


_given: dict[tuple[str, str, str], GivenPlugin] = {}
"""What studies of this process were given, or a worker has received, by kind, name and fingerprint."""


def give(kind: PluginKind, name: str, given: Any) -> GivenPlugin:
    """Take a class or an object, as it is now, for a plugin of this process.

    Raises a `RequestError` if it is none of the kind, or cannot be sent to worker processes.
    """
    cls, base = given if isinstance(given, type) else type(given), kind.base
    assert base is not None  # plugins of the axes are classes
    if not issubclass(cls, base):
        instead = f"the class {cls.__name__}" if given is cls else f"a {cls.__name__}"
        raise RequestError(
            f"{kind}: expected a name, or a class or an object of vibench.{base.__name__}, found {instead}"
        )
    try:
        kept = given if given is cls else copy.deepcopy(_without_cache(given))
        _Pickler(file := io.BytesIO()).dump(kept)
        needs = {one: distribution_version(one) for one in getattr(cls, "requires", ())}
        code, modules = fingerprint_of([kept, needs])
    except Exception as error:  # noqa: BLE001  pickling runs third-party code
        raise RequestError(
            f"the {kind} '{name}' cannot be sent to worker processes: {message_of(error)}; keep such objects out of "
            "attributes and global names, or make them where they are used"
        ) from None
    plugin = GivenPlugin(kind, name, (), f"{GIVEN}{code}", file.getvalue(), modules)
    plugin.__dict__["given"] = kept  # unpickled here, a class of a notebook would lose its global names
    return _given.setdefault((kind, name, plugin.fingerprint), plugin)


def _without_cache(given: Any) -> Any:
    """A copy of an object without what it computes again when asked for (`functools.cached_property`)."""
    kept = copy.copy(given)
    for name in [*getattr(kept, "__dict__", ())]:
        if is_computed_again(type(kept), name):
            del kept.__dict__[name]
    return kept


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    """Cloudpickle, which also sends what `functools.cache` and `cached_property` decorate."""

    def reducer_override(self, obj: Any) -> Any:
        """How an object is pickled."""
        if isinstance(obj, functools._lru_cache_wrapper) and not is_importable(obj):
            return _cached, (obj.__wrapped__, obj.cache_parameters())
        if isinstance(obj, cached_property):  # it has a lock in Python 3.11
            return _computed_once, (obj.func, obj.attrname)
        return super().reducer_override(obj)


def _cached(function: Callable[..., Any], parameters: Mapping[str, Any]) -> Any:
    return functools.lru_cache(**parameters)(function)


def _computed_once(function: Callable[[Any], Any], name: str) -> Any:
    made = cached_property(function)
    made.__set_name__(object, name)
    return made


def _received(kind: PluginKind, name: str, options: str, code: str, places: str, given: GivenPlugin | None) -> Plugin:
    """A plugin that was pickled, and what was given with it."""
    if given is not None:
        _given.setdefault((kind, name, given.fingerprint), given)
    return Plugin(kind, name, options, code, places)
