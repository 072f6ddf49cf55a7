"""The modules of vibench that determine what a function or a class computes, read from their sources.

A definition depends on those that its names stand for, and on what these depend on. A method of a class among them
counts if its name is an attribute of anything in what counts already, whatever the object: so too much may count, but
never too little, unless a name is put together at run time.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TypeAlias

CORE = Path(__file__).parent

CELL = ("vibench.stages.cell_queries:cell_queries", "vibench.rounds.timing_rounds:TimingRounds")
"""Where the computation of a cell begins: with its last stage, whose inputs lead to all others, and with its timing."""

CARRIERS = (
    "vibench.study", "vibench.plugins", "vibench.storage", "vibench.stages.base", "vibench.provenance",
    "vibench.errors", "vibench.text",
)  # fmt: skip
"""Packages and modules that determine no number: they hand over what does, and that counts by itself.

What a study asks for is in the fields of stages, an artefact is read as it was written, a reason is no number.
"""

COUNTED = "vibench.study.parameter_sets"
"""The module within `CARRIERS` that does determine numbers."""

SOURCES = (".py", ".pyi")
"""Suffixes of sources."""

Place: TypeAlias = tuple[str, str]
"""Module and name of a definition; the name "" stands for the module itself."""

Request: TypeAlias = tuple[tuple[str, ...], bool]
"""What `code_used` is asked for: roots, and whether the whole classes count."""


@dataclass(frozen=True)
class _Definition:
    """What occurs in a function, a class or an assignment: names, attributes and imports.

    `members` are the methods of a class; its special methods are none, since Python calls them without their names.
    """

    names: set[str] = field(default_factory=set)
    attributes: set[str] = field(default_factory=set)
    imports: dict[str, Place] = field(default_factory=dict)
    members: dict[str, _Definition] = field(default_factory=dict)


@cache
def modules_used(*roots: str, whole: bool = False) -> frozenset[str]:
    """The modules of vibench that determine what is computed by "module:name" or "module:class.method".

    Computation begins at the `roots`. With `whole` all methods of all classes that are reached count: others may call
    these, too.
    """
    reached = _Reached(whole)
    for root in roots:
        module, _, path = root.partition(":")
        name, _, method = path.partition(".")
        for place in _origin(module, name, module):
            reached.add(place)
            if method:
                reached.ahead.append((place[0], _definition(*place).members[method]))
    reached.follow()
    return frozenset(module for module, _ in reached.places if _outermost(module) == CORE.name)


class _Reached:
    """The definitions that count; `ahead` are those whose names have not been looked up."""

    def __init__(self, whole: bool) -> None:
        self._whole = whole
        self.places: set[Place] = set()
        self.ahead: list[tuple[str, _Definition]] = []
        self._attributes: set[str] = set()
        self._uncounted: dict[str, list[tuple[str, _Definition]]] = {}

    def add(self, place: Place) -> None:
        """Count a definition, and those of its members that are attributes of what counts."""
        if place in self.places:
            return
        self.places.add(place)
        module, definition = place[0], _definition(*place)
        self.ahead.append((module, definition))
        for name, member in definition.members.items():
            counts = self._whole or name in self._attributes
            (self.ahead if counts else self._uncounted.setdefault(name, [])).append((module, member))

    def follow(self) -> None:
        """Count what is needed by what counts, until nothing is left."""
        while self.ahead:
            module, definition = self.ahead.pop()
            for place in _meant(module, definition):
                self.add(place)
            for name in definition.attributes - self._attributes:
                self._attributes.add(name)
                self.ahead += self._uncounted.pop(name, ())


_own: dict[Request, tuple[str, str]] = {}
"""Hashes that this process has returned, by what was asked for, each with that of all sources that it looked in."""

_taken: dict[Request, tuple[str, str]] = {}
"""Those of another process."""


def code_found() -> dict[Request, tuple[str, str]]:
    """What `code_used` has returned in this process, for `take_over` in another one."""
    return dict(_own)


def take_over(found: Mapping[Request, tuple[str, str]]) -> None:
    """Let `code_used` return what it has returned in another process, where the sources are the same here."""
    _taken.update(found)


@cache
def code_used(*roots: str, whole: bool = False) -> str:
    """Hash of the sources of `modules_used`."""
    sources, taken = _all_sources(roots), _taken.get((roots, whole))
    code = taken[1] if sources and taken is not None and taken[0] == sources else _hash_of_used(roots, whole)
    _own[roots, whole] = sources, code
    return code


def _all_sources(roots: tuple[str, ...]) -> str:
    """Hash of all sources in which `modules_used` looks from the roots; "" if they cannot be listed."""
    packages = [_sources_in(name) for name in sorted({CORE.name, *map(_outermost, roots)})]
    return " ".join(packages) if all(packages) else ""


@cache
def _sources_in(package: str) -> str:
    """Hash of all sources of an outermost package, or of a module in none; "" if they cannot be listed."""
    try:
        path = _file(package)
    except ValueError:  # it was not imported from a file
        return ""
    if path is None or path.suffix not in SOURCES:
        return ""
    content = hashlib.sha256(package.encode())
    for source in sorted(path.parent.rglob("*.py*")) if path.stem == "__init__" else [path]:
        if source.suffix in SOURCES:
            content.update(f"{source.relative_to(path.parent).as_posix()}\0".encode() + source.read_bytes())
    return content.hexdigest()


def _hash_of_used(roots: tuple[str, ...], whole: bool) -> str:
    content = hashlib.sha256()
    for module in sorted(modules_used(*roots, whole=whole)):
        content.update(f"{module} {hashlib.sha256(_source(module)).hexdigest()}\n".encode())
    return content.hexdigest()[:12]


def _meant(module: str, definition: _Definition) -> Iterator[Place]:
    """The definitions that the names in one of a module stand for, in vibench and in the package of that module."""
    here = _parsed(module)
    for name in definition.names:
        for imports in (definition.imports, here.imports):
            if name in imports:
                yield from _origin(*imports[name], module)
        if name in here.members:
            yield module, name


def _origin(module: str, name: str, user: str) -> Iterator[Place]:
    """Where a name is defined that is imported from a module, which may import it itself."""
    carrier = module != COUNTED and any(f"{module}.".startswith(f"{one}.") for one in CARRIERS)
    if carrier or _outermost(module) not in (CORE.name, _outermost(user)):
        return
    imported = _parsed(module).imports.get(name)
    if not name or name in _parsed(module).members:
        yield module, name
    elif imported is not None and imported != (module, name):
        yield from _origin(*imported, user)
    elif _file(f"{module}.{name}") is not None:
        yield from _origin(f"{module}.{name}", "", user)


def _definition(module: str, name: str) -> _Definition:
    return _parsed(module).members[name] if name else _Definition(members=_parsed(module).members)


def _outermost(place: str) -> str:
    """The package of a module, or of "module:name"."""
    return place.partition(":")[0].partition(".")[0]


@cache
def _file(module: str) -> Path | None:
    """The source of a module; for a package with a stub, from which names are imported lazily, the stub."""
    if _outermost(module) != CORE.name:
        try:
            spec = find_spec(module)
        except ModuleNotFoundError:  # its parent is no package
            return None
        return Path(spec.origin) if spec is not None and spec.origin and spec.has_location else None
    path = CORE.joinpath(*module.split(".")[1:])
    sources = (path / "__init__.pyi", path / "__init__.py", path.with_suffix(".py"))
    return next((source for source in sources if source.is_file()), None)


@cache
def _source(module: str) -> bytes:
    path = _file(module)
    return path.read_bytes() if path is not None and path.suffix in SOURCES else b""


@cache
def _parsed(module: str) -> _Definition:
    """What a module imports and, as members, what it defines.

    A statement that defines nothing is left out: none changes what a name stands for, it only registers that.
    """
    defined, path = _Definition(), _file(module)
    package = module if path is not None and path.stem == "__init__" else module.rpartition(".")[0]
    ahead: list[ast.AST] = [ast.parse(_source(module))]
    while ahead:
        node = ahead.pop()
        match node:
            case ast.Import() | ast.ImportFrom():
                defined.imports.update(_imported(node, package))
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                defined.members[node.name] = _read(node, package)
            case ast.Assign() | ast.AnnAssign():
                names = (part for part in ast.walk(node) if isinstance(part, ast.Name))
                stored = (part.id for part in names if isinstance(part.ctx, ast.Store))
                defined.members.update(dict.fromkeys(stored, _read(node, package)))
            case ast.Module() | ast.If() | ast.Try() | ast.ExceptHandler() | ast.With():
                ahead += ast.iter_child_nodes(node)
    return defined


def _imported(node: ast.Import | ast.ImportFrom, package: str) -> Mapping[str, Place]:
    """What the names stand for that a statement in a package imports."""
    if isinstance(node, ast.Import):
        return {one.asname or _outermost(one.name): (one.name if one.asname else _outermost(one.name), "")
                for one in node.names}  # fmt: skip
    parents = package.split(".")
    above = parents[: len(parents) - node.level + 1] if node.level else []
    module = ".".join([*above, *([node.module] if node.module else [])])
    return {one.asname or one.name: (module, one.name) for one in node.names}


def _read(statement: ast.stmt, package: str) -> _Definition:
    """What occurs in a statement of a package."""
    occurring = _Definition()
    ahead: list[ast.AST] = [statement]
    while ahead:
        node = ahead.pop()
        match node:
            case ast.Name():
                occurring.names.add(node.id)
            case ast.Attribute():
                occurring.attributes.add(node.attr)
            case ast.Import() | ast.ImportFrom():
                occurring.imports.update(_imported(node, package))
        for child in ast.iter_child_nodes(node):
            in_class = node is statement and isinstance(statement, ast.ClassDef)
            if in_class and isinstance(child, ast.FunctionDef) and not child.name.startswith("__"):
                occurring.members[child.name] = _read(child, package)
            else:
                ahead.append(child)
    return occurring
