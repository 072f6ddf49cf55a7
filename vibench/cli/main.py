"""The command line: the commands that run studies and look after the machine, and what runs them all.

Help and completion have to answer at once, so modules that define commands import nothing heavy at the top (no numpy,
pandas, rich or pydantic): every command imports what it needs when it runs.
"""

from __future__ import annotations

import io
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from vibench.cli import output_commands
from vibench.cli.bench_command import bench_plugins
from vibench.cli.completion import CORRECTIONS, examples, formulations, names, solvers, studies, whole_words, words
from vibench.cli.console import echo, warn
from vibench.cli.output_commands import (
    draw_figures,
    export_mesh_fields,
    export_qps,
    export_reduced_model,
    publish_runs,
    write_report,
)
from vibench.cli.pack_commands import import_pack, pack_problem, reduce_cones
from vibench.cli.plugin_commands import check_plugin, list_plugins, new_plugin
from vibench.cli.result_commands import At, compare_runs, diff_runs, places_of, replay_query, show
from vibench.errors import RequestError, VibenchError
from vibench.interrupts import INTERRUPTED, Interrupted, interrupted_at_once, interruptible
from vibench.plugins.kinds import DUAL, PRIMAL, PROBLEM
from vibench.text import unbroken

if TYPE_CHECKING:
    from vibench.execution.run import Outcome
    from vibench.study.spec import Study

Names = list[str] | None
Tolerances = list[float] | None

SQLITE = ".sqlite"
"""How the name of a results file ends."""

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


def run_study_command(
    study: Annotated[
        str,
        Argument(help="A registered study, or a TOML file; with --cell a results file, too.", autocompletion=studies),
    ] = "quick",
    cell: Annotated[str, Option(metavar="KEY", help="Run one cell alone, by its key or the beginning of that.")] = "",
    problem: Annotated[
        Names, Option(help="Replace the problems of the study (repeatable).", autocompletion=names(PROBLEM))
    ] = None,
    formulation: Annotated[Names, Option(help="Replace the formulations.", autocompletion=formulations)] = None,
    dual: Annotated[Names, Option(help="Replace the dual strategies.", autocompletion=names(DUAL))] = None,
    primal: Annotated[Names, Option(help="Replace the primal strategies.", autocompletion=names(PRIMAL))] = None,
    solver: Annotated[Names, Option(help="Replace the QP solvers.", autocompletion=solvers)] = None,
    correction: Annotated[
        Names, Option(help="Replace the corrections of solutions.", autocompletion=words(lambda: CORRECTIONS))
    ] = None,
    pod_tol: Annotated[Tolerances, Option(help="Replace the tolerances (or sizes) of the POD.")] = None,
    dual_tol: Annotated[Tolerances, Option(help="Replace the tolerances (or sizes) of the dual strategies.")] = None,
    primal_tol: Annotated[Tolerances, Option(help="Replace the tolerances of the primal strategies.")] = None,
    at: At = None,
    out: Annotated[Path | None, Option(help="Results folder; runs/STUDY by default.")] = None,
    jobs: Annotated[
        int, Option("--jobs", "-j", min=0, help="Worker processes; 0 for one per core. Does not affect results.")
    ] = 0,
    repeats: Annotated[
        int, Option(min=0, metavar="K", help="Measure seconds in at least K cold processes, offline stages K times.")
    ] = 0,
    dry_run: Annotated[bool, Option("--dry-run", help="List the cells of the matrix and stop.")] = False,
    fresh: Annotated[bool, Option("--fresh", help="Remove earlier results and recompute everything.")] = False,
    retry: Annotated[bool, Option("--retry", help="Also rerun cells that did not end ok.")] = False,
    strict: Annotated[bool, Option("--strict", help="Exit with 1 if a cell is neither ok nor unavailable.")] = False,
    draw: Annotated[bool, Option("--figures/--no-figures", help="Draw the figures at the end.")] = True,
    executor: Annotated[Literal["local", "dask"], Option(help="Local processes, or a dask cluster.")] = "local",
    scheduler: Annotated[
        str | None, Option(metavar="ADDRESS", help="A dask scheduler; a new cluster on this machine by default.")
    ] = None,
) -> None:
    """Run a study. An interrupted run resumes where it stopped."""
    with interrupted_at_once():  # the libraries and plugins of a study take a second to import
        from vibench.execution.run import Options, run_study
        from vibench.library.progress import ProgressDisplay
        from vibench.study.matrix import expand

        overrides = {
            "problem": problem, "formulation": formulation, "dual": dual, "primal": primal, "solvers": solver,
            "correction": correction, "pod": pod_tol, "dual_tol": dual_tol, "primal_tol": primal_tol,
        }  # fmt: skip
        loaded = _study(study, cell, {axis: values for axis, values in overrides.items() if values}, at)
    if dry_run:
        cells = expand(loaded)
        echo(*(f"{cell.key}  {cell}" for cell in cells), f"{len(cells)} cells")
        return
    if scheduler is not None:
        _warn_of_open_scheduler(scheduler, executor)
    folder = out or Path("runs") / loaded.name
    options = Options(jobs, fresh, retry, executor, scheduler, repeats)
    with ProgressDisplay() as progress:
        outcome = run_study(loaded, folder, progress, options)
    _conclude(loaded.name, outcome, folder, draw=options.workers if draw else None, fresh=fresh, strict=strict)


def _conclude(name: str, outcome: Outcome, folder: Path, *, draw: int | None, fresh: bool, strict: bool) -> None:
    """Export, print and draw what a run found, on as many processes as `draw` says; exit as its statuses ask for."""
    from vibench.cli import run_summary
    from vibench.qp.status import Status
    from vibench.results import show
    from vibench.results.read import results_file

    path = results_file(str(folder))
    show.export(path, folder / "tables")
    if outcome.damaged:
        echo(f"computed again, as their rows were damaged: {', '.join(outcome.damaged)}")
    if outcome.interrupted:
        missing = f"{outcome.missing} cells have no row yet" if outcome.missing else "all cells have their rows"
        again = "the same command without --fresh" if fresh else "the same command"
        echo(f"interrupted: {missing}; {again} resumes the run")
        raise typer.Exit(INTERRUPTED)
    statuses = [row["status"] for row in outcome.rows]
    nothing_ran = set(statuses) == {Status.UNAVAILABLE}
    if not nothing_ran:
        run_summary.print_summary(name, path, outcome.rows)
    echo(f"results: {path}, tables: {folder / 'tables'}")
    if (fresh or draw is not None) and (folder / "figures").is_dir():
        from vibench.report import figures

        figures.remove(folder / "figures")
    if nothing_ran:
        raise VibenchError(f"no cell could run here: {run_summary.reasons(outcome.rows)}")
    if draw is not None:
        output_commands.draw_run(path, folder / "figures", draw)
    fine = statuses.count(Status.OK)
    run_summary.next_steps(folder, len(statuses), len(statuses) - fine, figures=draw is not None)
    if strict and any(status not in (Status.OK, Status.UNAVAILABLE) for status in statuses):
        raise typer.Exit(1)


def _warn_of_open_scheduler(scheduler: str, executor: str) -> None:
    from vibench.execution.executors import is_authenticated

    if executor != "dask":
        raise RequestError(f"--scheduler {scheduler} is for --executor dask")
    if not is_authenticated(scheduler):
        warning = "the connection is not authenticated: others who reach the scheduler can run code on its workers"
        sys.stderr.write(f"vibench: {unbroken(scheduler)}: {warning}\n")


def _study(request: str, key: str, overrides: dict[str, list[Any]], at: list[str] | None) -> Study:
    """The study that is asked for, or what it has, or a results file, of one cell."""
    from vibench.execution.recorded_cell import recorded_study
    from vibench.study.matrix import expand, only_cell, read_study, study_of_cell

    if key and Path(request).suffix == SQLITE:
        if overrides:
            raise RequestError(f"a cell of a results file is run as it is recorded: leave out {', '.join(overrides)}")
        return recorded_study(request, key, places_of(at))
    if at:
        raise RequestError("--at is for a cell of a results file; a study file says itself where its files are")
    study = read_study(request, overrides)
    if not key:
        return study
    cell = only_cell(expand(study), key, f"'{request}'")
    rounds = {name: getattr(study, name) for name in ("timing_rounds", "timing_rounds_min")}
    return study_of_cell(cell, study.name, limits=study.limits, **rounds)


def clean(
    older_than: Annotated[float, Option(min=0.0, metavar="DAYS", help="Keep younger artefacts.")] = 0.0,
    dry_run: Annotated[bool, Option("--dry-run", help="Only show what is stored.")] = False,
    yes: Annotated[bool, Option("--yes", "-y", help="Delete without asking.")] = False,
) -> None:
    """Show and delete stored snapshots, bases and cones.

    Enrichments and inf-sup constants are stored, too. The results of runs are kept; later runs compute again what they
    need.
    """
    import pandas as pd

    from vibench.cli.console import print_frame
    from vibench.storage.artefacts import usable_store

    store = usable_store()
    stored = pd.DataFrame(store.contents(), columns=["stored", "MiB", "days"])
    going = int((stored["days"] >= older_than * 86400.0).sum())
    stored["MiB"], stored["days"] = stored["MiB"] / 2**20, stored["days"] / 86400.0
    stored["stored"] = stored["stored"].str.replace("-", " ")
    columns = {"files": ("MiB", "size"), "MiB": ("MiB", "sum"), "oldest [days]": ("days", "max")}
    print_frame(stored.groupby("stored", as_index=False).agg(**columns), f"stored in {store.folder}")
    if dry_run:
        return
    if going and not yes:
        if not sys.stdin.isatty():
            raise RequestError("nothing was deleted: answer the question on a terminal, or say --yes")
        typer.confirm(f"Delete {going} of {len(stored)} files?", abort=True)
    freed = store.clear(older_than * 86400.0)
    echo(f"{freed / 2**20:.1f} MiB freed; later runs recompute what they need")


def doctor(out: Annotated[Path, Option(metavar="DIR", help="Folder of the runs.")] = Path("runs")) -> None:
    """Check versions, QP solvers, plugins, disk and timings.

    Every installed solver solves a small program. Exit code 1 if a required part is missing or an installed one does
    not work.
    """
    from vibench.cli.doctor import print_diagnoses

    if print_diagnoses(out):
        raise typer.Exit(1)


def help_on(
    topic: Annotated[
        str, typer.Argument(help="A command, a key of study files, or a column of the results or its heading.")
    ] = "",
) -> None:
    """Say what a command does, or what a key or a column means."""
    if topic in ("", *COMMANDS):
        app(args=[*topic.split(), "--help"], standalone_mode=False)
        return
    from vibench.cli.console import shown
    from vibench.cli.meanings import meanings
    from vibench.text import new_console

    for line in meanings(topic, COMMANDS):
        new_console().print(shown(line))


COMMANDS: dict[str, Callable[..., None]] = {
    "run": run_study_command, "list": list_plugins, "show": show, "report": write_report, "figures": draw_figures,
    "diff": diff_runs, "compare": compare_runs, "publish": publish_runs,
    "replay": replay_query, "export-qps": export_qps,
    "export-model": export_reduced_model, "export-vtu": export_mesh_fields, "clean": clean, "doctor": doctor,
    "check": check_plugin, "bench": bench_plugins, "new": new_plugin,
    "import": import_pack, "pack": pack_problem, "cones": reduce_cones, "help": help_on,
}  # fmt: skip
NEGATIVE = ("export-vtu",)
"""Commands with a parameter of a problem as an argument, whose first component may be negative: -0.1 is no option."""

for _name, _command in COMMANDS.items():
    # a command would take the default above of the option of its name, as that of --help, for its own
    _settings = {"default_map": {}, "ignore_unknown_options": _name in NEGATIVE}
    app.command(_name, epilog=examples(_name), context_settings=_settings)(interruptible(_command))


def run_command_line() -> None:
    """Run the command that `sys.argv` gives.

    An expected error is one line; the exit code is 2 for a wrong request, 1 for anything else.
    """
    usage_error = typer.BadParameter.__mro__[2]  # click's ClickException, whichever copy of click typer brings
    try:
        _print_any_text()
        warnings.showwarning = _warning
        _search_working_directory_last()
        with whole_words():
            code = app(args=sys.argv[1:] or ["--help"], standalone_mode=False)
    except VibenchError as error:
        code = _print_error(error, 2 if isinstance(error, RequestError) else 1)
    except OSError as error:
        where = f"'{error.filename}' cannot be written or read: " if error.filename else ""
        code = _print_error(f"{where}{error.strerror or error}", 1)
    except Interrupted:
        code = _print_error("interrupted", INTERRUPTED)
    except typer.Abort:  # a question that was answered with no
        code = _print_error("stopped; nothing was changed", INTERRUPTED)
    except Exception as error:
        if not isinstance(error, usage_error):
            raise
        code = _print_error(error.format_message(), 2)  # type: ignore[attr-defined]
    sys.exit(code if isinstance(code, int) else 0)


def _print_any_text() -> None:
    """Print a question mark for what the encoding of a terminal or a pipe lacks, rather than abort a run."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # not what has taken its place in a test or a notebook
            stream.reconfigure(errors="replace")


def _search_working_directory_last() -> None:
    """Let nothing in the working directory take the place of an installed package.

    An empty entry of PYTHONPATH, which `PYTHONPATH=FOLDER:$PYTHONPATH` leaves, puts it first. Workers search as we do.
    """
    first, *more = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if more and "" in (first, *more):
        here = os.path.realpath(os.curdir)
        sys.path[:] = [*(folder for folder in sys.path if folder != here), here]


def _warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: Any, **__: Any) -> None:
    """Show a warning for users as one line, without the line of code that it is from; others as Python does."""
    if category is UserWarning:
        warn(unbroken(str(message)))
    else:
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno))


def _print_error(error: object, code: int) -> int:
    sys.stderr.write(f"vibench: {unbroken(str(error))}\n")
    return code
