"""The command line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import pandas as pd
import typer
from rich.console import Console

from vibench import provenance
from vibench.cli import completion, plugin_commands
from vibench.cli.console import new_console, print_frame
from vibench.cli.doctor import doctor
from vibench.cli.progress import ProgressDisplay
from vibench.cli.result_commands import Form, RunArgument, compare_runs, write_report
from vibench.errors import RequestError, VibenchError, unknown_name
from vibench.execution.recorded_cell import recorded_cell
from vibench.execution.run import Options, Outcome, run_study
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers
from vibench.qp.status import Status
from vibench.report import figures, replay
from vibench.results import invariants, tables
from vibench.results.columns import TABLES
from vibench.results.solver_agreement import sentence
from vibench.stages.artefacts import usable_store
from vibench.study import registry
from vibench.study.cells import Cell, expand
from vibench.study.reader import load_study
from vibench.study.spec import Study

app = typer.Typer(
    name="vibench",
    help="Benchmark reduced-order models of parametrised variational inequalities.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

LISTS = {"problems": "problem", "primal": "primal strategy", "dual": "dual strategy", "studies": "study"}


@app.command(epilog=completion.examples("run"))
def run(
    study: Annotated[
        str, typer.Argument(help="A registered study, or a TOML file.", autocompletion=completion.studies)
    ] = "quick",
    problem: Annotated[
        list[str] | None,
        typer.Option(
            help="Replace the problems of the study (repeatable).", autocompletion=completion.names("problem")
        ),
    ] = None,
    dual: Annotated[
        list[str] | None,
        typer.Option(help="Replace the dual strategies.", autocompletion=completion.names("dual strategy")),
    ] = None,
    primal: Annotated[
        list[str] | None,
        typer.Option(help="Replace the primal strategies.", autocompletion=completion.names("primal strategy")),
    ] = None,
    solver: Annotated[
        list[str] | None, typer.Option(help="Replace the QP solvers.", autocompletion=completion.solvers)
    ] = None,
    pod_tol: Annotated[list[float] | None, typer.Option(help="Replace the tolerances (or sizes) of the POD.")] = None,
    dual_tol: Annotated[list[float] | None, typer.Option(help="Replace those of the dual strategies.")] = None,
    primal_tol: Annotated[list[float] | None, typer.Option(help="Replace those of the primal strategies.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; runs/<study> unless given.")] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Worker processes; 0: one per core. Changes no result.")] = 0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List the matrix and stop.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Begin from nothing, not from earlier results.")] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Also redo cells that did not end ok.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 if a cell is not ok or unavailable.")] = False,
    draw: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the figures in the end.")] = True,
    executor: Annotated[
        Literal["local", "dask"], typer.Option(help="Processes of this machine, or the workers of a dask cluster.")
    ] = "local",
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A dask scheduler; a cluster on this machine unless given.")
    ] = None,
) -> None:
    """Run a study's matrix. An interrupted run goes on where it stopped."""
    overrides = {
        "problem": problem, "dual": dual, "primal": primal, "solvers": solver,
        "pod": pod_tol, "dual_tol": dual_tol, "primal_tol": primal_tol,
    }  # fmt: skip
    loaded = load_study(study, {axis: values for axis, values in overrides.items() if values})
    console = new_console()
    if dry_run:
        _list_matrix(console, expand(loaded))
        return
    if scheduler is not None and executor != "dask":
        raise RequestError(f"--scheduler {scheduler} is for --executor dask")
    folder = out or Path("runs") / loaded.name
    options = Options(jobs or provenance.cores(), fresh, retry, executor, scheduler)
    with ProgressDisplay(console) as progress:
        outcome = run_study(loaded, folder, progress, options)
    path = tables.results_file(str(folder))
    tables.export(path, folder / "tables")
    if outcome.interrupted:
        console.print(f"interrupted: {outcome.missing} cells have no row yet; the same command goes on from here")
        raise typer.Exit(130)
    drawn = figures.draw_all(path, folder / "figures", jobs=min(options.jobs, provenance.cores())) if draw else []
    _summarise(console, loaded, folder, outcome, drawn)
    if strict and any(row["status"] not in (Status.OK, Status.UNAVAILABLE) for row in outcome.rows):
        raise typer.Exit(1)


@app.command("list", epilog=completion.examples("list"))
def list_plugins(
    what: Annotated[
        str | None,
        typer.Argument(
            help="problems, primal, dual, solvers or studies; all of them unless given.",
            autocompletion=completion.lists,
        ),
    ] = None,
) -> None:
    """List what is registered. Names, what they are, and their options."""
    console = new_console()
    if what is not None and what not in (*LISTS, "solvers"):
        raise unknown_name("list", what, (*LISTS, "solvers"))
    for title in [what] if what else [*LISTS, "solvers"]:
        rows = _solver_rows() if title == "solvers" else _plugin_rows(LISTS[title])
        columns = ("name", "version" if title == "solvers" else "from", "what", "options")
        print_frame(console, pd.DataFrame(rows, columns=columns), title)


@app.command(epilog=completion.examples("show"))
def show(
    run: RunArgument,
    table: Annotated[
        str, typer.Option(help=f"summary, benefits, {', '.join(TABLES)}.", autocompletion=completion.table_names)
    ] = "summary",
    form: Annotated[Form, typer.Option("--format", help="How to print it.")] = "terminal",
) -> None:
    """Print a table of a run."""
    path = tables.results_file(run)
    derived = {"summary": ("cells", tables.summary), "benefits": ("thresholds", tables.benefits)}
    if table in derived:
        source, view = derived[table]
        frame = view(tables.read(path, source))
    elif table in TABLES:
        frame = tables.in_order(tables.read(path, table))
    else:
        raise unknown_name("table", table, (*derived, *TABLES))
    if form == "terminal":
        print_frame(new_console(), frame, f"{path.parent.name}: {table}")
    else:
        sys.stdout.write(tables.FORMS[form](frame))


app.command("report", epilog=completion.examples("report"))(write_report)
app.command("diff", epilog=completion.examples("diff"))(compare_runs)


@app.command("replay", epilog=completion.examples("replay"))
def replay_query(
    run: RunArgument,
    cell: Annotated[
        str, typer.Argument(metavar="CELL", help="Key of a cell, or its beginning.", autocompletion=completion.cells)
    ],
    query: Annotated[int | None, typer.Option(min=0, help="Which query; the worst of the cell unless given.")] = None,
    out: Annotated[Path | None, typer.Option(help="File for the program; in RUN/replay unless given.")] = None,
) -> None:
    """Solve the program of one query again with every solver."""
    recorded = recorded_cell(run, cell)
    number = replay.worst_query(recorded) if query is None else query
    file = out or recorded.path.parent / "replay" / f"{recorded.row['cell']}-{number}.npz"
    frame = replay.replay(recorded, number, file)
    console = new_console()
    console.print(f"{recorded.cell}, query {number}: mu = {recorded.parameters[number].tolist()}", soft_wrap=True)
    print_frame(console, frame, f"accuracy {recorded.cell.accuracy:g}, our residuals; distance of u from the record")
    console.print(f"the program, as qpsolvers reads it: {file}", soft_wrap=True)


@app.command(epilog=completion.examples("export-qps"))
def export_qps(
    run: RunArgument,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that is new, or empty.")],
) -> None:
    """Write the programs of a run as a test set for QP solvers. With their solutions."""
    count = replay.export(run, folder)
    new_console().print(
        f"{count} programs in {folder / 'programs'}; `python {folder / replay.CHECKER}` rechecks every solution",
        soft_wrap=True,
    )


@app.command(epilog=completion.examples("clean"))
def clean(
    older_than: Annotated[float, typer.Option(min=0.0, metavar="DAYS", help="Keep what is younger.")] = 0.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only show what there is.")] = False,
) -> None:
    """Show what artefacts take on the disk, and free it. Results stay."""
    console, store = new_console(), usable_store()
    found = pd.DataFrame(store.contents(), columns=["stage", "MiB", "days"])
    found["MiB"], found["days"] = found["MiB"] / 2**20, found["days"] / 86400.0
    table = found.groupby("stage", as_index=False).agg(
        artefacts=("MiB", "size"), MiB=("MiB", "sum"), oldest=("days", "max")
    )
    print_frame(console, table.rename(columns={"oldest": "oldest [days]"}), f"artefacts in {store.folder}")
    if not dry_run:
        freed = store.clear(older_than * 86400.0)
        console.print(f"{freed / 2**20:.1f} MiB freed; what is needed again is computed again")


app.command(epilog=completion.examples("doctor"))(doctor)
plugin_commands.add_commands(app)


def main() -> None:
    """Entry point: what is wrong with a request is one line and exit code 2."""
    usage_error = typer.BadParameter.__mro__[2]  # click's ClickException, whichever copy of click typer brings
    try:
        code = app(args=sys.argv[1:] or ["--help"], standalone_mode=False)
    except RequestError as error:
        code = _refuse(error)
    except VibenchError as error:
        code = _refuse(error, 1)
    except OSError as error:
        where = f"'{error.filename}' cannot be written or read: " if error.filename else ""
        code = _refuse(f"{where}{error.strerror or error}", 1)
    except typer.Abort:
        code = 130
    except Exception as error:
        if not isinstance(error, usage_error):
            raise
        code = _refuse(error.format_message())  # type: ignore[attr-defined]
    sys.exit(code if isinstance(code, int) else 0)


def _refuse(error: object, code: int = 2) -> int:
    sys.stderr.write("vibench: " + " ".join(str(error).split()) + "\n")
    return code


def _list_matrix(console: Console, cells: list[Cell]) -> None:
    for cell in cells:
        console.print(f"{cell.key}  {cell}", markup=False, soft_wrap=True)
    console.print(f"{len(cells)} cells")


def _summarise(console: Console, study: Study, folder: Path, outcome: Outcome, drawn: list[Path]) -> None:
    path = tables.results_file(str(folder))
    print_frame(console, tables.summary(tables.read(path, "cells")), study.name)
    short = [row for row in outcome.rows if row["status"] != Status.OK]
    for row in short:
        tolerance = "" if row["primal_tol"] is None else f" {row['primal_tol']:g}"
        console.print(
            f"{row['status']}: {row['problem']} · {row['dual']} · {row['primal']}{tolerance} · {row['solver']}: "
            f"{row['queries_ok']} of {row['queries']} queries ok; {row['reason']}",
            markup=False, soft_wrap=True,
        )  # fmt: skip
    console.print(f"{len(outcome.rows)} cells, {len(outcome.rows) - len(short)} ok, {len(short)} fell short")
    queries = tables.read(path, "queries")
    broken = invariants.violations(queries, tables.read(path, "cells").set_index("cell")["enrichment_kind"])
    for violation in broken:
        console.print(f"invariant: {violation}; this is a bug of vibench or of a plugin's spaces")
    if not broken:
        console.print(f"invariants of the constants and the error bounds hold in all {len(queries)} queries")
    console.print(sentence(tables.read(path, "disagreements")))
    console.print(f"results: {path}, tables: {folder / 'tables'}, {len(drawn)} figures: {folder / 'figures'}")


def _plugin_rows(kind: str) -> list[tuple[str, str, str, str]]:
    rows = []
    for name in registry.names(kind):
        if kind == "study":
            rows.append((name, registry.version(kind, name), _study_summary(name), ""))
            continue
        try:
            summary = (registry.load(kind, name).__doc__ or "").strip().split("\n")[0]
            options = [
                f"{o.name}: {o.expected}" + f" = {o.default}" * bool(o.default) for o in registry.options(kind, name)
            ]
        except RequestError as error:
            summary, options = str(error), []
        rows.append((name, registry.version(kind, name), summary, "\n".join(options)))
    return rows


def _study_summary(name: str) -> str:
    try:
        return f"{len(expand(load_study(name)))} cells"
    except RequestError as error:
        return str(error)


def _solver_rows() -> list[tuple[str, str, str, str]]:
    extra = registry.names("QP solver")
    installed = installed_solvers(extra)
    known = sorted({*SETTINGS, *extra})
    return [
        (name, provenance.solver_version(name), "installed" if name in installed else "not installed", "")
        for name in known
    ]
