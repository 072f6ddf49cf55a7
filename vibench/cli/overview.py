"""What is registered, read without importing any of it: a plugin's class stands in its source.

`vibench list` and completion answer at once this way; what a plugin does when it is imported is for `vibench list KIND`
to show.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path

from vibench.study.entry_points import entry_points
from vibench.study.kinds import KINDS

LISTS = {kind.listed: kind.entry_points for kind in KINDS}
"""Group of entry points of every list."""

Row = tuple[str, str, str, str]


def rows(kind: str) -> Iterator[Row]:
    """Name, origin, description and names of the options of what is registered."""
    from vibench.qp.settings import SETTINGS

    registered: dict[str, dict[str, EntryPoint]] = {}
    for entry in entry_points(group=LISTS[kind]):
        registered.setdefault(entry.name, {}).setdefault(entry.value, entry)
    for name, entries in sorted(registered.items()):
        origins = [*(["qpsolvers"] if kind == "solvers" and name in SETTINGS else []), *map(_origin, entries.values())]
        origin, entry = ", ".join(origins), next(iter(entries.values()))
        if len(origins) > 1:  # as `registry.conflict` says, which would take a second to import
            yield name, origin, f"several packages provide '{name}', so that none is used", ""
        elif kind == "studies":
            yield name, origin, _comment(entry), ""
        else:
            found = plugin_class(entry)
            text = ast.get_docstring(found) or "" if found is not None else ""
            yield name, origin, text.split("\n")[0], ", ".join(options(entry))


def _origin(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist is not None else "unknown"


def plugin_class(entry: EntryPoint) -> ast.ClassDef | None:
    """The class that an entry point names, if its module defines it."""
    return _class(_parsed(_source(entry.module)), entry.attr)


def options(entry: EntryPoint) -> Sequence[str]:
    """Names of the options of a plugin, the arguments of its constructor."""
    constructor = _constructor(entry.module, entry.attr)
    if constructor is None:
        return []
    return [argument.arg for argument in (*constructor.args.args[1:], *constructor.args.kwonlyargs)]


def _constructor(module: str, name: str, below: tuple[tuple[str, str], ...] = ()) -> ast.FunctionDef | None:
    """The constructor of a class or the one it inherits; `below` are the classes that inherit it.

    Only modules of the package of the first class are read: to find others, packages that hold them are imported.
    """
    if (module, name) in below or (below and module.split(".", maxsplit=1)[0] != below[0][0].split(".")[0]):
        return None
    tree, below = _parsed(_source(module)), (*below, (module, name))
    found = _class(tree, name)
    if found is None:
        imports = (node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module and not node.level)
        origins = [(str(node.module), part.name) for node in imports for part in node.names if name == _local(part)]
    else:
        methods = (node for node in found.body if isinstance(node, ast.FunctionDef))
        if own := next((node for node in methods if node.name == "__init__"), None):
            return own
        origins = [(module, base.id) for base in found.bases if isinstance(base, ast.Name)]
    return next(filter(None, (_constructor(*origin, below) for origin in origins)), None)


def _local(imported: ast.alias) -> str:
    return imported.asname or imported.name


def _class(tree: ast.Module, name: str) -> ast.ClassDef | None:
    classes = (node for node in tree.body if isinstance(node, ast.ClassDef))
    return next((node for node in classes if node.name == name), None)


def _comment(entry: EntryPoint) -> str:
    """The first sentence at the top of a study file; the member that an entry point names holds its path."""
    file = _study_file(entry)
    if file is None or not file.is_file():
        return ""
    lines = file.read_text(encoding="utf-8").split("\n")
    top = lines[: next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))]
    return first_sentence(" ".join(line.removeprefix("#").strip() for line in top))


def first_sentence(text: str) -> str:
    """The first sentence of a text, without its point; one before no capital letter is that of an abbreviation."""
    return re.split(r"\.\s+(?=[A-Z])", text, maxsplit=1)[0].removesuffix(".")


def _study_file(entry: EntryPoint) -> Path | None:
    try:
        return Path(entry.load())
    except Exception:  # noqa: BLE001  importing a plugin runs third-party code; `vibench list studies` names the error
        return None


def _parsed(source: Path | None) -> ast.Module:
    try:
        return ast.parse(source.read_bytes()) if source is not None else ast.Module([], [])
    except (OSError, SyntaxError, ValueError):
        return ast.Module([], [])


def _source(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except Exception:  # noqa: BLE001  it imports the packages that hold the module
        return None
    return Path(spec.origin) if spec is not None and spec.origin is not None else None
