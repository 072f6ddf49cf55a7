import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import vibench

ROOT = Path(__file__).parents[2]
HEAVY = {"numpy", "scipy", "pandas", "matplotlib", "qpsolvers", "pydantic", "rich", "typer", "skfem", "sklearn"}

AUTHORS = sorted(
    path
    for pattern in (
        "problems/**/*.py", "strategies/**/*.py", "examples/**/*.py", "vibench/cli/templates/*.template",
        "docs/problem.md", "docs/method.md", "docs/tutorial.md", "README.md",
    )
    for path in ROOT.glob(pattern)
)  # fmt: skip
IMPORTED = re.compile(r"^[ ]*(?:from|import) (vibench(?:\.[a-z_]+)*)\b", re.MULTILINE)
NAMES = re.compile(r"^[ ]*from (vibench(?:\.[a-z]+)?) import (\([^)]*\)|[^\n]+)", re.MULTILINE)
PUBLIC = {"vibench": vibench, **{f"vibench.{group}": getattr(vibench, group) for group in vibench.GROUPS}}


def test_sources_of_every_sort_import_nothing_but_the_public_surface() -> None:
    assert {path.suffix for path in AUTHORS} == {".py", ".template", ".md"}
    assert len(AUTHORS) > 30
    for path in AUTHORS:
        text = path.read_text(encoding="utf-8")
        assert set(IMPORTED.findall(text)) <= {*PUBLIC, "vibench.testing"}, path
        for module, names in NAMES.findall(text):
            imported = {name.strip() for name in names.strip("()").replace("\n", " ").split(",")} - {""}
            assert module == "vibench.testing" or imported <= set(PUBLIC[module].__all__), path


def test_every_public_name_is_documented_in_one_place_which_is_named() -> None:
    places = [(module, name) for module, found in PUBLIC.items() for name in found.__all__]
    for module, name in places:
        found = getattr(PUBLIC[module], name)
        assert found.__doc__ or not (inspect.isclass(found) or inspect.isfunction(found)), name
    assert len(places) == len({name for _, name in places})
    for group in vibench.GROUPS:
        for name in getattr(vibench, group).__all__:
            text = f"^'{name}' is in vibench.{group}: from vibench.{group} import {name}$"
            with pytest.raises(ImportError, match=text):
                getattr(vibench, name)
    with pytest.raises(AttributeError, match="nothing_called_so"):
        vibench.nothing_called_so  # noqa: B018


def loaded(code: str) -> set[str]:
    """The packages that a fresh interpreter has loaded after some code."""
    script = f"import sys\n{code}\nprint(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_each_part_of_vibench_loads_nothing_that_it_does_not_need() -> None:
    """Every run starts some, and every death of one another: pandas would take a quarter of their start."""
    assert loaded("import vibench") & HEAVY == set()
    assert loaded("from vibench import Status; Status.OK") & HEAVY == set()
    assert loaded("from vibench.qp.settings import SETTINGS") & (HEAVY | {"numpy"}) == set()
    code = "import vibench.results.read\nassert not any(name.startswith('vibench.stages') for name in sys.modules)"
    assert loaded(code) & {"qpsolvers", "matplotlib", "skfem"} == set()
    code = "import vibench.execution.worker, vibench.stages.cell_queries, vibench.stages.pictures"
    assert loaded(code) & {"matplotlib", "pandas", "rich", "typer"} == set()


LIBRARIES = HEAVY - {"typer"} | {"vibench_problems"}


def imported(command: str, *arguments: str, **environment: str) -> tuple[set[str], str]:
    """Top-level packages that a process of the installed command imports, and what it prints."""
    line = [sys.executable, "-X", "importtime", command, *arguments]
    done = subprocess.run(line, env=os.environ | environment, capture_output=True, text=True, check=True)
    lines = [line for line in done.stderr.splitlines() if line.startswith("import time:")]
    return {line.rsplit("|", 1)[1].strip().split(".")[0] for line in lines}, done.stdout


def test_help_lists_and_completion_import_no_library_they_do_not_need(command: str) -> None:
    """All commands are defined before any prints its help: one stands for the others."""
    for name in ("", "export"):
        packages, printed = imported(command, *name.split(), "--help")
        assert printed.startswith(f"Usage: vibench {name}".rstrip())
        assert "vibench" in packages
        assert packages & LIBRARIES == set()
    packages, printed = imported(command, "list")
    assert "obstacle" in printed
    assert packages & {"scipy", "pandas", "skfem", "qpsolvers", "matplotlib"} == set()
    packages, printed = imported(command, "list", "problems")
    assert "resolution: " in printed
    assert "skfem" in packages
    assert packages & {"pandas", "matplotlib", "qpsolvers"} == set()
    for line, word in (
        ("r", "replay"), ("run --dual ", "mcpg"), ("show quick --table ", "histories"),
        ("check obstacle --option ", "resolution="),
    ):  # fmt: skip
        words = {"COMP_WORDS": f"vibench {line}", "COMP_CWORD": str(line.count(" ") + 1)}
        packages, printed = imported(command, _VIBENCH_COMPLETE="complete_bash", **words)
        assert word in printed.split()
        assert "vibench" in packages
        package = {"vibench_problems"} if "--option" in line else set()  # the package that holds the module
        assert packages & (LIBRARIES - {"pydantic"}) == package  # typer itself checks the words before with pydantic
