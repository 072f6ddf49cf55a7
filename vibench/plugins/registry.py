"""The registry of plugins: entry points of the distributions of this environment, with their options.

Only `load`, and methods that use it, import a plugin. Lists and completion need the rest at once, so that nothing heavy
is imported at the top.
"""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import re
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import Distribution, EntryPoint
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vibench.errors import RequestError, foreign, in_a_line, unknown_name
from vibench.plugins.kinds import PluginKind
from vibench.provenance import distribution_version, package_hash, solver_version

if TYPE_CHECKING:
    from vibench.interfaces.dual_sets import BlockKind
    from vibench.plugins.options import Option
    from vibench.qp.verification import QPSolver


@cache
def _identity(distribution: Distribution) -> tuple[str, str]:
    """Name and version of a distribution, whose metadata are read and parsed again at each access."""
    return distribution.name, distribution.version


@dataclass(frozen=True)
class RegisteredPlugin:
    """The entry points of a name: several if packages register different objects, none if nobody does."""

    # Both are refused only when the plugin is loaded; QP solvers of qpsolvers have none.

    kind: PluginKind
    name: str
    entries: tuple[EntryPoint, ...] = ()

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'"

    @property
    def origins(self) -> list[str]:
        """Distributions that provide it, with version: "vibench 0.1.0"."""
        owners = (one.dist for one in self.entries)
        named = ["unknown" if owner is None else " ".join(_identity(owner)) for owner in owners]
        return ["qpsolvers", *named] if self._in_qpsolvers else named

    @property
    def origin(self) -> str:
        """The `origins` in one text."""
        return ", ".join(self.origins)

    @property
    def _in_qpsolvers(self) -> bool:
        from vibench.qp.settings import SETTINGS

        return self.kind is PluginKind.SOLVER and self.name in SETTINGS

    @cached_property
    def conflict(self) -> str:
        """Reason why the name is ambiguous: several packages, or qpsolvers, provide it; "" if it is unique."""
        # Nothing of that name is loaded: results of one plugin would be recorded under the name of another.
        if len(self.entries) < 2 - self._in_qpsolvers:
            return ""
        values = [""] * self._in_qpsolvers + [f" ({entry.value})" for entry in self.entries]
        packages = ", ".join(origin + value for origin, value in zip(self.origins, values, strict=True))
        count = "two" if len(values) == 2 else "several"
        return f"{count} packages provide the {self}, so that none is used: {packages}"

    @cached_property
    def package(self) -> str:
        """Third-party distribution that provides it; "" for plugins of vibench and solvers of qpsolvers."""
        if not self.entries:
            return ""
        entry = self.entries[0]
        owner = entry.module.partition(".")[0] if entry.dist is None else _identity(entry.dist)[0]
        return "" if owner == "vibench" else owner

    @property
    def _entry(self) -> EntryPoint:
        if not self.entries:
            raise unknown_name(self.kind, self.name, registered(self.kind))
        if self.conflict:
            raise RequestError(self.conflict)
        return self.entries[0]

    @property
    def summary(self) -> str:
        """First line of its docstring, or first sentence of the comment at the top of a study."""
        if self.kind is not PluginKind.STUDY:
            documented = next(_definitions(self._entry.module, self._entry.attr), None)
            return ((documented and ast.get_docstring(documented)) or "").split("\n")[0]
        try:
            return top_comment(Path(self.load()))
        except RequestError:
            return ""

    @property
    def names_of_options(self) -> list[str]:
        """Names of the arguments of the constructor of its class, own or inherited."""
        found = list[str]()
        for entry in self.entries:
            members = (member for one in _definitions(entry.module, entry.attr) for member in one.body)
            constructors = (m.args for m in members if isinstance(m, ast.FunctionDef) and m.name == "__init__")
            found += [one.arg for args in islice(constructors, 1) for one in (*args.args[1:], *args.kwonlyargs)]
        return found

    def load(self) -> Any:
        """The object that its entry point refers to."""
        where = f"{self} ({self._entry.value})"
        with foreign(f"{where} cannot be loaded", RequestError):
            plugin = self._entry.load()
        base = self.kind.base
        if base is not None and not (isinstance(plugin, type) and issubclass(plugin, base)):
            raise RequestError(f"{where} is not a subclass of {base.__qualname__}")
        if self.kind is PluginKind.SOLVER and not callable(plugin):
            raise RequestError(f"{where} is not callable")
        if self.kind is PluginKind.STUDY and not isinstance(plugin, str | Path):
            raise RequestError(f"{where} is not the path of a study file")
        return plugin

    @cached_property
    def code(self) -> str:
        """Version with a hash of its outermost package or module; all versions for an ambiguous name."""
        if self.conflict:
            return self.origin
        if self.kind is PluginKind.SOLVER and not self.entries:
            return solver_version(self.name)
        needed = "".join(f" {required} {distribution_version(required)}" for required in self.requirements)
        return f"{self.origin} {package_hash(self._entry.module)}{needed}"

    @property
    def requirements(self) -> tuple[str, ...]:
        """Distributions in its attribute `requires`, in addition to the requirements of its own distribution."""
        return tuple(getattr(self.load(), "requires", ()))

    @property
    def missing(self) -> list[str]:
        return [one for one in self.requirements if not distribution_version(one)]

    @property
    def options(self) -> Mapping[str, Option]:
        from vibench.plugins.options import options_of

        return options_of(self.load())

    @property
    def path_options(self) -> set[str]:
        """Names of the options that are paths of files or folders."""
        return set() if self.conflict else {name for name, one in self.options.items() if one.annotation is Path}

    def check_options(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Options, converted to the types of its constructor's arguments; unchanged for an ambiguous name."""
        from vibench.plugins.options import checked_arguments

        if self.conflict:
            return dict(given)
        own, chosen = self._without_factorisation(given)
        return checked_arguments(self.load(), str(self), own) | chosen

    def _without_factorisation(self, given: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
        """Options without `factorisation`, which has to exist, and this option if it is not the default."""
        # Every problem has this option, in addition to those of its constructor.
        if self.kind is not PluginKind.PROBLEM or "factorisation" not in given or "factorisation" in self.options:
            return dict(given), {}
        from vibench.linalg.factorisations import DEFAULT, implementation

        own = dict(given)
        name = implementation(own.pop("factorisation")).name
        return own, {} if name == DEFAULT else {"factorisation": name}

    def canonical_options(self, given: Mapping[str, Any]) -> str:
        """Checked options as canonical JSON, without those that equal their default."""
        from vibench.plugins.options import options_as_json

        checked, options = self.check_options(given).items(), {} if self.conflict else self.options
        return options_as_json({name: v for name, v in checked if name not in options or v != options[name].preset})

    def data_digest(self, options: Mapping[str, Any]) -> str:
        """Digest of the files that it reads with these options; "" if it reads none, or is not available here."""
        if self.kind not in (PluginKind.PROBLEM, PluginKind.SAMPLING) or self.conflict or self.missing:
            return ""
        return str(self.load().data_digest(**self._without_factorisation(self.check_options(options))[0]))

    def create(self, options: Mapping[str, Any]) -> Any:
        """An instance; a `RequestError` if there is no such plugin, these are not its options, or it lacks a part."""
        from vibench.linalg.inner_product import factorised_later
        from vibench.signatures import check_attributes

        own, chosen = self._without_factorisation(self.check_options(options))
        # The constructor must not factorise X_V with the default first, which may take longest of all.
        with factorised_later() if chosen else nullcontext():
            made = self.load()(**own)
            if chosen:
                made.factorised_by(chosen["factorisation"])
        if self.kind.base is not None:
            check_attributes(made, self.kind.base)
        return made


def find(kind: PluginKind, name: str) -> RegisteredPlugin:
    return registered(kind).get(name) or RegisteredPlugin(kind, name)


@cache
def registered(kind: PluginKind) -> dict[str, RegisteredPlugin]:
    """The plugins of a kind by their names, sorted."""
    named: dict[str, dict[str, EntryPoint]] = {}
    for entry in entry_points(group=kind.entry_points):
        # One entry point that is found in two folders is no conflict.
        named.setdefault(entry.name, {}).setdefault(entry.value, entry)
    return {name: RegisteredPlugin(kind, name, tuple(entries.values())) for name, entries in sorted(named.items())}


@cache
def default_formulation() -> str:
    """Name of the formulation of studies that name none, whose class says `is_default = True`; "" without any."""
    return default_of(PluginKind.FORMULATION)


def default_of(kind: PluginKind, blocks: Set[BlockKind] = frozenset()) -> str:
    """Name of the default formulation or dual strategy for sets K with these kinds of blocks; "" without any.

    Of those that serve K it is the one that knows fewest kinds; if none does, it is the one for rays, which says so.
    Raises a `RequestError` if there are several.
    """
    # Classes are read, and imported only where K has blocks: results are shown by the name of the default.
    unique = {name: one.entries[0] for name, one in registered(kind).items() if not one.conflict}
    declared = {name: _declared(entry.module, entry.attr) for name, entry in unique.items()}
    known = {name: len(getattr(own.get("blocks"), "elts", ())) for name, own in declared.items() if _is_default(own)}
    serving = [name for name in known if not blocks or blocks <= set(find(kind, name).load().blocks)]
    fewest = min((known[name] for name in serving), default=0)
    names = [name for name in serving if known[name] == fewest]
    if len(names) > 1:
        raise RequestError(f"several plugins say that they are the default {kind}: {', '.join(names)}")
    return names[0] if names else default_of(kind) if blocks else ""


def _is_default(declared: Mapping[str, ast.expr]) -> bool:
    own = declared.get("is_default")
    return isinstance(own, ast.Constant) and own.value is True


def _declared(module: str, name: str) -> dict[str, ast.expr]:
    """The attributes that a class assigns in its body, as they are written."""
    found: dict[str, ast.expr] = {}
    for node in next(_definitions(module, name), ast.ClassDef(name, [], [], [], [])).body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(target, ast.Name) and isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            found[target.id] = node.value
    return found


def find_named(text: str, kinds: Mapping[str, PluginKind], solvers: Sequence[str]) -> RegisteredPlugin:
    """The plugin that NAME or KIND:NAME refers to, of kinds by their command line names and of installed QP solvers."""
    prefix, colon, rest = text.partition(":")
    name = rest if colon else text
    searched = {word: kind for word, kind in kinds.items() if not colon or word == prefix}
    kept = (searched or kinds).items()
    names = {word: solvers if kind is PluginKind.SOLVER else [*registered(kind)] for word, kind in kept}
    matching = [word for word in searched if name in names[word]]
    if not matching:
        what = kinds.get(prefix, "plugin") if colon else "plugin"
        raise unknown_name(what, name, (one for of_kind in names.values() for one in of_kind))
    if len(matching) > 1:
        raise RequestError(f"several plugins are called '{name}': say {' or '.join(f'{k}:{name}' for k in matching)}")
    return find(kinds[matching[0]], name)


def create(kind: str, name: str, options: Mapping[str, Any] | None = None) -> Any:
    """Instance of a registered plugin; a `RequestError` if there is none, or it does not take these options.

    Parameters
    ----------
    kind
        "problem", "dual strategy", "primal strategy", "formulation" or "sampling strategy".
    name, options
        Name under which the plugin is registered, and keyword arguments of its constructor.
    """
    if kind not in [*PluginKind]:
        raise unknown_name("kind of plugins", kind, PluginKind)
    return find(PluginKind(kind), name).create(options or {})


def qp_solver(name: str) -> dict[str, QPSolver]:
    """The solver of a plugin, by its name; empty for a solver of qpsolvers."""
    return {name: find(PluginKind.SOLVER, name).load()} if name in registered(PluginKind.SOLVER) else {}


def entry_points(*, group: str) -> list[EntryPoint]:
    """The entry points of a group, without those of `unreadable` distributions."""
    return [entry for entry in _readable()[0] if entry.group == group]


def unreadable() -> dict[str, str]:
    """Distributions whose entry points cannot be read, or are in groups that vibench has not, each with a line."""
    return _readable()[1]


@cache
def _readable() -> tuple[tuple[EntryPoint, ...], dict[str, str]]:
    readable: dict[str, tuple[EntryPoint, ...]] = {}
    broken: dict[str, str] = {}
    for distribution in importlib.metadata.distributions():
        name = _distribution_name(distribution)
        # Python imports the first one on the path.
        if name in readable or name in broken:
            continue
        try:
            readable[name] = tuple(distribution.entry_points)
        except Exception as error:  # noqa: BLE001  importlib.metadata raises whatever its parser does
            broken[name] = f"its entry_points.txt cannot be read: {in_a_line(error)}"
        groups = {entry.group: entry.name for entry in readable.get(name, ()) if entry.group.startswith("vibench.")}
        for group in sorted(groups.keys() - {kind.entry_points for kind in PluginKind})[:1]:
            wrong = unknown_name("group of entry points", group, (kind.entry_points for kind in PluginKind))
            broken[name] = f"its entry point '{groups[group]:.80}' is not used: {wrong}"
    return tuple(entry for entries in readable.values() for entry in entries), broken


def _distribution_name(distribution: Distribution) -> str:
    """The normalised name, from the name of the folder if possible, since METADATA takes long to read."""
    try:
        return str(getattr(distribution, "_normalized_name", None) or distribution.metadata["Name"])
    except Exception:  # noqa: BLE001  as above
        return str(distribution)


def _definitions(module: str, name: str, below: tuple[tuple[str, str], ...] = ()) -> Iterator[ast.ClassDef]:
    """The definitions of a class and of its base classes; `below` are the classes that inherit from it."""
    # Read modules of the package of the first class alone: finding others would import their packages.
    if (module, name) in below or (below and module.partition(".")[0] != below[0][0].partition(".")[0]):
        return
    tree = _syntax_tree(module)
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name]
    yield from classes
    origins = [(module, base.id) for node in classes for base in node.bases if isinstance(base, ast.Name)]
    for node in tree.body if not classes else ():
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            origins += [(node.module, part.name) for part in node.names if name == (part.asname or part.name)]
    for origin in origins:
        yield from _definitions(*origin, (*below, (module, name)))


def _syntax_tree(module: str) -> ast.Module:
    try:
        spec = importlib.util.find_spec(module)
        return ast.parse(Path(str(spec.origin)).read_bytes() if spec is not None else b"")
    except Exception:  # noqa: BLE001  finding a module imports the packages that hold it
        return ast.Module([], [])


def top_comment(file: Path) -> str:
    """The first sentence of the comment at the top of a study file; "" if there is none."""
    lines = file.read_text(encoding="utf-8").split("\n") if file.is_file() else []
    top = lines[: next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))]
    return first_sentence(" ".join(line.removeprefix("#").strip() for line in top))


def first_sentence(text: str) -> str:
    """The first sentence of a text, without its full stop."""
    # A full stop that no capital letter follows ends an abbreviation.
    return re.split(r"\.\s+(?=[A-Z])", text, maxsplit=1)[0].removesuffix(".")
