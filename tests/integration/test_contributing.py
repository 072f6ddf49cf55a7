import ast
import importlib
import importlib.metadata
import re
import tomllib
from pathlib import Path

from sources import SOURCES, mentions

import vibench

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PACKAGES = re.findall(r"^    (\w+)/ ", TEXT, re.MULTILINE)
WALK = re.findall(r"^\d\. `vibench\.([\w.]+)`", TEXT.partition("From `vibench run STUDY`")[2], re.MULTILINE)
LAYERS = [
    name.strip()
    for layer in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"][0]["layers"]
    for name in layer.split("|")
]


def test_the_map_and_the_walk_name_packages_in_the_order_of_the_layers() -> None:
    package = Path(str(vibench.__file__)).parent
    assert set(PACKAGES) == {path.parent.name for path in package.glob("*/__init__.py")}
    assert [layer for layer in LAYERS if layer in PACKAGES] == PACKAGES
    modules, places = [], []
    for name in WALK:
        parts = name.split(".")
        depth = next(k for k in (3, 2) if (ROOT / "vibench" / ("/".join(parts[:k]) + ".py")).is_file())
        place = importlib.import_module("vibench." + ".".join(parts[:depth]))
        modules.append(place.__name__)
        for part in parts[depth:]:
            place = getattr(place, part)
        assert callable(place), name
        places.append(LAYERS.index(parts[0]))
    assert len(modules) == len(set(modules)) == 7
    assert places == sorted(places)


PLUGINS = ("vibench.problems", "vibench.dual_strategies", "vibench.primal_strategies")

ENTRIES = [entry for entry in importlib.metadata.distribution("vibench").entry_points if entry.group in PLUGINS]
FORMAT = "pack"
"""Also the name of a file format that the core reads and writes; the problem of that name is a thin plugin on it."""

NAMES = sorted({entry.name for entry in ENTRIES} - {FORMAT})
PROVIDERS = sorted({entry.module.split(".")[0] for entry in ENTRIES})


def imported(tree: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(str(node.module).split(".")[0])
    return found


def test_the_core_imports_no_plugin_and_names_none() -> None:
    assert {"obstacle", "cpg", "mcpg", "decorrelated", "online-supremizers", "offline-pga"} <= set(NAMES)
    assert {"vibench_problems", "vibench_strategies"} == set(PROVIDERS)
    assert len(SOURCES) > 20
    texts = {source: source.read_text(encoding="utf-8") for source in SOURCES}
    assert {path for path, text in texts.items() if imported(ast.parse(text)) & set(PROVIDERS)} == set()
    assert {path for path, text in texts.items() if any(package in text for package in PROVIDERS)} == set()
    assert {(path, name) for path, text in texts.items() for name in NAMES if mentions(name, text)} == set()
    for name, text in (("offline-pga", "see offline-pga."), ("offline-pga", "Offline_PGA = 1"), ("cpg", "for CPG,")):
        assert mentions(name, text), text
    for name, text in (("cpg", "mCPG"), ("offline-pga", "offline pga"), ("cpg", "a-cpg"), ("box", "boxes")):
        assert not mentions(name, text), text
