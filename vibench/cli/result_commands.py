"""Commands that print what finished runs hold: tables, comparisons, and a quadratic program that is solved again."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Exit, Option

from vibench.cli.completion import SHOWN, cell_columns, cells, column_names, error_measures, runs, table_names
from vibench.cli.console import echo, run_argument
from vibench.errors import RequestError

EXAMPLE = "solver = 'piqp' and beta_span_min < 1e-3"
"""Condition in the help of `--where`."""

Form = Literal["terminal", "markdown", "csv", "latex", "json"]
FormOption = Annotated[Form, Option("--format", help="Output format.")]
At = Annotated[
    list[str] | None,
    Option(metavar="NAME=PATH", help="Where a file or folder of the study, such as a pack, is now (repeatable)."),
]


def places_of(at: list[str] | None) -> dict[str, str]:
    """Places of files and folders, absolute, by name.

    Raises a `RequestError` if one is none.
    """
    pairs = [one.partition("=") for one in at or ()]
    for name, _, path in pairs:
        if not name or not path:
            raise RequestError(f"--at is '{name}', expected NAME=PATH, as in --at model=../model")
    return {name: str(Path(path).absolute()) for name, _, path in pairs}


RunArgument = Annotated[str, Argument(metavar="RUN", help="A run folder, or its name in runs/.", autocompletion=runs)]


def show(
    run: RunArgument,
    cell: Annotated[
        str,
        Argument(
            metavar="[CELL]",
            help="Key of a cell, or its beginning: all of its columns, or its rows in another table.",
            autocompletion=cells,
        ),
    ] = "",
    table: Annotated[str, Option(help=f"{', '.join(SHOWN)}.", autocompletion=table_names)] = "summary",
    columns: Annotated[
        str, Option(metavar="NAME,…", help="Columns to print, or all.", autocompletion=column_names)
    ] = "",
    where: Annotated[str, Option(metavar="CONDITION", help=f'Rows to print: "{EXAMPLE}".')] = "",
    sort: Annotated[
        str,
        Option(metavar="NAME,…", help="Columns to sort by; -NAME for the largest first.", autocompletion=column_names),
    ] = "",
    limit: Annotated[int, Option(min=0, metavar="N", help="Print the first N rows; 0 for all.")] = 0,
    error: Annotated[
        str,
        Option(
            metavar="MEASURE",
            help="Compare models by the error of solution, u, lambda or output:NAME.",
            autocompletion=error_measures,
        ),
    ] = "",
    within: Annotated[
        float | None,
        Option(metavar="ERROR", help="Break-even, or with --queries best, of models with this error at most: 0.01."),
    ] = None,
    queries: Annotated[
        float | None, Option(metavar="N", help="In the table best: the cheapest model in total for N queries.")
    ] = None,
    form: FormOption = "terminal",
) -> None:
    """Print a table of a run, or one cell of it.

    On a terminal, columns that do not fit are left out; csv and json have the values and names of the results file.
    """
    from vibench.cli.console import print_frame, shown
    from vibench.results import formats, show
    from vibench.results.read import results_file
    from vibench.results.selection import parts
    from vibench.text import new_console

    path = results_file(run)
    measured = partial(show.look_up, path, table, cell=cell, error=error, largest=within, queries=queries)
    view = measured(columns=parts(columns), where=where, sort=parts(sort), limit=limit)
    if form == "terminal" and cell and table == "summary" and not columns and len(view.rows):
        (key,) = view.rows["cell"]
        described, empty = view.described
        print_frame(described, f"cell {key} of {path.parent.name}", every=True)
        new_console().print(shown(f"empty: {', '.join(empty)}"))
        return
    if form == "terminal":
        rest = f"vibench show {run_argument(path.parent)} CELL" if view.view.source == "cells" else "--format csv"
        title = f"{path.parent.name}: {table}"
        print_frame(view.readable, title, view.priority, axes=view.axes, every=view.chosen, rest=rest)
        if view.rows.empty and view.view.empty:
            echo(view.view.empty)
    else:
        sys.stdout.write(formats.FORMS[form](view.exact if form in {"csv", "json"} else view.readable))


LimitOption = Annotated[float, Option(min=1.0, help="Factor by which a number may get worse.")]


def diff_runs(
    a: Annotated[
        str, Argument(metavar="A", help="The earlier run: a folder, or its name in runs/.", autocompletion=runs)
    ],
    b: Annotated[str, Argument(metavar="B", help="The later run.", autocompletion=runs)],
    limit: LimitOption = 1.25,
    form: FormOption = "terminal",
) -> None:
    """List changes between two runs; exit code 1 on a regression."""
    from vibench.cli import comparison
    from vibench.report.comparison.compare import compare
    from vibench.results import formats
    from vibench.results.read import results_file

    compared = compare([results_file(a), results_file(b)], limit)
    if form == "terminal":
        comparison.print_changes(compared, limit)
    else:
        sys.stdout.write(formats.FORMS[form](compared.changes))
    if compared.regressions:
        raise Exit(1)


def compare_runs(
    run: Annotated[
        list[str],
        Argument(metavar="RUN", help="Run folders or results files; the first is the reference.", autocompletion=runs),
    ],
    limit: LimitOption = 1.25,
    table: Annotated[
        Literal["changes", "columns", "runs", "cells"] | None,
        Option(help="Print one table: changes, what moved by column, the runs, or cells that only some runs have."),
    ] = None,
    column: Annotated[
        str, Option(metavar="NAME", help="Print a column of the cells in every run.", autocompletion=cell_columns)
    ] = "",
    form: FormOption = "terminal",
) -> None:
    """Compare runs: what is equal, what moved, and by how much.

    Numbers are compared with the first run, seconds with the first run of the same machine.
    """
    from vibench.cli import comparison
    from vibench.report.comparison.compare import compare
    from vibench.results import formats
    from vibench.results.read import results_file, whole_numbers

    compared = compare([results_file(one) for one in run], limit)
    if column:
        title, frame = f"{column} of the cells", compared.values(column)
    elif table is None and form == "terminal":
        comparison.print_comparison(compared, limit)
        return
    else:
        title, frame = table or "changes", compared.table(table or "changes")
    if form == "terminal":
        comparison.print_table(compared, frame, title)
    else:
        sys.stdout.write(formats.FORMS[form](whole_numbers(frame)))


def replay_query(
    run: RunArgument,
    cell: Annotated[str, Argument(metavar="CELL", help="Key of a cell, or its beginning.", autocompletion=cells)],
    query: Annotated[int | None, Option(min=0, help="Number of the query; the worst of the cell by default.")] = None,
    out: Annotated[Path | None, Option(help="File for the program; in RUN/replay by default.")] = None,
    at: At = None,
) -> None:
    """Solve the program of one query again with every solver."""
    from vibench.cli.console import print_frame
    from vibench.execution.recorded_cell import recorded_cell
    from vibench.report import replay

    recorded = recorded_cell(run, cell, places_of(at))
    number = replay.worst_query(recorded) if query is None else query
    file = out or recorded.path.parent / "replay" / f"{recorded.row['cell']}-{number}.npz"
    frame = replay.replay(recorded, number, file)
    echo(f"{recorded.cell}, query {number}: mu = {recorded.parameters[number].tolist()}")
    print_frame(frame, f"accuracy {recorded.cell.accuracy:g}, our residuals; distance of u from the record")
    echo(f"the program, as qpsolvers reads it: {file}")
