"""The command line: the commands that run studies and look after the machine, and the entry point.

Help and completion have to answer at once, so modules that define commands import nothing heavy at the top (no numpy,
pandas, rich or pydantic): every command imports what it needs when it runs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from vibench.cli.completion import examples, names, solvers, studies
from vibench.cli.export_commands import export_reduced_model
from vibench.cli.output import echo
from vibench.cli.plugin_commands import check_plugin, list_plugins, new_plugin
from vibench.cli.result_commands import compare_runs, export_qps, replay_query, show, write_report
from vibench.errors import RequestError, VibenchError
from vibench.text import unbroken

Names = list[str] | None
Tolerances = list[float] | None

app = typer.Typer(
    name="vibench",
    help="Benchmark reduced-order models of parametrised variational inequalities.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    # Typer would import pydantic to convert the missing values of these options before a command prints its help.
    context_settings={"default_map": dict.fromkeys(("help", "install_completion", "show_completion"), False)},
)


def run(
    study: Annotated[str, Argument(help="A registered study, or a TOML file.", autocompletion=studies)] = "quick",
    problem: Annotated[
        Names, Option(help="Replace the problems of the study (repeatable).", autocompletion=names("problems"))
    ] = None,
    dual: Annotated[Names, Option(help="Replace the dual strategies.", autocompletion=names("dual_strategies"))] = None,
    primal: Annotated[
        Names, Option(help="Replace the primal strategies.", autocompletion=names("primal_strategies"))
    ] = None,
    solver: Annotated[Names, Option(help="Replace the QP solvers.", autocompletion=solvers)] = None,
    pod_tol: Annotated[Tolerances, Option(help="Replace the tolerances (or sizes) of the POD.")] = None,
    dual_tol: Annotated[Tolerances, Option(help="Replace the tolerances (or sizes) of the dual strategies.")] = None,
    primal_tol: Annotated[Tolerances, Option(help="Replace the tolerances of the primal strategies.")] = None,
    out: Annotated[Path | None, Option(help="Results folder; runs/STUDY by default.")] = None,
    jobs: Annotated[int, Option(min=0, help="Worker processes; 0 for one per core. Does not affect results.")] = 0,
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
    from vibench import provenance
    from vibench.execution.run import Options, run_study
    from vibench.qp.status import Status
    from vibench.results import tables
    from vibench.study.cells import expand
    from vibench.study.reader import read_study
    from vibench.terminal.console import new_console
    from vibench.terminal.progress import ProgressDisplay

    overrides = {
        "problem": problem, "dual": dual, "primal": primal, "solvers": solver,
        "pod": pod_tol, "dual_tol": dual_tol, "primal_tol": primal_tol,
    }  # fmt: skip
    loaded = read_study(study, {axis: values for axis, values in overrides.items() if values})
    if dry_run:
        cells = expand(loaded)
        echo(*(f"{cell.key}  {cell}" for cell in cells), f"{len(cells)} cells")
        return
    if scheduler is not None and executor != "dask":
        raise RequestError(f"--scheduler {scheduler} is for --executor dask")
    folder = out or Path("runs") / loaded.name
    options = Options(jobs or provenance.cores(), fresh, retry, executor, scheduler)
    with ProgressDisplay(new_console()) as progress:
        outcome = run_study(loaded, folder, progress, options)
    path = tables.results_file(str(folder))
    tables.export(path, folder / "tables")
    if outcome.interrupted:
        echo(f"interrupted: {outcome.missing} cells have no row yet; the same command resumes the run")
        raise typer.Exit(130)
    drawn: list[Path] = []
    if draw or fresh:
        from vibench.report import figures

        figures.remove(folder / "figures")
    if draw:
        drawn = figures.draw_all(path, folder / "figures", jobs=min(options.jobs, provenance.cores()))
    _summarise(loaded.name, path, outcome.rows)
    echo(f"results: {path}, tables: {folder / 'tables'}, {len(drawn)} figures: {folder / 'figures'}")
    if strict and any(row["status"] not in (Status.OK, Status.UNAVAILABLE) for row in outcome.rows):
        raise typer.Exit(1)


def _summarise(study: str, path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the summary of a run, its rows that are not ok, and violated invariants."""
    from vibench.qp.status import Status
    from vibench.results import invariants, tables
    from vibench.results.solver_agreement import sentence
    from vibench.terminal.console import print_frame

    cells, queries = tables.read(path, "cells"), tables.read(path, "queries")
    print_frame(tables.summary(cells), study)
    not_ok = [row for row in rows if row["status"] != Status.OK]
    for row in not_ok:
        tolerance = "" if row["primal_tol"] is None else f" {row['primal_tol']:g}"
        echo(
            f"{row['status']}: {row['problem']} · {row['dual']} · {row['primal']}{tolerance} · {row['solver']}: "
            f"{row['queries_ok']} of {row['queries']} queries ok; {row['reason']}"
        )
    echo(f"{len(rows)} cells, {len(rows) - len(not_ok)} ok, {len(not_ok)} not ok")
    violations = invariants.violations(queries, cells.set_index("cell")["enrichment_kind"])
    for violation in violations:
        echo(f"invariant: {violation}; this is a bug of vibench or of a plugin's inner products")
    if not violations:
        echo(f"invariants of the constants and the error bounds hold in all {len(queries)} queries")
    echo(sentence(tables.read(path, "disagreements")))


def clean(
    older_than: Annotated[float, Option(min=0.0, metavar="DAYS", help="Keep younger artefacts.")] = 0.0,
    dry_run: Annotated[bool, Option("--dry-run", help="Only show what is stored.")] = False,
) -> None:
    """Show the disk usage of stored artefacts, and delete them. Results are kept."""
    import pandas as pd

    from vibench.stages.artefacts import usable_store
    from vibench.terminal.console import print_frame

    store = usable_store()
    found = pd.DataFrame(store.contents(), columns=["stage", "MiB", "days"])
    found["MiB"], found["days"] = found["MiB"] / 2**20, found["days"] / 86400.0
    columns = {"artefacts": ("MiB", "size"), "MiB": ("MiB", "sum"), "oldest [days]": ("days", "max")}
    print_frame(found.groupby("stage", as_index=False).agg(**columns), f"artefacts in {store.folder}")
    if not dry_run:
        freed = store.clear(older_than * 86400.0)
        echo(f"{freed / 2**20:.1f} MiB freed; later runs recompute what they need")


def doctor(out: Annotated[Path, Option(metavar="DIR", help="Folder of the runs.")] = Path("runs")) -> None:
    """Check versions, QP solvers, plugins, disk and timings.

    Every installed solver solves a small program. Exit code 1 if a required part is missing or an installed one does
    not work.
    """
    from vibench.cli.doctor import print_findings

    if print_findings(out):
        raise typer.Exit(1)


COMMANDS: dict[str, Callable[..., None]] = {
    "run": run, "list": list_plugins, "show": show, "report": write_report, "diff": compare_runs,
    "replay": replay_query, "export-qps": export_qps, "export-model": export_reduced_model,
    "clean": clean, "doctor": doctor, "check": check_plugin, "new": new_plugin,
}  # fmt: skip
for _name, _command in COMMANDS.items():
    app.command(_name, epilog=examples(_name))(_command)


def main() -> None:
    """Entry point: an expected error is one line; exit code 2 for a wrong request, 1 for anything else."""
    usage_error = typer.BadParameter.__mro__[2]  # click's ClickException, whichever copy of click typer brings
    try:
        code = app(args=sys.argv[1:] or ["--help"], standalone_mode=False)
    except VibenchError as error:
        code = _print_error(error, 2 if isinstance(error, RequestError) else 1)
    except OSError as error:
        where = f"'{error.filename}' cannot be written or read: " if error.filename else ""
        code = _print_error(f"{where}{error.strerror or error}", 1)
    except typer.Abort:
        code = 130
    except Exception as error:
        if not isinstance(error, usage_error):
            raise
        code = _print_error(error.format_message(), 2)  # type: ignore[attr-defined]
    sys.exit(code if isinstance(code, int) else 0)


def _print_error(error: object, code: int) -> int:
    sys.stderr.write(f"vibench: {unbroken(str(error))}\n")
    return code
