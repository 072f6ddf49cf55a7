"""The command line: its commands, the words that `vibench help` knows, and the call that runs a command.

Help and completion have to answer at once, so modules that define commands import nothing heavy at the top (no numpy,
pandas, rich or pydantic): every command imports what it needs when it runs.
"""

from __future__ import annotations

import io
import os
import re
import shlex
import sys
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer.core
from typer import Argument, Option

from vibench.cli import plugin_commands as plugins
from vibench.cli import result_commands as results
from vibench.cli.calibrate_command import calibrate
from vibench.cli.completion import examples, whole_words
from vibench.cli.console import echo, fitted, warn
from vibench.cli.pack_commands import pack
from vibench.cli.run_command import run_study_command
from vibench.errors import RequestError, VibenchError, unknown_name
from vibench.interrupts import Interrupted, interruptible
from vibench.plugins.kinds import PluginKind
from vibench.text import one_line, unbroken

app = typer.Typer(
    name="vibench",
    help="Benchmark reduced-order models of parametrised variational inequalities.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    # Typer would import pydantic to convert the missing values of these options before a command prints its help.
    context_settings={
        "default_map": dict.fromkeys(("help", "install_completion", "show_completion", "version"), False),
        "help_option_names": ["--help", "-h"],
    },
)


def _print_version(asked: bool) -> None:
    if asked:
        from vibench.provenance import distribution_version

        echo(f"vibench {distribution_version('vibench')}")
        raise typer.Exit


@app.callback()
def _global_options(
    version: Annotated[
        bool, Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    pass


def clean(
    older_than: Annotated[float | None, Option(min=0.0, metavar="DAYS", help="Keep younger artefacts.")] = None,
    dry_run: Annotated[bool, Option("--dry-run", help="Only show what is stored.")] = False,
    yes: Annotated[bool, Option("--yes", "-y", help="Delete without asking.")] = False,
) -> None:
    """Show and delete stored snapshots, bases and cones.

    Enrichments and inf-sup constants are stored, too. The results of runs are kept; later runs compute again what they
    need.
    """
    import pandas as pd

    from vibench.cli.console import print_frame
    from vibench.stages.artefacts import usable_store

    store, seconds = usable_store(), 86400.0 * (older_than or 0.0)
    stored = pd.DataFrame(store.contents(), columns=["stored", "MiB", "days"])
    going = int((stored["days"] >= seconds).sum())
    stored["MiB"], stored["days"] = stored["MiB"] / 2**20, stored["days"] / 86400.0
    stored["stored"] = stored["stored"].str.replace("-", " ")
    columns = {"files": ("MiB", "size"), "MiB": ("MiB", "sum"), "oldest [days]": ("days", "max")}
    print_frame(stored.groupby("stored", as_index=False).agg(**columns), f"stored in {store.folder}")
    if dry_run:
        return
    if going and not yes:
        # A script cannot answer, and must not delete by accident.
        if not sys.stdin.isatty():
            raise RequestError("nothing was deleted: answer the question on a terminal, or say --yes")
        typer.confirm(f"Delete {going} of {len(stored)} files?", abort=True)
    echo(f"{store.clear(seconds) / 2**20:.1f} MiB freed; later runs recompute what they need")


def doctor(out: Annotated[Path, Option(metavar="DIR", help="Folder of the runs.")] = Path("runs")) -> None:
    """Check versions, QP solvers, plugins, disk and timings.

    Every installed solver solves a small program. Exit code 1 if a required part is missing or an installed one does
    not work.
    """
    from vibench.cli.doctor import print_diagnoses

    if print_diagnoses(out):
        raise typer.Exit(1)


def help_on(
    word: Annotated[
        str, Argument(help="A command, a key of study files, a column, a status, a plugin, or a term.")
    ] = "",
) -> None:
    """Explain a command, or a word of studies and results."""
    commands = [str(one.name) for one in app.registered_commands]
    if word in ("", *commands):
        app(args=[*word.split(), "--help"], standalone_mode=False)
        return
    from vibench.cli.console import shown
    from vibench.text import new_console

    known, plural = commands, list[str]()
    lines = [f"`vibench {word}` is now `vibench {shlex.join(new)}`"] if (new := renamed([word])) else []
    for names, line in explained_words():
        known += names
        folded = [*map(str.casefold, names)]
        lines += [line] * (word.casefold() in folded)
        plural += [line] * (f"{word.casefold()}s" in folded)
    lines = lines or plural
    if not lines:
        raise unknown_name("command, key, column, status, plugin or term", word, set(known))
    for line in lines:
        new_console().print(shown(line))


# Words, and the line that explains them.
Explained = Iterator[tuple[Collection[str], str]]


def explained_words() -> Explained:
    """Keys of study files, columns, tables, plugins, and terms of the glossary."""
    return chain(_keys(), _columns(), _tables_and_plugins(), glossary())


def _keys() -> Explained:
    from vibench.plugins.options import keys, places
    from vibench.study.spec import Study

    schema = Study.model_json_schema()
    for key in keys(schema):
        holders = places(schema, key.table) if key.table else []
        where = f"in {', '.join(holders)} of a study file" if holders else "in a study file"
        default = "required" if key.required else f"default {key.default}" * bool(key.default)
        about = ", ".join(filter(None, (key.expected.replace("`", ""), default)))
        yield [key.name], f"{key.name}, {where} ({about}): {key.meaning}"


def _columns() -> Explained:
    """Columns by their names and headings, with and without units."""
    from vibench.results.ranking import added_columns
    from vibench.results.schema import STORED

    # Tables share columns: a meaning is said once, with the tables in which it holds.
    tables = defaultdict[tuple[str, str, str, str], list[str]](list)
    for table, columns in {**STORED, "best": added_columns()}.items():
        for name, column in columns.items():
            tables[name, column.heading, column.unit, column.meaning].append(table)
    for (name, heading, unit, meaning), holders in tables.items():
        line = f"{name}{f' [{unit}]' * bool(unit)}, in {', '.join(holders)}: {meaning}"
        yield {name, heading, heading.partition(" [")[0]} - {""}, line


def _tables_and_plugins() -> Explained:
    from vibench.plugins.registry import registered
    from vibench.qp.settings import SETTINGS
    from vibench.results.show import VIEWS

    for table in VIEWS:
        yield [table], f"{table}, a table of a run: `vibench show RUN --table {table}`"
    for kind in PluginKind:
        for name, plugin in registered(kind).items():
            about = f"{name}, a {kind} of {plugin.origin}: {plugin.summary.removesuffix('.')}"
            yield [name], f"{about} (`vibench list {kind.plural}`)"
    # Solvers of qpsolvers are no plugins.
    for name in SETTINGS:
        yield [name], f"{name}, a QP solver (`vibench list solvers`)"


def glossary() -> Explained:
    """Entries of the glossary; each explains the words of its title and those that its text emphasises or quotes."""
    source = (files("vibench.cli") / "glossary.md").read_text(encoding="utf-8")
    found = re.findall(r"^(?:\*\*(.+)\*\*\n:   |\| (?!symbol|status|verdict|---)(.+?) \| )(.+?)(?: \|)?$", source, re.M)
    for title, row, text in found:
        head = (title or row).replace("`", "")
        # "Certificate: certified, verified" and "*as fast*" in a text are words that people look up.
        words = [*re.split(r"[,:()]|\band\b", head), *re.findall(r"(?<=\*)[^*]+(?=\*)|(?<=`)[^`]+(?=`)", text)]
        # A terminal shows the text of a link; its target is a page of the documentation.
        plain = re.sub(r"\[([^]]+)\]\([^)]+\)", r"\1", text).replace("*", "").replace("`", "")
        yield [word.strip() for word in (head, *words) if word.strip()], f"{head}: {plain}"


class _Command(typer.core.TyperCommand):
    """A command whose usage shows its arguments as `RUN [CELL]`, without the braces and dots of typer."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        pieces = (piece.translate({ord("{"): "", ord("}"): ""}) for piece in super().collect_usage_pieces(ctx))
        return [piece.removesuffix("...") if " " in piece else piece for piece in pieces]


for _name, _call in dict[str, Callable[..., None]](
    run=run_study_command, list=plugins.list_plugins, show=results.show, report=results.write_report,
    figures=results.draw_figures, compare=results.compare_runs, replay=results.replay_query, export=results.export,
    serve=results.serve, calibrate=calibrate, pack=pack, check=plugins.check_plugin, new=plugins.new_plugin,
    bench=plugins.bench_plugins, publish=results.publish_runs, clean=clean, doctor=doctor, help=help_on,
).items():  # fmt: skip
    # Without an own default map a command would take the default above of an option of the same name for its own.
    app.command(_name, cls=_Command, epilog=examples(_name), context_settings={"default_map": {}})(interruptible(_call))


def renamed(arguments: list[str]) -> list[str] | None:
    """The command that replaces one of version 0.1; `None` for the commands of today."""
    old, *rest = arguments
    # Each old line is rewritten as text; what it means is checked by the command of today.
    if old == "diff":
        return ["compare", *rest, "--table", "changes", "--strict"]
    if old in ("import", "cones"):
        return ["pack", *rest, *["--cones"] * (old == "cones")]
    if old in ("export-qps", "export-model"):
        ends = {".npz": ".c"} if "--c" in rest else {}
        words = ("--tolerance" if word == "--interpolate" else word for word in rest if word != "--c")
        return ["export", *(f"{word[:-4]}{ends.get(word[-4:], word[-4:])}" for word in words)]
    if old == "export-vtu":
        # MU was an argument that may begin with "-", and the file an option with a default.
        file = rest.pop(rest.index("--out") + 1) if "--out" in rest[:-1] else f"{(rest[1:2] or ['CELL'])[0]}.vtu"
        run, cell, mu, *more = [word for word in rest if word != "--out"] + ["RUN", "CELL", "MU"][len(rest) :]
        return ["export", run, cell, file, "--mu", mu, *more]
    return None


def run_command_line() -> None:
    """Run the command of `sys.argv`; an expected error is one line, with exit code 2 for a wrong request or else 1."""
    # click's ClickException, whichever copy of click typer brings.
    usage_error = typer.BadParameter.__mro__[2]
    arguments = sys.argv[1:] or ["--help"]
    try:
        # A question mark stands for what a terminal or a pipe cannot encode, rather than abort a run. Tests and
        # notebooks replace the streams by others, which have no encoding to change.
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="replace")
        warnings.showwarning = _warning
        _search_working_directory_last()
        if new := renamed(arguments):
            warn(f"`vibench {arguments[0]}` will go; write `vibench {shlex.join(new)}`")
            arguments = new
        with whole_words():
            code = app(args=arguments, standalone_mode=False)
    except VibenchError as error:
        code = _print_error(error, 2 if isinstance(error, RequestError) else 1)
    except OSError as error:
        where = f"'{error.filename}' cannot be written or read: " if error.filename else ""
        code = _print_error(f"{where}{error.strerror or error}", 1)
    except Interrupted:
        # The exit code of shells for what Ctrl-C has ended, and of a question that was answered with no.
        code = _print_error("interrupted", 130)
    except typer.Abort:
        code = _print_error("stopped; nothing was changed", 130)
    except Exception as error:
        if not isinstance(error, usage_error):
            raise
        code = _print_error(error.format_message(), 2)  # type: ignore[attr-defined]
    sys.exit(code if isinstance(code, int) else 0)


def _search_working_directory_last() -> None:
    """Let nothing in the working directory take the place of an installed package."""
    # An empty entry of PYTHONPATH, which `PYTHONPATH=FOLDER:$PYTHONPATH` leaves, puts it first. Workers search as we
    # do.
    first, *more = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if more and "" in (first, *more):
        here = os.path.realpath(os.curdir)
        sys.path[:] = [*(folder for folder in sys.path if folder != here), here]


def _warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: Any, **__: Any) -> None:
    """Show a warning for users as one line, without the line of code that raised it; others as Python does."""
    if category is UserWarning:
        warn(unbroken(str(message)))
    else:
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno))


def _print_error(error: object, code: int) -> int:
    sys.stderr.write(f"{fitted(f'vibench: {one_line(str(error))}', sys.stderr)}\n")
    return code
