"""The core knows no plugin: it imports none and names none."""

from __future__ import annotations

import ast
import importlib.metadata
from pathlib import Path

import pytest
from sources import SOURCES, mentions

PLUGINS = ("vibench.problems", "vibench.dual_strategies", "vibench.primal_strategies")

ENTRIES = [entry for entry in importlib.metadata.distribution("vibench").entry_points if entry.group in PLUGINS]
FORMAT = "pack"
"""Also the name of a file format that the core reads and writes; the problem of that name is a thin plugin on it."""

NAMES = sorted({entry.name for entry in ENTRIES} - {FORMAT})
PACKAGES = sorted({entry.module.split(".")[0] for entry in ENTRIES})


def imported(tree: ast.AST) -> set[str]:
    """Packages a source imports, in whatever form."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(str(node.module).split(".")[0])
    return found


def test_there_is_something_to_look_for() -> None:
    assert {"obstacle", "cpg", "mcpg", "decorrelated", "online-supremizers", "offline-pga"} <= set(NAMES)
    assert {"vibench_problems", "vibench_strategies"} == set(PACKAGES)
    assert len(SOURCES) > 20


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("offline-pga", "see offline-pga.", True), ("offline-pga", "Offline_PGA = 1", True), ("cpg", "for CPG,", True),
        ("cpg", "mCPG", False), ("offline-pga", "offline pga", False), ("cpg", "a-cpg", False), ("box", "boxes", False),
    ],
)  # fmt: skip
def test_a_mention_is_a_whole_word(name: str, text: str, found: bool) -> None:
    assert bool(mentions(name, text)) is found


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_the_core_imports_no_plugin(source: Path) -> None:
    text = source.read_text(encoding="utf-8")
    assert imported(ast.parse(text)) & set(PACKAGES) == set()
    assert [package for package in PACKAGES if package in text] == []


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_the_core_names_no_plugin(source: Path) -> None:
    text = source.read_text(encoding="utf-8")
    found = {name: lines for name in NAMES if (lines := mentions(name, text))}
    assert found == {}
