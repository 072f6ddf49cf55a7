"""Commands on plugins: `vibench list`, and `vibench check` and `vibench new` for their authors."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Exit, Option

from vibench.cli.completion import lists, plugin_names
from vibench.cli.output import echo
from vibench.errors import RequestError, in_a_line, unknown_name

LISTS = {"problems": "problem", "primal": "primal strategy", "dual": "dual strategy", "studies": "study"}
"""Kind of plugin that each list shows; QP solvers are listed whether they are plugins or not."""

SECONDS = 60.0
"""Default of `--seconds`: that of `vibench.testing`, which is too slow to import for a help text."""


def list_plugins(
    what: Annotated[
        str | None,
        Argument(help="problems, primal, dual, solvers or studies; all of them by default.", autocompletion=lists),
    ] = None,
) -> None:
    """List problems, strategies, studies and QP solvers. Plugins are listed with their options."""
    import pandas as pd

    from vibench.terminal.console import print_frame

    if what is not None and what not in (*LISTS, "solvers"):
        raise unknown_name("list", what, (*LISTS, "solvers"))
    for title in [what] if what else [*LISTS, "solvers"]:
        rows = _solver_rows() if title == "solvers" else _plugin_rows(LISTS[title])
        columns = ("name", "version" if title == "solvers" else "from", "what", "options")
        print_frame(pd.DataFrame(rows, columns=columns), title)


def check_plugin(
    plugin: Annotated[
        str,
        Argument(
            metavar="PLUGIN", help="A name, problem|primal|dual:NAME, or MODULE:CLASS.", autocompletion=plugin_names
        ),
    ],
    option: Annotated[list[str] | None, Option(metavar="KEY=VALUE", help="Option of the plugin (repeatable).")] = None,
    seconds: Annotated[float, Option(min=0.0, help="Longest time that one call of the plugin may take.")] = SECONDS,
) -> None:
    """Check a plugin: shapes, signs, tolerances, repetition, time.

    One line per requirement of the interface; exit code 1 if one is violated.
    """
    from vibench.study import registry
    from vibench.testing import Verdict, examine_dual, examine_primal, examine_problem

    kind, name, cls = _find(plugin)
    given = dict(map(_option, option or []))
    title = f"{registry.WORDS[kind]} '{name}'"
    options = registry.checked_arguments(cls, title, given)
    if kind == "problem" and "resolution" not in given:
        try:
            options = registry.checked_arguments(cls, title, {"resolution": "coarse", **given})
            title += ", at resolution coarse (--option resolution=… for another)"
        except RequestError:  # the problem has no resolution of that name
            pass
    echo(title)
    examine: Any = {"problem": examine_problem, "dual": examine_dual, "primal": examine_primal}[kind]
    findings = examine(partial(cls, **options), seconds=seconds)
    for finding in findings:
        echo(str(finding))
    counts = {verdict: sum(finding.verdict is verdict for finding in findings) for verdict in Verdict}
    echo(", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
    if counts[Verdict.FAILED]:
        raise Exit(1)


def new_plugin(
    kind: Annotated[
        Literal["problem", "primal", "dual"], Argument(metavar="problem|primal|dual", help="Kind of plugin.")
    ],
    name: Annotated[str, Argument(metavar="NAME", help="Name of the plugin: a-z, 0-9 and hyphens.")],
    out: Annotated[Path, Option(metavar="DIR", help="Folder in which the package is created.")] = Path(),
) -> None:
    """Write a package with a new plugin, to install and edit.

    The package passes its tests as generated. Existing files are never overwritten.
    """
    from vibench.cli import scaffold
    from vibench.study.registry import WORDS

    folder = scaffold.write_package(kind, name, out)
    echo(
        f"{folder}: a {WORDS[kind]} called '{name}' that works as it is",
        f"  pip install -e {folder}",
        f"  vibench check {kind}:{name}",
        f"the code to edit: {scaffold.module_file(folder, kind, name)}; what to do next: {folder / 'README.md'}",
    )


def _plugin_rows(kind: str) -> list[tuple[str, str, str, str]]:
    """Name, origin, description and options of every plugin of a kind; of one that does not load, the error."""
    from vibench.study import registry
    from vibench.study.cells import expand
    from vibench.study.reader import read_study

    rows = []
    for name in registry.names(kind):
        options = []
        try:
            if kind == "study":
                description = f"{len(expand(read_study(name)))} cells"
            else:
                description = (registry.load(kind, name).__doc__ or "").strip().split("\n")[0]
                options = registry.options(kind, name)
        except RequestError as error:
            description = str(error)
        lines = [f"{o.name}: {o.expected}" + f" = {o.default}" * bool(o.default) for o in options]
        rows.append((name, registry.version(kind, name), description, "\n".join(lines)))
    return rows


def _solver_rows() -> list[tuple[str, str, str, str]]:
    from vibench import provenance
    from vibench.qp.settings import SETTINGS
    from vibench.qp.solve import installed_solvers
    from vibench.study import registry

    plugins = registry.names("QP solver")
    installed = installed_solvers(plugins)
    return [
        (name, provenance.solver_version(name), "installed" if name in installed else "not installed", "")
        for name in sorted({*SETTINGS, *plugins})
    ]


def _find(text: str) -> tuple[str, str, type]:
    """Kind (a key of `registry.WORDS`), name and class of the plugin that NAME, KIND:NAME or MODULE:CLASS refers to.

    Raises
    ------
    RequestError
        If there is no such plugin, or several.
    """
    from vibench.study.registry import WORDS, load, names

    prefix, colon, rest = text.partition(":")
    if colon and prefix not in WORDS:
        return _find_class(prefix, rest)
    name = rest if colon else text
    kinds = [prefix] if colon else [word for word, kind in WORDS.items() if text in names(kind)]
    if not kinds:
        raise unknown_name("plugin", text, (known for kind in WORDS.values() for known in names(kind)))
    if len(kinds) > 1:
        raise RequestError(f"several plugins are called '{text}': say {' or '.join(f'{k}:{text}' for k in kinds)}")
    return kinds[0], name, load(WORDS[kinds[0]], name)


def _find_class(module: str, name: str) -> tuple[str, str, type]:
    """Kind, MODULE:CLASS and class of an importable plugin; modules in the current folder count."""
    import importlib

    from vibench.study.registry import BASES, WORDS

    title = f"'{module}:{name}'"
    if not module or not all(part.isidentifier() for part in [*module.split("."), name]):
        raise RequestError(f"{title} is neither KIND:NAME (problem, primal or dual) nor MODULE:CLASS")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        found = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # noqa: BLE001  the module may raise anything
        raise RequestError(f"{title}: the module cannot be imported: {in_a_line(error)}") from None
    classes = {key: value for key, value in vars(found).items() if isinstance(value, type)}
    if name not in classes:
        plugins = [c for c in classes.values() if issubclass(c, tuple(BASES.values())) and c.__module__ == module]
        raise unknown_name(f"class of the module {module}", name, (plugin.__name__ for plugin in plugins))
    for word, kind in WORDS.items():
        if issubclass(classes[name], BASES[kind]):
            return word, f"{module}:{name}", classes[name]
    raise RequestError(f"{title} is no subclass of Problem, PrimalStrategy or DualStrategy")


def _option(text: str) -> tuple[str, Any]:
    """Key and value of "key=value"; the value is read as JSON if it is valid JSON, as text otherwise."""
    import json

    key, equals, value = text.partition("=")
    if not equals or not key:
        raise RequestError(f"--option '{text}' is not of the form KEY=VALUE")
    try:
        return key, json.loads(value)
    except json.JSONDecodeError:
        return key, value
