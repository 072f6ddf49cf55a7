"""Commands on finished runs: tables, reports, comparisons, and their quadratic programs solved again or exported."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Exit, Option

from vibench.cli.completion import cells, runs, table_names
from vibench.cli.output import echo
from vibench.errors import unknown_name
from vibench.results.columns import TABLES

Form = Literal["terminal", "markdown", "csv", "latex", "json"]
FormOption = Annotated[Form, Option("--format", help="Output format.")]
RunArgument = Annotated[str, Argument(metavar="RUN", help="A run folder, or its name in runs/.", autocompletion=runs)]


def show(
    run: RunArgument,
    table: Annotated[
        str, Option(help=f"summary, benefits, {', '.join(TABLES)}.", autocompletion=table_names)
    ] = "summary",
    form: FormOption = "terminal",
) -> None:
    """Print a table of a run."""
    from vibench.results import tables
    from vibench.terminal.console import print_frame

    path = tables.results_file(run)
    derived = {"summary": ("cells", tables.summary), "benefits": ("thresholds", tables.benefits)}
    if table not in derived and table not in TABLES:
        raise unknown_name("table", table, (*derived, *TABLES))
    source, view = derived.get(table, (table, tables.in_order))
    frame = view(tables.read(path, source))
    if form == "terminal":
        print_frame(frame, f"{path.parent.name}: {table}")
    else:
        sys.stdout.write(tables.FORMS[form](frame))


def write_report(
    run: RunArgument, out: Annotated[Path | None, Option(help="HTML file; RUN/report.html by default.")] = None
) -> None:
    """Write the report of a run as one HTML page."""
    from vibench.execution.run import REPORT
    from vibench.report import html
    from vibench.results import tables

    path = tables.results_file(run)
    echo(f"report: {html.write(path, out or path.parent / REPORT)}")


def compare_runs(
    a: Annotated[
        str, Argument(metavar="A", help="The earlier run: a folder, or its name in runs/.", autocompletion=runs)
    ],
    b: Annotated[str, Argument(metavar="B", help="The later run.", autocompletion=runs)],
    limit: Annotated[float, Option(min=1.0, help="Factor by which a number may get worse.")] = 1.25,
    form: FormOption = "terminal",
) -> None:
    """Compare two runs; exit code 1 if a number got worse."""
    from vibench.report import compare
    from vibench.results import tables
    from vibench.terminal.console import print_frame

    found = compare.compare(tables.results_file(a), tables.results_file(b), limit)
    if form != "terminal":
        sys.stdout.write(tables.FORMS[form](found.changes))
    else:
        if len(found.changes):
            print_frame(found.changes, f"{a} → {b}")
        last = f"{len(found.changes)} changes beyond a factor of {limit:g}, {found.regressions} for the worse"
        echo(*found.notes, last)
    if found.regressions:
        raise Exit(1)


def replay_query(
    run: RunArgument,
    cell: Annotated[str, Argument(metavar="CELL", help="Key of a cell, or its beginning.", autocompletion=cells)],
    query: Annotated[int | None, Option(min=0, help="Number of the query; the worst of the cell by default.")] = None,
    out: Annotated[Path | None, Option(help="File for the program; in RUN/replay by default.")] = None,
) -> None:
    """Solve the program of one query again with every solver."""
    from vibench.execution.recorded_cell import recorded_cell
    from vibench.report import replay
    from vibench.terminal.console import print_frame

    recorded = recorded_cell(run, cell)
    number = replay.worst_query(recorded) if query is None else query
    file = out or recorded.path.parent / "replay" / f"{recorded.row['cell']}-{number}.npz"
    frame = replay.replay(recorded, number, file)
    echo(f"{recorded.cell}, query {number}: mu = {recorded.parameters[number].tolist()}")
    print_frame(frame, f"accuracy {recorded.cell.accuracy:g}, our residuals; distance of u from the record")
    echo(f"the program, as qpsolvers reads it: {file}")


def export_qps(
    run: RunArgument, folder: Annotated[Path, Argument(metavar="DIR", help="A new or empty folder.")]
) -> None:
    """Export the programs of a run as a test set for QP solvers. The set includes their solutions."""
    from vibench.report import replay

    count = replay.export(run, folder)
    echo(f"{count} programs in {folder / 'programs'}; `python {folder / replay.CHECKER}` rechecks every solution")
