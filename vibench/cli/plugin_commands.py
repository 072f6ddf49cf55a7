"""Commands on plugins: `vibench list`, and `vibench check`, `vibench new` and `vibench bench` for their authors."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Exit, Option

from vibench.cli.completion import lists, plugin_options, plugins, studies
from vibench.cli.console import echo, print_frame
from vibench.cli.result_commands import FormOption
from vibench.errors import RequestError, VibenchError, in_a_line, unknown_name
from vibench.plugins.kinds import CHECKED, PluginKind
from vibench.text import parsed_json

Row = tuple[str, str, str, str]

if TYPE_CHECKING:
    import pandas as pd

    from vibench.benchmarks.comparison import Timed
    from vibench.plugins.registry import RegisteredPlugin

    NewKind = str
else:
    NewKind = Literal[(*CHECKED, "study", "pack")]


def list_plugins(
    what: Annotated[
        str | None, Argument(help=f"{', '.join(k.plural for k in PluginKind)}; default: all.", autocompletion=lists)
    ] = None,
    sizes: Annotated[bool, Option("--sizes", help="Build every problem by default, and print its size.")] = False,
) -> None:
    """List problems, strategies, studies and QP solvers.

    Plugins are listed with their options; a list of one kind has the values of the options, too.
    """
    if sizes and what != PluginKind.PROBLEM.plural:
        raise RequestError(f"--sizes is for `vibench list {PluginKind.PROBLEM.plural}`")
    from vibench.cli.console import print_rows
    from vibench.plugins.registry import unreadable

    headings = ("name", "from", "what", "options")
    known = {kind.plural: kind for kind in PluginKind}
    if what is None:
        for kind in PluginKind:
            rows = _solver_rows(load=False) if kind is PluginKind.SOLVER else _read_rows(kind)
            print_rows(rows, headings, kind.plural)
        echo("", "what the options of one kind are, and whether its plugins can be loaded:")
        echo(f"  vibench list KIND, such as {PluginKind.PROBLEM.plural}")
    elif what in known:
        # The list of QP solvers also has those that are no plugins.
        rows = _solver_rows(load=True) if known[what] is PluginKind.SOLVER else _loaded_rows(known[what], sizes)
        print_rows(rows, headings, what)
    else:
        raise unknown_name("list", what, known)
    for distribution, reason in unreadable().items():
        echo(f"{distribution}: {reason}")


def check_plugin(
    plugin: Annotated[
        str,
        Argument(metavar="PLUGIN", help=f"A name, {'|'.join(CHECKED)}:NAME, or MODULE:NAME.", autocompletion=plugins),
    ],
    option: Annotated[
        list[str] | None, Option(metavar="KEY=VALUE", help="Option (repeatable).", autocompletion=plugin_options)
    ] = None,
    seconds: Annotated[
        float | None, Option(min=0.0, help="Limit of all checks, 120 by default; a slow plugin gets fewer.")
    ] = None,
) -> None:
    """Check a plugin: shapes, signs, tolerances, repetition, time.

    One line per requirement of the interface, as soon as it is checked; exit code 1 if one is violated.
    """
    from functools import partial

    from vibench.plugins.registry import find_named, registered
    from vibench.qp.solve import installed_solvers
    from vibench.testing import Examination, Verdict
    from vibench.testing.solvers import of_qpsolvers

    prefix, colon, name = plugin.partition(":")
    if colon and prefix not in CHECKED:
        checked = _find_object(prefix, name)
    else:
        checked = find_named(plugin, CHECKED, installed_solvers(registered(PluginKind.SOLVER)))
    # A plugin that cannot be loaded has no title.
    loaded = checked.load() if checked.entries else partial(of_qpsolvers, solver=checked.name)
    options, remark = _chosen_options(checked, dict(map(key_value, option or [])))
    echo(f"{checked}{remark}")
    create = partial(loaded, **options) if options else loaded
    counts = Counter[Verdict]()
    limit = {} if seconds is None else {"seconds": seconds}
    for result in Examination(create, checked.kind.cli_name, **limit).results():
        echo(str(result))
        counts[result.verdict] += 1
    echo(", ".join(f"{counts[one]} {one}" for one in Verdict if counts[one] or one is not Verdict.WARNING))
    if counts[Verdict.FAILED]:
        raise Exit(1)


def _chosen_options(checked: RegisteredPlugin, given: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Options of a plugin, and what its title says of them: those that `vibench check` chooses where none are given."""
    if checked.kind is PluginKind.SOLVER:
        if given:
            raise RequestError(f"{checked} has no options")
        return {}, ""
    if checked.kind is PluginKind.PROBLEM and "resolution" not in given:
        # A problem without a coarse resolution is checked at its default.
        with suppress(RequestError):
            options = checked.check_options({"resolution": "coarse", **given})
            return options, ", at resolution coarse (--option resolution=… for another)"
    chosen = {}
    if checked.kind is PluginKind.SAMPLING:
        needed = {name for name, option in checked.options.items() if option.required}
        chosen = {name: value for name, value in (("size", 16), ("seed", 0)) if name in needed and name not in given}
    told = " and ".join(f"{name} = {value}" for name, value in chosen.items())
    remark = f", with {told} (--option {next(iter(chosen))}=… for another)" if chosen else ""
    return checked.check_options(chosen | given), remark


def new_plugin(
    kind: Annotated[NewKind, Argument(metavar="KIND", help="A kind of plugin, study, or pack.")],
    name: Annotated[str, Argument(metavar="NAME", help="Its name: a-z, 0-9 and hyphens.")],
    out: Annotated[Path, Option(metavar="DIR", help="Folder in which it is created.")] = Path(),
) -> None:
    """Write a plugin in a package, a study or a model pack.

    A package passes its tests as generated, a study runs. Existing files are never overwritten.
    """
    from vibench.cli import scaffold

    if kind in CHECKED:
        folder = scaffold.write_package(CHECKED[kind], name, out)
        module = scaffold.module_file(folder, CHECKED[kind], name)
        echo(f"{folder}: a {CHECKED[kind]} called '{name}' that works as it is", f"  pip install -e {folder}")
        echo(f"  vibench check {kind}:{name}", f"the code to edit: {module}; what to do next: {folder / 'README.md'}")
        return
    start = scaffold.write_start(kind, name, out)
    path = shlex.quote(str(start))
    steps = [f"python {path}/write.py", f"vibench pack {path}"]
    if kind == "study":
        steps = [f"vibench run {path} --dry-run", f"vibench run {path}"]
    echo(f"{start}: a {kind} that works as it is, to edit", *(f"  {step}" for step in steps))


def _read_rows(kind: PluginKind) -> Iterator[Row]:
    """Name, origin, description and names of the options of every plugin of a kind, none of which is imported."""
    from vibench.plugins.registry import registered

    for name, plugin in registered(kind).items():
        if plugin.conflict:
            yield name, plugin.origin, f"several packages provide '{name}', so that none is used", ""
        else:
            yield name, plugin.origin, plugin.summary, ", ".join(plugin.names_of_options)


def _loaded_rows(kind: PluginKind, sizes: bool = False) -> Iterator[Row]:
    """Name, origin, description and options of every plugin of a kind; of one that does not load, the error."""
    from vibench.plugins.registry import registered
    from vibench.study.matrix import expand, read_study

    for name, plugin in registered(kind).items():
        lines: list[str] = []
        try:
            if kind is PluginKind.STUDY:
                description = f"{len(expand(read_study(name)))} cells"
            else:
                description = (plugin.load().__doc__ or "").strip().split("\n")[0]
                lines += map(str, plugin.options.values())
            if kind is PluginKind.PROBLEM:
                lines += _parameters(plugin.load())
                needed = ", ".join(name for name, option in plugin.options.items() if option.required)
                if sizes and needed:
                    lines.append(f"its size depends on {needed}")
                elif sizes:
                    problem = plugin.load()()
                    lines.append(f"n = {problem.V.dim} unknowns, m = {problem.W.dim} constraints")
        except VibenchError as error:
            description = str(error)
        except Exception as error:  # noqa: BLE001  annotations of plugins are evaluated
            description = f"{plugin} cannot be read: {in_a_line(error)}"
        yield name, plugin.origin, description, "\n".join(lines)


def _parameters(problem: type) -> Iterator[str]:
    """A line for each parameter of a class of problems; none if options of the class determine them."""
    from vibench.interfaces.parameters import ParameterBox

    box = getattr(problem, "parameters", None)
    if isinstance(box, ParameterBox):
        for k, (name, low, high, unit) in enumerate(zip(box.names, box.lower, box.upper, box.units, strict=True), 1):
            yield f"mu_{k}: {name} from {low:g} to {high:g}" + f" {unit}" * (unit != "1")


def _solver_rows(load: bool) -> Iterator[Row]:
    """QP solvers and their versions, and if asked to `load` them, whether they can be."""
    from vibench import provenance
    from vibench.plugins.registry import find, registered
    from vibench.qp.settings import SETTINGS

    plugins, loaded = {row[0]: row for row in _read_rows(PluginKind.SOLVER)}, list[str]()
    if load:
        from vibench.qp.solve import installed_solvers

        loaded = list(installed_solvers(registered(PluginKind.SOLVER)))
    for name in sorted({*SETTINGS, *plugins}):
        version, package = provenance.solver_version(name), provenance.solver_distribution(name)
        if load:
            state = find(PluginKind.SOLVER, name).conflict or ("installed" if name in loaded else "not installed")
            yield name, version, state, ""
        else:
            yield plugins.get(name, (name, version, "" if version else f"not installed: `pip install {package}`", ""))


def _find_object(module: str, name: str) -> RegisteredPlugin:
    """A plugin in an importable module; modules in the current folder count. A function is a QP solver."""
    import importlib
    from importlib.metadata import EntryPoint

    from vibench.plugins.registry import RegisteredPlugin

    # A file of the current folder is a module, too.
    module = module.removesuffix(".py")
    where = f"{module}:{name}"
    title = f"'{where}'"
    if not module or not all(part.isidentifier() for part in [*module.split("."), name]):
        raise RequestError(f"{title} is neither KIND:NAME ({', '.join(CHECKED)}) nor MODULE:NAME nor FILE.py:NAME here")
    # Modules of the current folder count, as with `python -m`.
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        contents = vars(importlib.import_module(module))
    except (Exception, SystemExit) as error:  # noqa: BLE001  the module may raise anything
        raise RequestError(f"{title}: the module cannot be imported: {in_a_line(error)}") from None
    plugin = contents.get(name)
    bases = {kind: kind.base for kind in CHECKED.values() if kind.base is not None}
    if isinstance(plugin, type):
        for kind, base in bases.items():
            if issubclass(plugin, base):
                return RegisteredPlugin(kind, where, (EntryPoint(where, where, kind.entry_points),))
        names = ", ".join(base.__name__ for base in bases.values())
        raise RequestError(f"{title} is no subclass of {names}, and no QP solver")
    if callable(plugin):
        return RegisteredPlugin(PluginKind.SOLVER, where, (EntryPoint(where, where, PluginKind.SOLVER.entry_points),))
    # Suggest only classes of this module, not those that it imports.
    classes = [value for value in contents.values() if isinstance(value, type)]
    own = [one.__name__ for one in classes if issubclass(one, tuple(bases.values())) and one.__module__ == module]
    raise unknown_name(f"plugin of the module {module}", name, own)


def key_value(text: str) -> tuple[str, Any]:
    """Key and value of "key=value"; the value is read as JSON if it is valid JSON, as text otherwise."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise RequestError(f"--option '{text}' is not of the form KEY=VALUE")
    # Numbers, lists and quoted texts are JSON; a bare word is a text.
    try:
        return key, parsed_json(value)
    except ValueError:
        return key, value


def bench_plugins(
    plugin: Annotated[
        list[str] | None,
        Argument(help="Names, or problem|primal|dual|formulation|solver:NAME; all by default.", autocompletion=plugins),
    ] = None,
    out: Annotated[Path | None, Option(metavar="FILE", help="Keep the JSON file of pytest-benchmark.")] = None,
    against: Annotated[Path | None, Option(metavar="FILE", help="Compare with an earlier file.")] = None,
    read: Annotated[Path | None, Option(metavar="FILE", help="Time nothing: read a file that was kept.")] = None,
    resolution: Annotated[
        list[str] | None, Option(metavar="NAME", help="Resolution of the problems (repeatable); coarse by default.")
    ] = None,
    study: Annotated[
        str, Option(help="Study whose strategies complete what is timed.", autocompletion=studies)
    ] = "quick",
    seconds: Annotated[float | None, Option(min=0.001, help="Seconds for each benchmark, about; 1 by default.")] = None,
    limit: Annotated[float, Option(min=1.0, help="Factor by which a median may grow.")] = 1.25,
    form: FormOption = "terminal",
) -> None:
    """Time plugins in every stage, with what they reach.

    Each benchmark in which one of the plugins takes part is timed. Exit code 1 if one fails, or something is slower or
    less accurate than in the file of --against.
    """
    from vibench.benchmarks import comparison
    from vibench.results import formats

    earlier = comparison.read_benchmarks(against) if against is not None else None
    if read is None:
        timed = _timed(plugin or [], out, resolution or ["coarse"], study, seconds)
    elif plugin or out is not None:
        raise RequestError("--read times nothing: leave out the plugins and --out")
    else:
        timed = comparison.read_benchmarks(read)
    frame = comparison.table_of(timed, earlier, limit)
    if form == "terminal":
        _print_benchmarks(frame, timed, earlier, limit)
    else:
        sys.stdout.write(formats.to_text(frame, form))
    if (timed.failed and read is None) or (earlier is not None and comparison.regressions(frame)):
        raise Exit(1)


def _timed(plugins: list[str], out: Path | None, resolutions: list[str], study: str, seconds: float | None) -> Timed:
    """Time plugins by pytest-benchmark, and keep its file if asked to."""
    from importlib.util import find_spec

    from vibench import benchmarks
    from vibench.benchmarks.comparison import read_benchmarks
    from vibench.files import scratch, write_atomically, writing

    if find_spec("pytest_benchmark") is None:
        raise VibenchError("`vibench bench` needs pytest-benchmark: pip install 'vibench[bench]'")
    # Wrong requests are refused here, in a line.
    benchmarks.setting(study), benchmarks.chosen_plugins(plugins), benchmarks.resolutions(resolutions)
    if out is not None and not out.absolute().parent.is_dir():
        raise RequestError(f"'{out}' cannot be written: '{out.absolute().parent}' is not a folder")
    with scratch() as folder:
        file = folder / "benchmarks.json"
        options = [f"--plugin={name}" for name in plugins] + [f"--resolution={name}" for name in resolutions]
        options += [f"--study={study}", *([] if seconds is None else [f"--seconds={seconds}"])]
        benchmarks.run_pytest([*options, f"--benchmark-json={file}"])
        if not file.exists():  # everything was left out
            file.write_text('{"machine_info": {}, "benchmarks": []}')
        if out is not None:
            with writing(out):
                write_atomically(out, file.read_bytes())
        return read_benchmarks(file)


def _print_benchmarks(frame: pd.DataFrame, timed: Timed, earlier: Timed | None, limit: float) -> None:
    """Print a table for everything that was timed, beside an earlier file if there is one, and how many failed."""
    import pandas as pd

    from vibench.benchmarks.comparison import AXES, remarks

    # Columns, those that matter most first.
    priority = [
        "verdict", *AXES, "median [ms]", "before [ms]", "after [ms]", "ratio", "quartiles [ms]", "reached", "status",
        "rounds", "apart",
    ]  # fmt: skip
    for group, rows in frame.groupby("group", sort=False) if len(frame) else ():
        shown = _measured(rows) if earlier is None else _compared(rows)
        named = [axis for axis in AXES if (rows[axis] != "").any()]
        print_frame(pd.concat([rows[named], shown], axis=1), str(group), priority, rest="--format csv")
        echo("")
    if earlier is None:
        counts = f"{len(frame)} benchmarks" + (f", {timed.failed} failed" if timed.failed else "")
        echo(f"{counts}; times are CPU times of a call on one thread")
    else:
        echo(*remarks(earlier, timed, frame, limit))


def _measured(rows: pd.DataFrame) -> pd.DataFrame:
    import pandas as pd

    from vibench.results.formats import cell_text, decimal_interval

    def largest(reached: dict[str, float | None]) -> str:
        figures = {name.removeprefix("reached_"): value for name, value in reached.items() if pd.notna(value)}
        name = max(figures, key=lambda name: figures[name] or 0.0, default="")
        return f"{name} {cell_text(figures[name])}" if name else ""

    shown = pd.DataFrame({"median [ms]": 1e3 * rows["median_s"]}, index=rows.index)
    shown["quartiles [ms]"] = list(map(decimal_interval, 1e3 * rows["q1_s"], 1e3 * rows["q3_s"]))
    shown["rounds"] = rows["rounds"]
    shown["reached"] = [largest(row) for row in rows.filter(like="reached_").to_dict("records")]
    shown["status"] = rows["status"]
    return shown


def _compared(rows: pd.DataFrame) -> pd.DataFrame:
    from vibench.results.formats import cell_text

    changes = rows[["figure", "before", "after"]].itertuples(index=False, name=None)
    reached = [f"{name} {cell_text(was)} → {cell_text(now)}" if name else "" for name, was, now in changes]
    seconds = {"before [ms]": 1e3 * rows["before_s"], "after [ms]": 1e3 * rows["after_s"]}
    return rows.assign(**seconds, reached=reached)[[*seconds, "ratio", "apart", "reached", "verdict"]]
