"""Commands that print what finished runs hold: tables, comparisons, and a quadratic program that is solved again."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Exit, Option

from vibench.cli.completion import SHOWN, cell_columns, cells, column_names, error_measures, runs, table_names
from vibench.cli.console import echo, print_frame, run_argument, shown
from vibench.errors import RequestError

if TYPE_CHECKING:
    import pandas as pd

    from vibench.report.comparison import Comparison

Form = Literal["terminal", "markdown", "csv", "latex", "json"]
FormOption = Annotated[Form, Option("--format", help="Output format.")]
At = Annotated[list[str] | None, Option(metavar="NAME=PATH", help="Present place of a moved pack (repeatable).")]


def places_of(at: list[str] | None) -> dict[str, str]:
    """Absolute places of files and folders by name, from texts NAME=PATH."""
    pairs = [one.partition("=") for one in at or ()]
    for name, _, path in pairs:
        if not name or not path:
            raise RequestError(f"--at is '{name}', expected NAME=PATH, as in --at model=../model")
    return {name: str(Path(path).absolute()) for name, _, path in pairs}


RunArgument = Annotated[str, Argument(metavar="RUN", help="A run folder, or its name in runs/.", autocompletion=runs)]
RunsArgument = Annotated[
    list[str], Argument(metavar="RUN", help="Run folders, results files, or names in runs/.", autocompletion=runs)
]


def show(
    run: RunArgument,
    cell: Annotated[
        str, Argument(metavar="CELL", help="Key of a cell, or its beginning: all of its columns.", autocompletion=cells)
    ] = "",
    table: Annotated[str, Option(help=f"{', '.join(SHOWN)}.", autocompletion=table_names)] = "summary",
    columns: Annotated[
        str, Option(metavar="NAME,…", help="Columns to print, or all.", autocompletion=column_names)
    ] = "",
    where: Annotated[
        str, Option(metavar="CONDITION", help="Rows to print: \"solver = 'piqp' and beta_span_min < 1e-3\".")
    ] = "",
    sort: Annotated[
        str, Option(metavar="NAME,…", help="Columns to sort by; -NAME: largest first.", autocompletion=column_names)
    ] = "",
    limit: Annotated[int | None, Option(min=0, metavar="N", help="Print the first N rows; all by default.")] = None,
    error: Annotated[
        str, Option(help="Compare models by solution, u, lambda, output:NAME.", autocompletion=error_measures)
    ] = "",
    within: Annotated[float | None, Option(metavar="ERROR", help="Largest error in best and benefits.")] = None,
    queries: Annotated[float | None, Option(metavar="N", help="Best: the cheapest model for N queries.")] = None,
    form: FormOption = "terminal",
) -> None:
    """Print a table of a run, or one cell of it.

    On a terminal, columns that do not fit are left out; csv and json have the values and names of the results file.
    """
    from vibench.results import formats, show
    from vibench.results.read import results_file
    from vibench.results.selection import parts
    from vibench.text import new_console

    path = results_file(run)
    view = show.look_up(
        path, table, cell=cell, error=error, largest=within, queries=queries,
        columns=parts(columns), where=where, sort=parts(sort), limit=limit or 0,
    )  # fmt: skip
    # A cell alone is a list of all its columns: no table is as wide.
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
        # Programs read csv and json, people the other forms, with headings and rounded numbers.
        sys.stdout.write(formats.to_text(view.exact if form in {"csv", "json"} else view.readable, form))


def compare_runs(
    run: RunsArgument,
    limit: Annotated[float, Option(min=1.0, help="Factor by which a number may get worse.")] = 1.25,
    table: Annotated[
        Literal["changes", "columns", "runs", "cells"] | None,
        Option(help="Print one table: the changes, their numbers by column, the runs, or cells that runs lack."),
    ] = None,
    column: Annotated[
        str, Option(metavar="NAME", help="Print a column of the cells in every run.", autocompletion=cell_columns)
    ] = "",
    strict: Annotated[bool, Option("--strict", help="Exit with 1 if a number got worse.")] = False,
    form: FormOption = "terminal",
) -> None:
    """Compare runs: what is equal, what moved, and by how much.

    The first run is the reference for numbers, the first run of the same machine for seconds.
    """
    from vibench.report.comparison import compare
    from vibench.results import formats
    from vibench.results.read import results_file, whole_numbers

    compared = compare([results_file(one) for one in run], limit)
    frame = compared.values(column) if column else compared.table(table or "changes")
    if form != "terminal":
        sys.stdout.write(formats.to_text(whole_numbers(frame), form))
    elif column or table not in (None, "changes"):
        # What a table says of each run, in a column of its own, matters most.
        names = [one.name for one in compared.runs]
        _print_compared(frame, f"{column} of the cells" if column else str(table), names)
    else:
        if table is None:
            _print_overview(compared)
        _print_changes(compared, limit)
    if strict and compared.regressions:
        raise Exit(1)


def replay_query(
    run: RunArgument,
    cell: Annotated[str, Argument(metavar="CELL", help="Key of a cell, or its beginning.", autocompletion=cells)],
    query: Annotated[int | None, Option(min=0, help="Number of the query; the worst of the cell by default.")] = None,
    out: Annotated[Path | None, Option(help="File for the program; in RUN/replay by default.")] = None,
    at: At = None,
) -> None:
    """Solve the program of one query again with every solver."""
    from vibench.execution.recorded_cell import recorded_cell
    from vibench.report import replay

    recorded = recorded_cell(run, cell, places_of(at))
    number = replay.worst_query(recorded) if query is None else query
    file = out or recorded.path.parent / "replay" / f"{recorded.row['cell']}-{number}.npz"
    frame = replay.replay(recorded, number, file)
    echo(f"{recorded.cell}, query {number}: mu = {recorded.parameters[number].tolist()}")
    print_frame(frame, f"accuracy {recorded.cell.accuracy:g}, our residuals; distance of u from the record")
    echo(f"the program, as qpsolvers reads it: {file}")


def _print_changes(compared: Comparison, limit: float) -> None:
    """Print what changed between runs, the worst first, and how many changes there are."""
    from vibench.report.differences import ChangeKind

    # By verdict, then by how far the ratio is from 1: a factor of 2 is as far as one of 1/2.
    order = -compared.changes["verdict"].map([verdict.value for verdict in ChangeKind].index)
    far = compared.changes["ratio"].map(lambda ratio: max(ratio, 1.0 / ratio) if ratio > 0.0 else 1.0)
    weighed = compared.changes.assign(order=order, far=-far).sort_values(["order", "far"], kind="stable")
    changes = readable(weighed.drop(columns=["order", "far"]), len(compared.runs))
    # Forty changes are some screens; programs read all of them as CSV.
    if len(changes):
        names = [run.name for run in compared.runs]
        title = " → ".join(names) if len(names) == 2 else f"changes from {names[0]}"
        _print_compared(changes.head(40), title)
    if len(changes) > 40:
        echo(f"{len(changes) - 40} more changes: `--format csv` lists all of them")
    echo(*compared.notes, f"{len(changes)} changes beyond a factor of {limit:g}, {compared.regressions} for the worse")


def _print_overview(compared: Comparison) -> None:
    """Print the runs, and how many cells moved by column."""
    from vibench.report.differences import ChangeKind

    _print_compared(compared.by_run, "runs", every=True)
    echo("")
    names = [run.name for run in compared.runs]
    title = f"{names[1]} against {names[0]}" if len(names) == 2 else f"against {names[0]}"
    by_column = compared.by_column
    # Columns of verdicts that no cell has take room from the others.
    nobody = [verdict.value for verdict in ChangeKind if not by_column[verdict.value].any()]
    _print_compared(readable(by_column.drop(columns=nobody), len(names)), f"cells by column, {title}")
    echo("")


def _print_compared(frame: pd.DataFrame, title: str, first: Sequence[str] = (), *, every: bool = False) -> None:
    # Columns that matter most come first.
    priority = [
        *first, "run", "what", "verdict", "before", "after", "ratio", "cells", "equal", "worse", "better", "changed",
        "problem", "formulation", "dual", "primal", "solver", "asked", "interval", "within accuracy", "within limit",
        "undecided", "farthest ratio", "against", "accuracy", "assembly", "bounds", "correction", "cell", "study", "ok",
        "only here", "same code", "in all runs", "machine", "seed", "validation",
    ]  # fmt: skip
    print_frame(frame, title, priority, every=every, rest="--format csv")


def readable(frame: pd.DataFrame, runs: int) -> pd.DataFrame:
    """A table with both ends of an interval in one column, and without the names of runs that its title has."""
    import pandas as pd

    from vibench.results.formats import cell_text

    ends = zip(frame["ratio_low"], frame["ratio_high"], strict=True)
    texts = ["" if pd.isna(low) else f"{cell_text(low)}–{cell_text(high)}" for low, high in ends]
    shown = frame.drop(columns=["ratio_low", "ratio_high", *["run", "against"] * (runs == 2)])
    shown.insert(shown.columns.get_loc("ratio") + 1, "interval", texts)
    return shown.rename(columns={"farthest_ratio": "farthest ratio"})
