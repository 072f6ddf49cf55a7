"""Commands on plugins: `vibench list`, and `vibench check` and `vibench new` for their authors."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Exit, Option

from vibench.cli.completion import lists, plugin_options, plugins, runs
from vibench.errors import RequestError, VibenchError, in_a_line, unknown_name
from vibench.study.kinds import CHECKED, FIGURE, KINDS, SOLVER, STUDY
from vibench.terminal.output import echo
from vibench.text import parsed_json

LISTS = {kind.listed: kind.title for kind in KINDS if kind is not SOLVER}
"""Kind of plugin that each list shows; QP solvers are listed whether they are plugins or not."""

HEADINGS = ("name", "from", "what", "options")

if TYPE_CHECKING:
    Word = str
else:
    Word = Literal[tuple(kind.word for kind in CHECKED)]

SECONDS = 120.0
"""Default of `--seconds`: that of `vibench.testing`, which is too slow to import for a help text."""


@dataclass(frozen=True)
class Found:
    """A plugin: its kind (a key of `registry.WORDS`), its name, itself, and where it is, "module:attribute"."""

    kind: str
    name: str
    plugin: Any
    reference: str


def list_plugins(
    what: Annotated[
        str | None,
        Argument(
            help=f"{', '.join([*LISTS][:-1])}, {[*LISTS][-1]} or {SOLVER.listed}; all of them by default.",
            autocompletion=lists,
        ),
    ] = None,
) -> None:
    """List problems, strategies, figures, studies and QP solvers.

    Plugins are listed with their options; a list of one kind has the values of the options, too.
    """
    from vibench.cli import overview
    from vibench.study.entry_points import unreadable
    from vibench.terminal.console import print_rows

    if what is None:
        for title in overview.LISTS:
            rows = _solvers_by_version() if title == "solvers" else list(overview.rows(title))
            print_rows(rows, HEADINGS, title)
        echo("", "what the options of one kind are, and whether its plugins can be loaded:")
        echo(f"  vibench list {'|'.join(overview.LISTS)}")
    elif what in overview.LISTS:
        print_rows(_solver_rows() if what == "solvers" else _plugin_rows(LISTS[what]), HEADINGS, what)
    else:
        raise unknown_name("list", what, overview.LISTS)
    for distribution, reason in unreadable().items():
        echo(f"{distribution}: {reason}")


def check_plugin(
    plugin: Annotated[
        str,
        Argument(
            metavar="PLUGIN",
            help=f"A name, {'|'.join(kind.word for kind in CHECKED)}:NAME, or MODULE:NAME.",
            autocompletion=plugins,
        ),
    ],
    option: Annotated[
        list[str] | None,
        Option(metavar="KEY=VALUE", help="Option of the plugin (repeatable).", autocompletion=plugin_options),
    ] = None,
    seconds: Annotated[float, Option(min=0.0, help="Time limit for all checks; a slow plugin gets fewer.")] = SECONDS,
    run: Annotated[
        str | None,
        Option(metavar="RUN", help="Run that figures are drawn from; a made-up one by default.", autocompletion=runs),
    ] = None,
) -> None:
    """Check a plugin: shapes, signs, tolerances, repetition, time.

    One line per requirement of the interface, as soon as it is checked; exit code 1 if one is violated.
    """
    from vibench.results.tables import results_file
    from vibench.testing import Verdict
    from vibench.testing.processes import Examination, examine_in_process

    found = _find(plugin)
    if run is not None and found.kind != "figure":
        raise RequestError(f"--run is for figure plugins; {_title(found)} is none")
    given = {} if run is None else {"run": str(results_file(run).resolve())}
    options, remark = _options(found, dict(map(key_value, option or [])))
    echo(f"{_title(found)}{remark}")
    examination = Examination(found.kind, found.reference, options, seconds, given)
    results = examine_in_process(examination, lambda result: echo(str(result)))
    counts = {verdict: sum(result.verdict is verdict for result in results) for verdict in Verdict}
    told = (f"{count} {verdict}" for verdict, count in counts.items() if count or verdict is not Verdict.WARNING)
    echo(", ".join(told))
    if counts[Verdict.FAILED]:
        raise Exit(1)


def _title(found: Found) -> str:
    from vibench.study.registry import WORDS

    return f"{WORDS[found.kind]} '{found.name}'"


def _options(found: Found, given: dict[str, Any]) -> tuple[dict[str, Any] | None, str]:
    """Options of a plugin, and what its title says of them; a problem is as coarse as it can be, if not told."""
    from vibench.study import registry
    from vibench.testing.solvers import of_qpsolvers

    title = _title(found)
    if found.kind == "solver":
        if given:
            raise RequestError(f"{title} has no options")
        return ({"solver": found.name} if found.plugin is of_qpsolvers else None), ""
    if found.kind == "sampling":
        return _sampling_options(found, given)
    options = registry.checked_arguments(found.plugin, title, given)
    if found.kind == "problem" and "resolution" not in given:
        with suppress(RequestError):  # the problem has no resolution of that name
            options = registry.checked_arguments(found.plugin, title, {"resolution": "coarse", **given})
            return options, ", at resolution coarse (--option resolution=… for another)"
    return options, ""


def _sampling_options(found: Found, given: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Options of a sampling strategy; a size and a seed that it needs are chosen, if not told."""
    from vibench.study import registry

    needed = {option.name for option in registry.options_of(found.plugin) if not option.default}
    chosen = {name: value for name, value in SAMPLE.items() if name in needed and name not in given}
    options = registry.checked_arguments(found.plugin, _title(found), chosen | given)
    told = " and ".join(f"{name} = {value}" for name, value in chosen.items())
    return options, f", with {told} (--option {next(iter(chosen))}=… for another)" if chosen else ""


SAMPLE = {"size": 16, "seed": 0}
"""Options of a sampling strategy that `vibench check` chooses, where it needs them."""


def new_plugin(
    kind: Annotated[Word, Argument(metavar="KIND", help="Kind of plugin.")],
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
    from vibench.study.matrix import expand
    from vibench.study.reader import read_study

    rows = []
    for name in registry.names(kind):
        options, columns = [], []
        try:
            if kind == STUDY.title:
                description = f"{len(expand(read_study(name)))} cells"
            else:
                description = (registry.load(kind, name).__doc__ or "").strip().split("\n")[0]
                options = registry.options(kind, name)
            columns = _columns(name) if kind == FIGURE.title else []
        except VibenchError as error:
            description = str(error)
        except Exception as error:  # noqa: BLE001  annotations of plugins are evaluated
            description = f"{kind} '{name}' cannot be read: {in_a_line(error)}"
        lines = [f"{o.name}: {o.expected}" + f" = {o.default}" * bool(o.default) for o in options]
        rows.append((name, registry.version(kind, name), description, "\n".join([*lines, *columns])))
    return rows


def _columns(name: str) -> list[str]:
    """The columns that a figure plugin adds to tables, a line for each."""
    from vibench.results.plugin_columns import declared, loaded

    return [
        f"column {one.name} of {one.table}{f' [{one.unit}]' * bool(one.unit)}: {one.meaning}"
        for one in declared(name, loaded(name))
    ]


def _solvers_by_version() -> list[tuple[str, str, str, str]]:
    """QP solvers and their versions, without loading them."""
    from vibench import provenance
    from vibench.cli import overview
    from vibench.qp.settings import SETTINGS

    ours = []
    for name in SETTINGS:
        version = provenance.solver_version(name)
        package = provenance.solver_distribution(name)
        ours.append((name, version, "" if version else f"not installed: `pip install {package}`", ""))
    return sorted([*ours, *overview.rows("solvers")])


def _solver_rows() -> list[tuple[str, str, str, str]]:
    from vibench import provenance
    from vibench.qp.settings import SETTINGS
    from vibench.qp.solve import installed_solvers
    from vibench.study import registry

    plugins = registry.names("QP solver")
    installed = installed_solvers(plugins)
    rows = []
    for name in sorted({*SETTINGS, *plugins}):
        state = registry.conflict("QP solver", name) or ("installed" if name in installed else "not installed")
        rows.append((name, provenance.solver_version(name), state, ""))
    return rows


def _find(text: str) -> Found:
    """The plugin that NAME, KIND:NAME or MODULE:NAME refers to.

    Raises
    ------
    RequestError
        If there is no such plugin, or several.
    """
    from vibench.study.registry import WORDS, load, reference

    prefix, colon, rest = text.partition(":")
    if colon and prefix not in WORDS:
        return _find_object(prefix, rest)
    name = rest if colon else text
    kinds = [prefix] if colon else [word for word in WORDS if text in _names(word)]
    if not kinds:
        raise unknown_name("plugin", text, (known for word in WORDS for known in _names(word)))
    if len(kinds) > 1:
        raise RequestError(f"several plugins are called '{text}': say {' or '.join(f'{k}:{text}' for k in kinds)}")
    kind = WORDS[kinds[0]]
    if name not in _names(kinds[0]):
        raise unknown_name(kind, name, _names(kinds[0]))
    if kinds[0] == "solver" and name in _of_qpsolvers():
        from vibench.testing.solvers import of_qpsolvers

        return Found("solver", name, of_qpsolvers, f"{of_qpsolvers.__module__}:{of_qpsolvers.__name__}")
    return Found(kinds[0], name, load(kind, name), reference(kind, name))


def _names(word: str) -> list[str]:
    """Names of the plugins of a kind, a key of `registry.WORDS`; of solvers those that are installed."""
    from vibench.study.registry import WORDS, names

    return names(WORDS[word]) + (_of_qpsolvers() if word == "solver" else [])


def _of_qpsolvers() -> list[str]:
    """The installed solvers that no plugin registers."""
    from vibench.qp.solve import installed_solvers
    from vibench.study.registry import names

    return [solver for solver in installed_solvers() if solver not in names("QP solver")]


def _find_object(module: str, name: str) -> Found:
    """A plugin in an importable module; modules in the current folder count. A function is a QP solver."""
    import importlib

    from vibench.study.registry import BASES, WORDS

    where = f"{module}:{name}"
    title = f"'{where}'"
    if not module or not all(part.isidentifier() for part in [*module.split("."), name]):
        raise RequestError(f"{title} is neither KIND:NAME ({', '.join(WORDS)}) nor MODULE:NAME")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        contents = vars(importlib.import_module(module))
    except (Exception, SystemExit) as error:  # noqa: BLE001  the module may raise anything
        raise RequestError(f"{title}: the module cannot be imported: {in_a_line(error)}") from None
    found, bases = contents.get(name), tuple(BASES.values())
    if isinstance(found, type):
        for word, kind in WORDS.items():
            if kind in BASES and issubclass(found, BASES[kind]):
                return Found(word, where, found, where)
        names = ", ".join(base.__name__ for base in bases)
        raise RequestError(f"{title} is no subclass of {names}, and no QP solver")
    if callable(found):
        return Found("solver", where, found, where)
    classes = [value for value in contents.values() if isinstance(value, type)]
    own = [value.__name__ for value in classes if issubclass(value, bases) and value.__module__ == module]
    raise unknown_name(f"plugin of the module {module}", name, own)


def key_value(text: str) -> tuple[str, Any]:
    """Key and value of "key=value"; the value is read as JSON if it is valid JSON, as text otherwise."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise RequestError(f"--option '{text}' is not of the form KEY=VALUE")
    try:
        return key, parsed_json(value)
    except ValueError:
        return key, value
