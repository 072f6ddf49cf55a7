"""Commands on finished runs: a report to look at, and what changed between two runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from vibench.cli import completion
from vibench.cli.console import new_console, print_frame
from vibench.execution.run import REPORT
from vibench.report import compare, html
from vibench.results import tables

Form = Literal["terminal", "markdown", "csv", "latex", "json"]

RunArgument = Annotated[
    str,
    typer.Argument(
        metavar="RUN", help="A run folder, or the name of a study run before.", autocompletion=completion.runs
    ),
]


def write_report(
    run: RunArgument,
    out: Annotated[Path | None, typer.Option(help="The HTML file; report.html in the run folder unless given.")] = None,
) -> None:
    """Write what a run found as one HTML page."""
    path = tables.results_file(run)
    target = html.write(path, out or path.parent / REPORT)
    new_console().print(f"report: {target}", soft_wrap=True)


def compare_runs(
    a: Annotated[
        str, typer.Argument(metavar="A", help="A run folder or study: before.", autocompletion=completion.runs)
    ],
    b: Annotated[str, typer.Argument(metavar="B", help="Another: after.", autocompletion=completion.runs)],
    limit: Annotated[float, typer.Option(min=1.0, help="Factor by which a number may get worse.")] = 1.25,
    form: Annotated[Form, typer.Option("--format", help="How to print it.")] = "terminal",
) -> None:
    """Say what changed between two runs; 1 if for the worse."""
    one, two = tables.results_file(a), tables.results_file(b)
    found = compare.compare(one, two, limit)
    console = new_console()
    if form != "terminal":
        sys.stdout.write(tables.FORMS[form](found.changes))
    else:
        if len(found.changes):
            print_frame(console, found.changes, f"{a} → {b}")
        for note in found.notes:
            console.print(note)
        console.print(f"{len(found.changes)} changes beyond a factor of {limit:g}, {found.regressions} for the worse")
    if found.regressions:
        raise typer.Exit(1)
