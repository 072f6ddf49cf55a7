"""What the source of a plugin says of it: `vibench list` and completion read this, and import no plugin."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path


def docstring(module: str, name: str) -> str:
    """The first line of the documentation of a class."""
    documented = next(_definitions(module, name), None)
    text = "" if documented is None else ast.get_docstring(documented)
    return (text or "").split("\n")[0]


def names_of_options(module: str, name: str) -> list[str]:
    """Names of the arguments of a class's constructor, its own or inherited."""
    methods = (node for one in _definitions(module, name) for node in one.body if isinstance(node, ast.FunctionDef))
    constructor = next((node.args for node in methods if node.name == "__init__"), None)
    return [] if constructor is None else [one.arg for one in (*constructor.args[1:], *constructor.kwonlyargs)]


def _definitions(module: str, name: str, below: tuple[tuple[str, str], ...] = ()) -> Iterator[ast.ClassDef]:
    """The definition of a class, and those of the classes that it inherits from; `below` are those that inherit it.

    Only modules of the package of the first class are read: to find others, packages that hold them are imported.
    """
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
    """The first sentence of the comment at the top of a study file; "" where it has none or is none."""
    lines = file.read_text(encoding="utf-8").split("\n") if file.is_file() else []
    top = lines[: next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))]
    return first_sentence(" ".join(line.removeprefix("#").strip() for line in top))


def first_sentence(text: str) -> str:
    """The first sentence of a text, without its point; one before no capital letter is that of an abbreviation."""
    return re.split(r"\.\s+(?=[A-Z])", text, maxsplit=1)[0].removesuffix(".")
