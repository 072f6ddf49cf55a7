"""Words that a shell completes, and the examples at the end of every command's help.

A shell waits for completions, so names of plugins are read from entry points and nothing heavy is imported at the top.
"""

from __future__ import annotations

import contextlib
import io
import os
import sqlite3
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from importlib.resources import files
from pathlib import Path

import typer

from vibench.errors import VibenchError
from vibench.plugins.kinds import CHECKED, PluginKind
from vibench.qp.settings import SETTINGS
from vibench.results.schema import STORED, TABLES
from vibench.results.sqlite import FILE


def examples(command: str) -> str:
    """The last paragraph of a command's help; the leading backspace makes click keep its line breaks."""
    lines = (files("vibench.cli") / "examples.txt").read_text(encoding="utf-8").splitlines()
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in lines if line.split()[1] == command)])


@contextlib.contextmanager
def whole_words() -> Iterator[None]:
    """Give the completion of bash words that it breaks at ":" and "=": `primal:name` and `key=value` are one."""
    # Bash completes only what comes after the last break of such a word, so what is printed begins there.
    # Typer checks words with pydantic, which would look for plugins of its own.
    if "_VIBENCH_COMPLETE" in os.environ:
        os.environ["PYDANTIC_DISABLE_PLUGINS"] = "__all__"
    if os.environ.get("_VIBENCH_COMPLETE") != "complete_bash":
        yield
        return
    line, current = os.environ["COMP_WORDS"], int(os.environ["COMP_CWORD"])
    pieces = line.split("\n" if "\n" in line else " ")
    # Join what bash has broken: a piece belongs to the word before if one of both touches a break.
    joined: list[str] = []
    for k, piece in enumerate(pieces[: current + 1]):
        together = joined and (piece[:1] in (":", "=") or (piece and pieces[k - 1][-1:] in (":", "=")))
        joined[-1 if together else len(joined) :] = [joined[-1] + piece if together else piece]
    last = joined[-1] if len(joined) > 1 else ""
    os.environ.update(COMP_WORDS="\n".join(joined), COMP_CWORD=str(len(joined) - 1))
    try:
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            yield
    finally:
        done = max(last.rfind(":"), last.rfind("=")) + 1
        sys.stdout.write("".join(f"{line[done:]}\n" for line in printed.getvalue().splitlines()))


def words(choices: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """A completion with the words of a function, which is called when a shell asks."""
    return lambda incomplete: _beginning(incomplete, choices())


def _registered(*kinds: PluginKind) -> set[str]:
    from vibench.plugins.registry import registered

    return {name for kind in kinds for name in registered(kind)}


def _beginning(word: str, choices: Iterable[str]) -> list[str]:
    """The choices that begin with a word, if a prompt can show them; none, and no error, if they cannot be read."""
    try:
        return sorted(name for name in choices if name.startswith(word) and name.isprintable())
    except OSError:
        return []


problems, primals, duals, formulations = (
    words(partial(_registered, CHECKED[kind])) for kind in ("problem", "primal", "dual", "formulation")
)
# QP solvers, installed or not.
solvers = words(lambda: {*SETTINGS, *_registered(PluginKind.SOLVER)})
runs = words(lambda: (path.parent.name for path in Path("runs").glob(f"*/{FILE}")))
error_measures = words(lambda: ("solution", "u", "lambda", "output:"))
corrections = words(lambda: ("none", "feasible", "auto"))
lists = words(lambda: (kind.plural for kind in PluginKind))
table_names = words(lambda: ("summary", "best", "benefits", *TABLES))
cell_columns = words(lambda: STORED["cells"])


def plugins(incomplete: str) -> list[str]:
    """Names of plugins, alone or with their kind before them: "primal:NAME", "solver:NAME"."""
    kind, colon, name = incomplete.partition(":")
    if not colon:
        return _beginning(incomplete, [*_registered(*CHECKED.values()), *(f"{kind}:" for kind in CHECKED)])
    offered = solvers(name) if kind == "solver" else _registered(CHECKED[kind]) if kind in CHECKED else ()
    return _beginning(incomplete, (f"{kind}:{one}" for one in offered))


def plugin_options(context: typer.Context, incomplete: str) -> list[str]:
    """Options of the plugin that the line names, as "resolution=", without importing it."""
    from vibench.plugins.registry import find

    word, colon, name = (context.params.get("plugin") or "".join(context.args[:1])).rpartition(":")
    kinds = [CHECKED[word]] if word in CHECKED else [] if colon else CHECKED.values()
    options = {option for kind in kinds for option in find(kind, name).names_of_options}
    return _beginning(incomplete, (f"{option}=" for option in options))


def studies(incomplete: str) -> list[str]:
    """Registered studies, and study files in the current folder or in the folder of the word."""
    folder, slash, _ = incomplete.rpartition("/")
    found = (f"{folder}{slash}{path.name}" for path in Path(folder + slash).glob("*.toml"))
    return sorted([*_beginning(incomplete, _registered(PluginKind.STUDY)), *_beginning(incomplete, found)])


def cells(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Keys of the cells of the run that the line names, each with a description."""
    from vibench.results.read import read_table, results_file

    # A prompt shows no error; the command will.
    try:
        table = read_table(results_file(str(context.params.get("run"))), "cells")
    except (VibenchError, OSError, sqlite3.Error):
        return []
    rows = table[["cell", "problem", "dual", "primal", "solver"]].astype(str).itertuples(index=False)
    return sorted((key, " · ".join(axes)) for key, *axes in rows if key.startswith(incomplete))


def column_names(context: typer.Context, incomplete: str) -> list[str]:
    """The last name in a list of columns of the table that `--table` names."""
    from vibench.results import ranking

    table = str(context.params.get("table") or "summary")
    source = {"summary": "cells", "best": "cells", "benefits": "thresholds"}.get(table, table)
    computed = {"best": ["error_below"], "benefits": ranking.error_columns()}.get(table, ())
    before, comma, last = incomplete.rpartition(",")
    # `--sort -NAME` sorts the largest first; the sign is no part of the name.
    sign = "-" * last.startswith("-")
    return [
        f"{before}{comma}{sign}{name}"
        for name in _beginning(last.removeprefix("-"), [*(STORED[source] if source in TABLES else ()), *computed])
    ]
