"""What a definition depends on, read from sources: a package of a few modules stands for vibench."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from vibench import dependencies
from vibench.dependencies import CELL, code_found, code_used, modules_used, take_over

SOURCES = {
    "__init__.pyi": "from .numbers import double as double\nfrom . import tables as tables\n",
    "numbers.py": """
from core.constants import FACTOR
from core.shapes import Shape

def double(x): return FACTOR * x
def area(shape: Shape): return shape.area()
def annotated(given: Other): ...
def imports_itself():
    from core.tables import row
    return row
def recursive(n): return recursive(n - 1)
""",
    "constants.py": "from core.base import BASE\nFACTOR = 2 * BASE\nUNUSED = 1\n",
    "base.py": "import sys\nif sys.platform:\n    BASE = 1\nelse:\n    BASE = 2\n",
    "shapes.py": """
from core import lengths, tables
from core.base import Named

class Shape(Named):
    def __init__(self): lengths.check(self)
    def area(self): return self.side() ** 2
    def side(self): return lengths.SIDE
    def drawn(self): return tables.row
""",
    "lengths.py": "import core.constants as c\ndef check(x): return x\nSIDE = c.FACTOR\n",
    "tables.py": "def row(): ...\n",
    "study/__init__.py": "",
    "study/registry.py": "from core.tables import row\ndef find(): return row\n",
    "study/sets.py": "from core.numbers import double\n",
    "requests.py": """
from core.study.registry import find
from core.study.sets import double
def use(): return find, double
""",
}


@pytest.fixture
def core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a package `core`, whose dependencies are read in place of those of vibench."""
    folder = tmp_path / "core"
    for name, text in SOURCES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    monkeypatch.setattr(dependencies, "CORE", folder)
    monkeypatch.setattr(dependencies, "CARRIERS", ("core.study",))
    monkeypatch.setattr(dependencies, "COUNTED", "core.study.sets")
    forget()
    yield folder
    forget()


def forget() -> None:
    read = dependencies._file, dependencies._source, dependencies._parsed, dependencies._sources_in
    for cached in (modules_used, code_used, *read):
        cached.cache_clear()  # type: ignore[attr-defined]


USED = {
    "core.tables:row": {"tables"},
    "core.numbers:double": {"numbers", "constants", "base"},
    "core.numbers:recursive": {"numbers"},
    "core.numbers:imports_itself": {"numbers", "tables"},
    "core.lengths:SIDE": {"lengths", "constants", "base"},
    "core.constants:UNUSED": {"constants"},
    "core:double": {"numbers", "constants", "base"},  # from the stub, which defines nothing itself
    "core.numbers:area": {"numbers", "shapes", "lengths", "constants", "base"},  # a method calls another one
    "core.shapes:Shape": {"shapes", "lengths"},  # special methods alone
    "core.shapes:Shape.drawn": {"shapes", "lengths", "tables"},
    "core.requests:use": {"requests", "numbers", "constants", "base"},
}


@pytest.mark.usefixtures("core")
@pytest.mark.parametrize("root", USED)
def test_what_a_name_stands_for_counts_and_no_other(root: str) -> None:
    assert {module.removeprefix("core.") for module in modules_used(root)} == USED[root]


@pytest.mark.usefixtures("core")
def test_all_methods_count_where_others_may_call_them() -> None:
    assert modules_used("core.shapes:Shape", whole=True) == {f"core.{name}" for name in
        ("shapes", "lengths", "constants", "base", "tables")}  # fmt: skip


PLUGIN = {
    "__init__.py": "",
    "strategy.py": """
import numpy as np
from core import double
from . import other, nothing
from .other import named
class Strategy:
    def reduce(self): return np.sum(double(other.value()))
""",
    "other.py": "from core.tables import row\nfrom os import path\ndef value(): return row()\ndef named(): ...\n",
}


@pytest.mark.usefixtures("core")
def test_the_modules_of_a_plugin_lead_to_those_of_the_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "plugin_that_uses_the_core"
    package.mkdir()
    for name, text in PLUGIN.items():
        (package / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    used = modules_used(f"{package.name}.strategy:Strategy", whole=True)
    assert used == {"core.numbers", "core.constants", "core.base", "core.tables"}
    for name in ("strategy:named", "strategy:nothing", "nothing:Strategy", "other:path"):
        assert modules_used(f"{package.name}.{name}", whole=True) == set()


@pytest.fixture
def edit(core: Path) -> Callable[[str], None]:
    """Function that adds a line to a module of the core."""

    def change(name: str) -> None:
        with (core / name).open("a") as source:
            source.write("# another line\n")
        forget()

    return change


def test_the_hash_changes_with_every_module_that_counts_and_with_no_other(edit: Callable[[str], None]) -> None:
    before = code_used("core.numbers:double")
    for name in SOURCES:
        edit(name)
        after = code_used("core.numbers:double")
        assert (after != before) == (name in {"numbers.py", "constants.py", "base.py"}), name
        before = after


def test_the_hash_of_another_process_is_taken_for_the_same_sources_alone(
    edit: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = "core.numbers:double"
    code_used(root)
    asked = (root,), False
    monkeypatch.setattr(dependencies, "_taken", {})
    take_over({asked: (code_found()[asked][0], "taken")})
    forget()
    assert code_used(root) == "taken"
    edit("tables.py")  # of which nothing is used
    assert code_used(root) != "taken"


def test_a_cell_begins_where_there_is_code() -> None:
    for root in CELL:
        assert root.partition(":")[0] in modules_used(root)
