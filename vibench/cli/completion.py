"""Words that a shell completes, and the examples at the end of every command's help.

A shell waits for completions, so names of plugins are read from entry points and nothing heavy is imported at the top.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import typer

from vibench.errors import VibenchError
from vibench.results.columns import TABLES

EXAMPLES: Mapping[str, tuple[str, ...]] = {
    "run": (
        "vibench run",
        "vibench run quick --solver piqp --dry-run",
        "vibench run my-study.toml --jobs 4 --out results",
        "vibench run quick --pod-tol 1e-2 --pod-tol 1e-3",
    ),
    "list": ("vibench list", "vibench list solvers"),
    "show": ("vibench show quick", "vibench show quick --table benefits", "vibench show runs/quick --format csv"),
    "report": ("vibench report quick", "vibench report runs/quick --out quick.html"),
    "diff": ("vibench diff runs/before runs/after", "vibench diff runs/before runs/after --limit 1.1 --format json"),
    "replay": ("vibench replay quick 3f9a", "vibench replay quick 3f9a --query 7"),
    "export-qps": ("vibench export-qps quick programs",),
    "export-model": (
        "vibench export-model quick 3f9a membrane.npz",
        "vibench export-model quick 3f9a membrane.npz --interpolate 1e-6 --c",
    ),
    "check": (
        "vibench check my-problem --option resolution=medium",
        "vibench check primal:mine",
        "vibench check my_package.cable:Cable",
    ),
    "new": ("vibench new problem cable", "vibench new dual my-cone --out packages"),
    "clean": ("vibench clean --dry-run", "vibench clean --older-than 30"),
    "doctor": ("vibench doctor", "vibench doctor --out /scratch/runs"),
}
"""By command."""


def examples(command: str) -> str:
    """The last paragraph of a command's help; the leading backspace makes click keep its line breaks."""
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in EXAMPLES[command])])


def words(known: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Completes the words of a function, which is called when a shell asks."""

    def complete(incomplete: str) -> list[str]:
        return _beginning(incomplete, known())

    return complete


def names(*groups: str) -> Callable[[str], list[str]]:
    """Completes names of plugins in groups of entry points: "problems" stands for `vibench.problems`."""
    return words(lambda: _registered(*groups))


plugin_names = names("problems", "primal_strategies", "dual_strategies")
lists = words(lambda: ("problems", "dual", "primal", "solvers", "studies"))
table_names = words(lambda: ("summary", "benefits", *TABLES))


def studies(incomplete: str) -> list[str]:
    """Completes registered studies, and study files in the current folder or in the folder of the word."""
    folder, slash, _ = incomplete.rpartition("/")
    files = (f"{folder}{slash}{path.name}" for path in Path(folder + slash).glob("*.toml"))
    return sorted([*_beginning(incomplete, _registered("studies")), *_beginning(incomplete, files)])


def solvers(incomplete: str) -> list[str]:
    """Completes QP solvers, installed or not."""
    from vibench.qp.settings import SETTINGS

    return _beginning(incomplete, {*SETTINGS, *_registered("qp_solvers")})


def runs(incomplete: str) -> list[str]:
    """Completes names of the runs under `runs/`."""
    from vibench.results.database import FILE

    return _beginning(incomplete, (path.parent.name for path in Path("runs").glob(f"*/{FILE}")))


def cells(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Completes keys of the cells of the run named before, each with a description."""
    from vibench.results import tables

    try:
        found = tables.read(tables.results_file(str(context.params.get("run"))), "cells")
    except (VibenchError, OSError, sqlite3.Error):
        return []
    rows = found[["cell", "problem", "dual", "primal", "solver"]].astype(str).itertuples(index=False)
    return sorted((key, " · ".join(axes)) for key, *axes in rows if key.startswith(incomplete))


def _registered(*groups: str) -> set[str]:
    """Names in the entry points themselves: `vibench.study.registry` would import SciPy and pydantic."""
    from importlib.metadata import entry_points

    return {entry.name for group in groups for entry in entry_points(group=f"vibench.{group}")}


def _beginning(word: str, known: Iterable[str]) -> list[str]:
    """The known names that begin with a word, if a prompt can show them; none, and no error, if they cannot be read."""
    try:
        return sorted(name for name in known if name.startswith(word) and name.isprintable())
    except OSError:
        return []
