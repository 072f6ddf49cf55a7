"""The commands for authors of plugins: `vibench check` and `vibench new`."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from vibench import testing
from vibench.cli import completion, scaffold
from vibench.cli.console import new_console
from vibench.errors import RequestError, in_a_line, unknown_name
from vibench.study import registry
from vibench.study.registry import BASES, WORDS
from vibench.testing import Finding, Verdict

COARSE: Mapping[str, Any] = {"resolution": "coarse"}
"""Options that a problem is checked with where it takes them and the user asks for no other resolution."""


@dataclass(frozen=True)
class Target:
    """A plugin to be checked: a key of `registry.WORDS`, what to call it, and its class."""

    kind: str
    name: str
    plugin: type


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.command("check", epilog=completion.examples("check"))(check_plugin)
    app.command("new", epilog=completion.examples("new"))(new_plugin)


def check_plugin(
    plugin: Annotated[
        str,
        typer.Argument(
            metavar="PLUGIN",
            help="A name, KIND:NAME (problem, primal, dual), or MODULE:CLASS.",
            autocompletion=completion.plugin_names,
        ),
    ],
    option: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="An option of the plugin (repeatable).")
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Longest time that one call of the plugin may take.")
    ] = testing.SECONDS,
) -> None:
    """Check a plugin: shapes, signs, tolerances, determinism, time.

    One line for each thing that vibench takes for granted; exit code 1 if one of them does not hold.
    """
    target = _target(plugin)
    given = dict(map(_option, option or []))
    what = f"{WORDS[target.kind]} '{target.name}'"
    options = registry.checked_arguments(target.plugin, what, given)
    remark = ""
    if target.kind == "problem" and "resolution" not in given and (coarse := _coarse(target.plugin, what, given)):
        options, remark = coarse, ", at resolution coarse (--option resolution=… for another)"
    console = new_console()
    console.print(f"{what}{remark}", markup=False, soft_wrap=True)
    findings = _examine(target.kind, partial(target.plugin, **options), seconds)
    for finding in findings:
        console.print(str(finding), markup=False, soft_wrap=True)
    counts = [sum(finding.verdict is verdict for finding in findings) for verdict in Verdict]
    console.print(", ".join(f"{count} {verdict}" for count, verdict in zip(counts, Verdict, strict=True)))
    if any(finding.verdict is Verdict.FAILED for finding in findings):
        raise typer.Exit(1)


def new_plugin(
    kind: Annotated[
        Literal["problem", "primal", "dual"], typer.Argument(metavar="problem|primal|dual", help="What to make.")
    ],
    name: Annotated[str, typer.Argument(metavar="NAME", help="What to register it as: a-z, 0-9 and hyphens.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder in which the new folder is made.")] = Path(),
) -> None:
    """Write a package with a new plugin, to install and edit.

    It passes its tests as it is. Nothing is written over.
    """
    folder = scaffold.write_package(kind, name, out)
    console = new_console()
    for line in (
        f"{folder}: a {WORDS[kind]} called '{name}' that works as it is",
        f"  pip install -e {folder}",
        f"  vibench check {kind}:{name}",
        f"the code to edit: {scaffold.module_file(folder, kind, name)}; what to do next: {folder / 'README.md'}",
    ):
        console.print(line, markup=False, soft_wrap=True)


def _target(text: str) -> Target:
    """The plugin that a text names.

    Raises
    ------
    RequestError
        If there is none, or several.
    """
    prefix, colon, rest = text.partition(":")
    if colon and prefix in WORDS:
        return Target(prefix, rest, registry.load(WORDS[prefix], rest))
    if colon:
        return _imported(prefix, rest)
    kinds = [word for word, kind in WORDS.items() if text in registry.names(kind)]
    if not kinds:
        raise unknown_name("plugin", text, (name for kind in WORDS.values() for name in registry.names(kind)))
    if len(kinds) > 1:
        choices = " or ".join(f"{word}:{text}" for word in kinds)
        raise RequestError(f"several plugins are called '{text}': say {choices}")
    return Target(kinds[0], text, registry.load(WORDS[kinds[0]], text))


def _imported(module: str, name: str) -> Target:
    """A class that is importable, from the current folder as well."""
    where = f"'{module}:{name}'"
    if not module or not all(part.isidentifier() for part in [*module.split("."), name]):
        raise RequestError(f"{where} is neither KIND:NAME (problem, primal or dual) nor MODULE:CLASS")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        found = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # noqa: BLE001  importing a plugin runs code of strangers
        raise RequestError(f"{where}: the module cannot be imported: {in_a_line(error)}") from None
    classes = {key: value for key, value in vars(found).items() if isinstance(value, type)}
    if name not in classes:
        own = _own(classes.values(), module)
        raise unknown_name(f"class of the module {module}", name, own)
    plugin = classes[name]
    kinds = [word for word, kind in WORDS.items() if issubclass(plugin, BASES[kind])]
    if not kinds:
        raise RequestError(f"{where} is no subclass of Problem, PrimalStrategy or DualStrategy")
    return Target(kinds[0], f"{module}:{name}", plugin)


def _own(classes: Iterable[type], module: str) -> list[str]:
    """Names of the plugins among the classes that a module defines."""
    bases = tuple(BASES.values())
    return [each.__name__ for each in classes if issubclass(each, bases) and each.__module__ == module]


def _option(text: str) -> tuple[str, Any]:
    """Key and value of "key=value", the value read as JSON where it is."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise RequestError(f"--option '{text}' is not of the form KEY=VALUE")
    try:
        return key, json.loads(value)
    except json.JSONDecodeError:
        return key, value


def _coarse(plugin: type, what: str, given: Mapping[str, Any]) -> dict[str, Any] | None:
    """Options at the coarsest named resolution, `None` if the plugin does not know it."""
    try:
        return registry.checked_arguments(plugin, what, {**COARSE, **given})
    except RequestError:
        return None


def _examine(kind: str, create: Callable[[], Any], seconds: float) -> list[Finding]:
    if kind == "problem":
        return testing.examine_problem(create, seconds=seconds)
    if kind == "dual":
        return testing.examine_dual(create, seconds=seconds)
    return testing.examine_primal(create, seconds=seconds)
