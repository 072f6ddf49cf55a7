"""Size of the packages in a folder: lines, modules, statements, constants, comments, docstrings.

    python tests/benchmarks/house.py vibench [--list]

`--list` names the constants: names in capitals of a module, and numbers in modules, class attributes, dictionary
entries and defaults of arguments. The beginnings What, Whom, Of and So many of docstrings are counted as `odd`.
"""

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

COLUMNS = "lines", "modules", "statements", "constants", "own", "docstrings", "odd"


def is_number(node: ast.expr | None) -> bool:
    if node is None:
        return False
    parts = list(ast.walk(node))
    literals = [part.value for part in parts if isinstance(part, ast.Constant)]
    computed = any(isinstance(part, ast.Name | ast.Call | ast.Attribute) for part in parts)
    return bool(literals) and not computed and all(type(value) in {int, float, complex} for value in literals)


def assigned(node: ast.stmt) -> Iterator[tuple[str, ast.expr | None]]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    for target in chain.from_iterable(t.elts if isinstance(t, ast.Tuple) else [t] for t in targets):
        if isinstance(target, ast.Name):
            yield target.id, getattr(node, "value", None)


def constants(tree: ast.Module) -> Iterator[str]:
    for name, value in chain.from_iterable(map(assigned, tree.body)):
        if (name.isupper() and len(name) > 1) or is_number(value):
            yield name
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            yield from (f"{node.name}.{name}" for name, value in chain.from_iterable(map(assigned, node.body))
                        if is_number(value) or "default" in numbers_of(value))  # fmt: skip
        elif isinstance(node, ast.Dict):
            pairs = zip(node.keys, node.values, strict=True)
            yield from (f"{{{key.value!r}}}" for key, one in pairs if isinstance(key, ast.Constant) and is_number(one))
        elif isinstance(node, ast.FunctionDef | ast.Lambda):
            defaults = [*node.args.defaults, *node.args.kw_defaults]
            yield from (f"a default of {getattr(node, 'name', 'lambda')}" for value in defaults if is_number(value))


def numbers_of(call: ast.expr | None) -> set[str]:
    """Keyword arguments of a call, such as `Field(default=1)`, that are numbers."""
    keywords = call.keywords if isinstance(call, ast.Call) else []
    return {str(keyword.arg) for keyword in keywords if is_number(keyword.value)}


def measured(path: Path) -> Counter[str]:
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    documented = ast.Module | ast.ClassDef | ast.FunctionDef
    texts = [doc for node in nodes if isinstance(node, documented) and (doc := ast.get_docstring(node))]
    return Counter({
        "lines": text.count("\n"), "modules": 1, "statements": sum(isinstance(node, ast.stmt) for node in nodes),
        "constants": len(list(constants(tree))), "own": len(re.findall(r"^\s*#(?! noqa| type:)", text, re.M)),
        "docstrings": len(texts), "odd": sum(bool(re.match(r"(What|Whom|Of|So many)\b", doc)) for doc in texts),
    })  # fmt: skip


def main(folder: str, *options: str) -> None:
    packages: dict[str, Counter[str]] = {}
    for path in sorted(Path(folder).rglob("*.py")):
        package = packages.setdefault(path.relative_to(folder).parts[0].removesuffix(path.name) or ".", Counter())
        package.update(measured(path))
        for name in constants(ast.parse(path.read_text(encoding="utf-8"))) if "--list" in options else ():
            print(f"{path}: {name}")
    print(f"{'':16}", *(f"{name:>12}" for name in COLUMNS))
    for name, counts in [*packages.items(), ("all", sum(packages.values(), Counter()))]:
        print(f"{name:16}", *(f"{counts[column]:12}" for column in COLUMNS))


if __name__ == "__main__":
    main(*sys.argv[1:])
