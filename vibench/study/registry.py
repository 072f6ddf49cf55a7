"""The registry of plugins: entry points, and options checked against the annotations of constructors."""

from __future__ import annotations

import importlib
import inspect
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import EntryPoint
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, get_type_hints

from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

from vibench.errors import RequestError, in_a_line, unknown_name
from vibench.provenance import distribution_version, source_hash
from vibench.qp.settings import SETTINGS
from vibench.qp.verification import QPSolver
from vibench.study.entry_points import entry_points
from vibench.study.kinds import CHECKED, KINDS

GROUPS: Mapping[str, str] = {kind.title: kind.entry_points for kind in KINDS}
"""Groups of entry points by kind of plugin."""

FINITE = ConfigDict(allow_inf_nan=False)
"""Options of plugins are finite."""

BASES: Mapping[str, type] = {kind.title: resolve_name(kind.base) for kind in KINDS if kind.base}
"""Abstract base classes of the kinds of plugins that are classes."""

READERS = ("problem", "sampling strategy")
"""Kinds of plugins that may read files, of which they have a `data_digest`."""

WORDS: Mapping[str, str] = {kind.word: kind.title for kind in CHECKED}
"""Kinds of plugins by their names on the command line."""


@dataclass(frozen=True)
class Option:
    """One option of a plugin: name, expected values in words, default as text ("" if it is required)."""

    name: str
    expected: str
    default: str


def names(kind: str) -> list[str]:
    """Names registered for one kind of plugin, a key of `GROUPS`."""
    return sorted(_registered(kind))


def load(kind: str, name: str) -> Any:
    """The object that a plugin's entry point refers to.

    Raises
    ------
    RequestError
        If no plugin or several have that name, it cannot be imported, or it is not of its kind.
    """
    entry = _entry(kind, name)
    where = f"{kind} '{name}' ({entry.value})"
    try:
        plugin = entry.load()
    except (Exception, SystemExit) as error:  # noqa: BLE001  importing a plugin runs third-party code
        raise RequestError(f"{where} cannot be loaded: {in_a_line(error)}") from None
    base = BASES.get(kind)
    if base is not None and not (isinstance(plugin, type) and issubclass(plugin, base)):
        raise RequestError(f"{where} is not a subclass of {base.__qualname__}")
    if kind == "QP solver" and not callable(plugin):
        raise RequestError(f"{where} is not callable")
    if kind == "study" and not isinstance(plugin, str | Path):
        raise RequestError(f"{where} is not the path of a study file")
    return plugin


def create(kind: str, name: str, options: Mapping[str, Any] | None = None) -> Any:
    """Instance of a plugin, its options checked.

    Parameters
    ----------
    kind
        A key of `BASES`.
    name
        Name under which the plugin is registered.
    options
        Keyword arguments of its constructor.

    Raises
    ------
    RequestError
        If there is no such plugin, or it does not take these options.
    """
    return load(kind, name)(**check_options(kind, name, options or {}))


def reference(kind: str, name: str) -> str:
    """Where a plugin is, "module:attribute"."""
    entry = _entry(kind, name)
    return f"{entry.module}:{entry.attr}"


def version(kind: str, name: str) -> str:
    """Distribution and version a plugin comes from, "vibench 0.1.0"; of a name that several use, all of them."""
    return ", ".join(map(_origin, _registered(kind)[name].entries))


def _origin(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "unknown"


def conflict(kind: str, name: str) -> str:
    """Why a name says too little: who else provides a plugin or a solver of qpsolvers with this name; "" if it is one.

    Nothing of that name is loaded: whichever was meant, results would be recorded under the name of the other.
    """
    found = _registered(kind).get(name)
    return "" if found is None else found.conflict


def package(kind: str, name: str) -> str:
    """Distribution of a third party that a plugin comes from; "" for those of vibench, and for what is no plugin."""
    found = _registered(kind).get(name)
    return "" if found is None else found.package


@cache
def code(kind: str, name: str) -> str:
    """Version of a plugin with a hash of its outermost package, or of its module if it is in none.

    Of a name that several packages use it is their versions: nothing is computed with it.

    Raises
    ------
    RequestError
        If no plugin has that name.
    """
    if conflict(kind, name):
        return version(kind, name)
    source = Path(str(importlib.import_module(_entry(kind, name).module).__file__))
    while (source.parent / "__init__.py").is_file():
        source = source.parent
    needed = "".join(f" {required} {distribution_version(required)}" for required in requirements(kind, name))
    return f"{version(kind, name)} {source_hash(source)}{needed}"


def code_and_data(kind: str, name: str, options: Mapping[str, Any]) -> str:
    """`code`, and the digest of the files that the plugin reads with these options (`data_digest`).

    Raises
    ------
    RequestError
        If no plugin has that name, or one of the files cannot be read.
    """
    digest = data_digest(kind, name, options)
    return f"{code(kind, name)} data {digest}" if digest else code(kind, name)


def data_digest(kind: str, name: str, options: Mapping[str, Any]) -> str:
    """Digest of the files that a problem or a sampling strategy reads with these options, "" if it reads none.

    It is "" for a name that several packages use, too: nothing is computed with it.
    """
    if kind not in READERS or conflict(kind, name) or missing(kind, name):
        return ""
    return str(load(kind, name).data_digest(**check_options(kind, name, options)))


def missing(kind: str, name: str) -> list[str]:
    """Distributions that a plugin `requires` and that are not installed."""
    return [distribution for distribution in requirements(kind, name) if not distribution_version(distribution)]


def requirements(kind: str, name: str) -> tuple[str, ...]:
    """Distributions that a plugin `requires`, in addition to the requirements of its own distribution."""
    entry = _entry(kind, name)
    plugin = getattr(importlib.import_module(entry.module), entry.attr.partition(".")[0], None)
    return tuple(getattr(plugin, "requires", ()))


def options(kind: str, name: str) -> list[Option]:
    """The options of a plugin, read from its constructor."""
    return options_of(load(kind, name))


def options_of(plugin: type) -> list[Option]:
    """The options of a class."""
    return [
        Option(option, _expected(annotation), "" if default is inspect.Parameter.empty else repr(default))
        for option, (default, annotation) in _parameters(plugin).items()
    ]


def check_options(kind: str, name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a registered plugin, checked as by `checked_arguments`; as they are if several have its name."""
    if conflict(kind, name):
        return dict(given)
    return checked_arguments(load(kind, name), f"{kind} '{name}'", given)


def checked_arguments(plugin: type, what: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a class, converted to the types in its constructor's annotations; `what` is its name in messages.

    Raises
    ------
    RequestError
        If an option is unknown, missing, or not of its type.
    """
    known = _parameters(plugin)
    for option in given:
        if option not in known:
            raise unknown_name(f"option of {what}", option, known)
    checked = {}
    for option, (default, annotation) in known.items():
        if option in given:
            # In strict mode pydantic converts lists to tuples and texts to enumerations only from JSON.
            text = json.dumps(given[option], default=str)
            try:
                checked[option] = TypeAdapter(annotation, config=FINITE).validate_json(text, strict=True)
            except ValidationError:
                found, expected = given[option], _expected(annotation)
                raise RequestError(f"option '{option}' of {what} is {found!r}; expected {expected}") from None
        elif default is inspect.Parameter.empty:
            raise RequestError(f"{what} needs the option '{option}' ({_expected(annotation)})")
    return checked


def path_options(kind: str, name: str) -> list[str]:
    """Options of a plugin that are paths; none of a name that nobody, or several, registered."""
    if name not in names(kind) or conflict(kind, name):
        return []
    return [option for option, (_, annotation) in _parameters(load(kind, name)).items() if annotation is Path]


def doubtful_options(plugin: type) -> dict[str, str]:
    """What is doubtful of the options of a class, by name: no annotation, or a default that does not conform to it."""
    doubts = {}
    for option, (default, annotation) in _parameters(plugin).items():
        if annotation is Any:
            doubts[option] = "has no annotation that says what study files may set it to"
            continue
        try:
            expected = _expected(annotation)
            if default is not inspect.Parameter.empty:
                text = json.dumps(default, default=str)
                TypeAdapter(annotation, config=FINITE).validate_json(text, strict=True)
        except PydanticUserError as error:
            doubts[option] = f"has an annotation that no value of a study file conforms to: {in_a_line(error)}"
        except ValidationError:
            doubts[option] = f"has the default {default!r}; its annotation expects {expected}"
    return doubts


def canonical_options(kind: str, name: str, given: Mapping[str, Any]) -> str:
    """Options as canonical JSON, without those that equal their default; as they are if several have the name."""
    if conflict(kind, name):
        return json.dumps(given, sort_keys=True, default=str)
    known, checked = _parameters(load(kind, name)), check_options(kind, name, given)
    kept = {option: value for option, value in checked.items() if value != known[option][0]}
    return json.dumps(TypeAdapter(dict[str, Any]).dump_python(kept, mode="json"), sort_keys=True)


def qp_solver(name: str) -> dict[str, QPSolver]:
    """The solver that a plugin registers under this name, by it; empty for the solvers of qpsolvers."""
    return {name: load("QP solver", name)} if name in names("QP solver") else {}


def study_path(name: str) -> Path:
    """File of a registered study."""
    return Path(load("study", name))


@dataclass(frozen=True)
class _Registered:
    """The entry points of one name; several where packages register different objects under it."""

    kind: str
    entries: tuple[EntryPoint, ...]

    @cached_property
    def conflict(self) -> str:
        name, owners = self.entries[0].name, len(self.entries)
        others = ["qpsolvers"] if self.kind == "QP solver" and name in SETTINGS else []
        if owners + len(others) < 2:
            return ""
        count = "two" if owners + len(others) == 2 else "several"
        packages = ", ".join([*others, *(f"{_origin(entry)} ({entry.value})" for entry in self.entries)])
        return f"{count} packages provide the {self.kind} '{name}', so that none is used: {packages}"

    @cached_property
    def package(self) -> str:
        entry = self.entries[0]  # the metadata of a distribution are read again at each access
        owner = entry.module.partition(".")[0] if entry.dist is None else entry.dist.name
        return "" if owner == "vibench" else owner


@cache
def _registered(kind: str) -> dict[str, _Registered]:
    found: dict[str, dict[str, EntryPoint]] = {}
    for entry in entry_points(group=GROUPS[kind]):
        found.setdefault(entry.name, {}).setdefault(entry.value, entry)
    return {name: _Registered(kind, tuple(entries.values())) for name, entries in found.items()}


def _entry(kind: str, name: str) -> EntryPoint:
    registered = _registered(kind)
    if name not in registered:
        raise unknown_name(kind, name, registered)
    if reason := conflict(kind, name):
        raise RequestError(reason)
    return registered[name].entries[0]


@cache
def _parameters(plugin: Any) -> Mapping[str, tuple[Any, Any]]:
    """Default and annotation of every named parameter of a constructor."""
    constructor = inspect.getattr_static(plugin, "__init__")
    if constructor is object.__init__:
        return {}
    try:
        hints = get_type_hints(constructor, include_extras=True)
    except Exception as error:  # noqa: BLE001  evaluating annotations runs third-party code
        raise RequestError(f"the options of {plugin.__name__} have annotations that fail: {in_a_line(error)}") from None
    parameters = list(inspect.signature(constructor).parameters.values())[1:]  # without self
    named = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return {p.name: (p.default, hints.get(p.name, Any)) for p in named}


def _expected(annotation: Any) -> str:
    """An annotation in words: "float > 0.0", "'coarse', 'fine' or int ≥ 150"."""
    schema = TypeAdapter(annotation).json_schema()
    return " or ".join(_words(part) for part in schema.get("anyOf", [schema]))


def _words(schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return ", ".join(repr(value) for value in schema["enum"])
    if "const" in schema:
        return repr(schema["const"])
    kind = str(schema.get("type", "any value"))
    python = {"integer": "int", "number": "float", "string": "str", "boolean": "bool", "array": "list"}.get(kind, kind)
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    bounds = [f"{sign} {schema[key]:g}" for key, sign in signs.items() if key in schema]
    return " ".join([python, " and ".join(bounds)]).strip()
