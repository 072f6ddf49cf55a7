"""What a shell and `--help` are told: values to complete words with, and examples of every command."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import typer

from vibench.errors import VibenchError
from vibench.qp.settings import SETTINGS
from vibench.results import tables
from vibench.results.columns import TABLES
from vibench.results.database import FILE
from vibench.study import registry

Complete = Callable[[str], list[str]]
"""From the beginning of a word to the words it may become."""

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
    """The last lines of a command's help, kept as they are."""
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in EXAMPLES[command])])


def names(kind: str) -> Complete:
    """Completes names of one kind of plugin."""

    def complete(incomplete: str) -> list[str]:
        return _beginning(incomplete, lambda: registry.names(kind))

    return complete


def plugin_names(incomplete: str) -> list[str]:
    """Completes names of problems and strategies."""
    return _beginning(incomplete, lambda: {name for kind in registry.WORDS.values() for name in registry.names(kind)})


def studies(incomplete: str) -> list[str]:
    """Completes registered studies and the study files here, or in the folder the word names."""
    return _beginning(incomplete, lambda: [*registry.names("study"), *_study_files(incomplete)])


def _study_files(word: str) -> Iterable[str]:
    folder = word.rpartition("/")[0]
    for path in Path(folder or ("/" if word.startswith("/") else ".")).glob("*.toml"):
        yield f"{folder}/{path.name}" if "/" in word else path.name


def solvers(incomplete: str) -> list[str]:
    """Completes QP solvers, installed or not."""
    return _beginning(incomplete, lambda: {*SETTINGS, *registry.names("QP solver")})


def runs(incomplete: str) -> list[str]:
    """Completes names of the runs under `runs/`."""
    return _beginning(incomplete, lambda: (path.parent.name for path in Path("runs").glob(f"*/{FILE}")))


def lists(incomplete: str) -> list[str]:
    """Completes what `vibench list` lists."""
    return _beginning(incomplete, lambda: ("problems", "dual", "primal", "solvers", "studies"))


def table_names(incomplete: str) -> list[str]:
    """Completes tables of a run."""
    return _beginning(incomplete, lambda: ("summary", "benefits", *TABLES))


def cells(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Completes keys of the cells of the run named before, each with what it is."""
    try:
        found = tables.read(tables.results_file(str(context.params.get("run"))), "cells")
    except (VibenchError, OSError, sqlite3.Error):
        return []
    columns = (found[name] for name in ("cell", "problem", "dual", "primal", "solver"))
    rows = [(str(key), " · ".join(map(str, what))) for key, *what in zip(*columns, strict=True)]
    return sorted(row for row in rows if row[0].startswith(incomplete))


def _beginning(word: str, known: Callable[[], Iterable[str]]) -> list[str]:
    """The known names that begin like a word; none where they cannot be known, for a shell wants no complaints."""
    try:
        return sorted(name for name in known() if name.startswith(word))
    except (VibenchError, OSError):
        return []
