"""The core knows no plugin: it imports none and names none."""

import ast
import importlib.metadata

from sources import SOURCES, mentions

PLUGINS = ("vibench.problems", "vibench.dual_strategies", "vibench.primal_strategies")

ENTRIES = [entry for entry in importlib.metadata.distribution("vibench").entry_points if entry.group in PLUGINS]
FORMAT = "pack"
"""Also the name of a file format that the core reads and writes; the problem of that name is a thin plugin on it."""

NAMES = sorted({entry.name for entry in ENTRIES} - {FORMAT})
PACKAGES = sorted({entry.module.split(".")[0] for entry in ENTRIES})


def imported(tree: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(str(node.module).split(".")[0])
    return found


def test_a_mention_is_a_whole_word() -> None:
    for name, text in (("offline-pga", "see offline-pga."), ("offline-pga", "Offline_PGA = 1"), ("cpg", "for CPG,")):
        assert mentions(name, text), text
    for name, text in (("cpg", "mCPG"), ("offline-pga", "offline pga"), ("cpg", "a-cpg"), ("box", "boxes")):
        assert not mentions(name, text), text


def test_the_core_imports_no_plugin_and_names_none() -> None:
    assert {"obstacle", "cpg", "mcpg", "decorrelated", "online-supremizers", "offline-pga"} <= set(NAMES)
    assert {"vibench_problems", "vibench_strategies"} == set(PACKAGES)
    assert len(SOURCES) > 20
    texts = {source: source.read_text(encoding="utf-8") for source in SOURCES}
    assert {path for path, text in texts.items() if imported(ast.parse(text)) & set(PACKAGES)} == set()
    assert {path for path, text in texts.items() if any(package in text for package in PACKAGES)} == set()
    assert {(path, name) for path, text in texts.items() for name in NAMES if mentions(name, text)} == set()
