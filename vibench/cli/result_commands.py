"""Commands on finished runs: tables, comparisons, reports, sites, figures, programs and models."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Exit, Option

from vibench.cli.completion import cell_columns, cells, column_names, error_measures, runs, table_names
from vibench.cli.console import echo, print_frame, run_argument, shown, warn
from vibench.errors import RequestError
from vibench.results.schema import TABLES

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


def components(option: str, text: str) -> list[float]:
    """The components of a parameter on the command line."""
    try:
        return [float(each) for each in text.split(",")]
    except ValueError:
        raise RequestError(f"{option} is {text!r}, expected numbers separated by commas, such as 1.2,0.05") from None


RunArgument = Annotated[str, Argument(metavar="RUN", help="A run folder, or its name in runs/.", autocompletion=runs)]
RunsArgument = Annotated[
    list[str], Argument(metavar="RUN", help="Run folders, results files, or names in runs/.", autocompletion=runs)
]


def show(
    run: RunArgument,
    cell: Annotated[
        str, Argument(metavar="CELL", help="Key of a cell, or its beginning: all of its columns.", autocompletion=cells)
    ] = "",
    table: Annotated[
        str, Option(help=f"summary, best, benefits, {', '.join(TABLES)}.", autocompletion=table_names)
    ] = "summary",
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
        _print_compared(frame, f"{column} of the cells" if column else str(table), [one.name for one in compared.runs])
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
    if len(compared.verdicts):
        _print_compared(compared.verdicts, "the best models within 1 % for u and λ")
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
    from vibench.results.formats import decimal_interval

    texts = list(map(decimal_interval, frame["ratio_low"], frame["ratio_high"]))
    shown = frame.drop(columns=["ratio_low", "ratio_high", *["run", "against"] * (runs == 2)])
    shown.insert(shown.columns.get_loc("ratio") + 1, "interval", texts)
    return shown.rename(columns={"farthest_ratio": "farthest ratio"})


# Typer takes no list of literals.
FigureFormat = StrEnum("FigureFormat", ["png", "svg", "pdf"])


def write_report(
    run: RunArgument,
    out: Annotated[Path | None, Option(help="HTML file; RUN/report.html by default.")] = None,
    figures: Annotated[bool, Option("--figures/--no-figures", help="Add pictures, which take most time.")] = True,
) -> None:
    """Write the report of a run as one HTML page."""
    from vibench.execution.recording import REPORT
    from vibench.report import html
    from vibench.results.read import results_file

    path = results_file(run)
    echo(f"report: {html.write(path, out or path.parent / REPORT, figures=figures)}")


def draw_figures(
    names: RunsArgument,
    out: Annotated[Path | None, Option(metavar="DIR", help="Folder; RUN/figures by default.")] = None,
    formats: Annotated[list[FigureFormat] | None, Option("--format", help="Default: png and svg (repeatable).")] = None,
) -> None:
    """Draw the figures of runs, of all kinds, with captions."""
    from vibench.results.read import results_file

    # A run may be named twice: as a folder and by its name.
    paths = list({results_file(name).resolve(): results_file(name) for name in names}.values())
    forms = tuple(dict.fromkeys(map(str, formats or ("png", "svg"))))
    if out is not None and len(paths) > 1:
        raise RequestError("--out is for the figures of one run; those of several go into their folders")
    whole = [draw_run(path, out or path.parent / "figures", forms) for path in paths]
    if not all(whole):
        raise Exit(1)


def draw_run(
    path: Path, folder: Path, formats: tuple[str, ...] = ("png", "svg"), kinds: tuple[str, ...] | None = None
) -> bool:
    """Draw the figures of a results file, and return whether none failed; Ctrl-C leaves those that are drawn."""
    from vibench.library.progress import DrawingDisplay
    from vibench.report import figures

    # The run is complete at this point: Ctrl-C costs pictures alone, and says how to get them.
    try:
        with DrawingDisplay() as display:
            drawn, failures = figures.draw_all(path, folder, formats, display.show, kinds)
    except KeyboardInterrupt:
        missing = f"some figures are missing; `vibench figures {run_argument(path.parent)}` draws them"
        echo(f"interrupted while drawing: results and tables are complete, {missing}")
        raise Exit(130) from None
    for line in failures:
        warn(line)
    echo(f"{len(drawn)} figures: {folder}")
    return not failures


def publish_runs(
    run: RunsArgument,
    site: Annotated[Path, Argument(metavar="SITE", help="A new folder, or one that this command wrote.")],
    title: Annotated[str, Option(help="Title of the site.")] = "Benchmark results",
    author: Annotated[list[str] | None, Option(metavar="NAME", help='"Family, Given" or a group (repeatable).')] = None,
    doi: Annotated[str, Option(help="DOI of the deposit, such as 10.5281/zenodo.1234567.")] = "",
    url: Annotated[str, Option(help="Address of the site.")] = "",
    date: Annotated[str, Option(help="Date or year of publication, such as 2026-11-26.")] = "",
    figures: Annotated[bool, Option("--figures/--no-figures", help="Add pictures to the reports.")] = True,
    yes: Annotated[bool, Option("--yes", "-y", help="Do not ask.")] = False,
) -> None:
    """Write a static site of runs: reports, data, leaderboard.

    Links are relative: the site can be opened from a disk and served by any host of static files. Paths, your name and
    that of the host are taken out; the command lists what could still identify somebody, and asks.
    """
    from vibench.report.citation import Citation
    from vibench.report.site import publish
    from vibench.results.read import results_file

    if not title.strip():
        raise RequestError("--title is empty; a site needs one to be cited")
    if not yes and not sys.stdin.isatty():
        raise RequestError("nothing was published: answer the question on a terminal, or say --yes")

    # The site is complete in a scratch folder when this asks, so that no answer leaves anything.
    def ask(lines: Iterator[str]) -> None:
        if not yes:
            echo("what could identify somebody:", *(f"  {line}" for line in lines))
            typer.confirm("Publish it?", abort=True)

    citation = Citation(title, tuple(author or ()), doi, url, date)
    page = publish([results_file(one) for one in run], site, citation, figures=figures, ask=ask)
    echo(f"site of {len(run)} run{'s' * (len(run) > 1)}: {page}")


def export(
    run: RunArgument,
    words: Annotated[
        list[str],
        Argument(
            metavar="[CELL] TARGET",
            help="Without the key of a CELL a new folder for all programs of the run, a test set for QP solvers; "
            "with CELL a new file: NAME.npz for its model, NAME.c for a C program, too, NAME.fmu for an FMU, or "
            "NAME.vtu for ParaView.",
            autocompletion=cells,
        ),
    ],
    mu: Annotated[str, Option(help="Parameter of NAME.vtu: its components, separated by commas.")] = "",
    tolerance: Annotated[
        float | None, Option(metavar="TOL", help="Error of polynomials that replace members; 1e-11 by default.")
    ] = None,
    bases: Annotated[bool, Option("--bases/--no-bases", help="Include the bases that reconstruct u and λ.")] = True,
    sequence: Annotated[bool, Option("--sequence", help="Only programs along paths, for qpbenchmark.")] = False,
    at: At = None,
) -> None:
    """Export programs, a reduced model, or a solution for ParaView.

    A model is used without vibench, in Python, C or as an FMU (FMI 2.0); the fields for ParaView are u, λ and their
    errors at a parameter.
    """
    # The suffix tells what a cell is exported as; programs of a whole run go into a folder, which has none.
    *cell, last = words
    target, kind = Path(last), Path(last).suffix
    if len(cell) > 1 or bool(cell) != (kind in {".npz", ".c", ".fmu", ".vtu"}):
        raise RequestError(
            "expected DIR, a folder for programs, or CELL FILE, whose name ends in .npz, .c, .fmu or .vtu"
        )
    others: dict[str, object] = {"--mu": mu and kind != ".vtu", "--sequence": sequence and cell}
    others |= {"--tolerance": tolerance and kind not in {".npz", ".c", ".fmu"}}
    others |= {"--no-bases": not bases and kind not in {".npz", ".c"}}
    if wrong := [option for option, is_wrong in others.items() if is_wrong]:
        raise RequestError(f"{', '.join(wrong)} has no meaning for '{last}'")
    if not cell:
        from vibench.report import replay

        count = replay.export(run, target, places_of(at), sequence=sequence)
        echo(f"{count} programs in {target / 'programs'}; `python {target / 'check.py'}` rechecks every solution")
    elif kind == ".vtu":
        from vibench.library.runs import open_run
        from vibench.library.vtu import export_vtu

        given = components("--mu", mu)
        export_vtu(open_run(run, at=places_of(at)).model(cell[0]), given, target)
        echo(f"u, λ and their errors at mu = {given}: {target}")
    else:
        _export_model(run, cell[0], target, tolerance, bases, places_of(at))


def _export_model(run: str, cell: str, out: Path, tolerance: float | None, bases: bool, at: Mapping[str, str]) -> None:
    """Export a model, and say which errors its polynomials have, what it bounds and how long its queries take."""
    from vibench.library import reduced_model
    from vibench.library.export import export_model
    from vibench.library.runs import open_run
    from vibench.offline.polynomials import TOLERANCE
    from vibench.timing import timed

    model, file = open_run(run, at=at).model(cell), out.with_suffix(".fmu" if out.suffix == ".fmu" else ".npz")
    made = export_model(model, file, TOLERANCE if tolerance is None else tolerance, bases=bases, c=out.suffix == ".c")
    for name, member in made.members.items():
        terms = f"{len(member.terms)} term{'s' * (len(member.terms) > 1)}"
        form = f"{terms}, polynomials of degree ({', '.join(map(str, member.degrees))})"
        echo(f"{name}: {form if any(member.degrees) else 'constant'}, relative error {member.error:.1e}")
    if made.code is not None:
        echo("B, g: the code of the problem in C")
    echo("relative errors are those at random parameters and at the corners of the box")
    # The script has fewer solvers than vibench.
    if made.code is None and made.about["solver"] != model.solver and file.suffix == ".npz":
        echo(f"the cell's solver is {model.solver}, the script solves by {made.about['solver']}")
    why = made.about["no_bounds"]
    echo(f"no error bounds: {why}" if why else f"error bounds in C: {made.about['certificate']}")
    outputs = made.about["outputs"]
    held, others = ", ".join(output["name"] for output in outputs["linear"]), ", ".join(outputs["left_out"])
    if held or others:
        echo(f"outputs: {held or 'none'}{f'; code that the file cannot hold computes {others}' * bool(others)}")
    if file.suffix == ".fmu":
        echo(f"{file}: FMI 2.0, co-simulation, with its C source and its program for this platform")
        return
    sources = [file.with_suffix(end) for end in (".c", ".h") if out.suffix == ".c"]
    if made.code is not None:
        echo(f"{', '.join(map(str, [file, *sources]))}: the program, and the bases of its answers")
        return
    # The script and the high-fidelity model take turns, so that a change of the machine's pace concerns both.
    mus = model.parameters.sample(5, seed=0)
    calls: list[Callable[..., Any]] = [reduced_model.Model(file).solve, model.high_fidelity]
    seconds = [[timed(partial(call, mu))[1].cpu for call in calls] for mu in (mus[0], *mus)]
    # The first query of both is longer than the others, as caches are cold.
    query, solution = (f"{1e3 * median(column):.2g} ms" for column in zip(*seconds[1:], strict=True))
    echo(f"a query takes {query}; the high-fidelity solution {solution}")
    written = ", ".join(map(str, [file, file.with_name("reduced_model.py"), *sources]))
    echo(f"{written}: `from reduced_model import Model`, then `Model({str(file)!r}).solve(mu)`")


def serve(
    run: RunArgument,
    cell: Annotated[str, Argument(metavar="CELL", help="Key of a cell, or its beginning.", autocompletion=cells)],
    host: Annotated[
        str, Option(metavar="ADDRESS", help="Address to listen at: 0.0.0.0 lets other machines ask.")
    ] = "127.0.0.1",
    port: Annotated[int | None, Option(min=0, max=65535, help="Port; 4242 by default, 0 is a free one.")] = None,
    at: At = None,
) -> None:
    """Serve a reduced model to clients of UM-Bridge.

    An answer has the outputs of the problem, and as a second vector bounds of their errors if the model has any. It
    ends with Ctrl-C, or with the process that has started it.
    """
    from vibench.library.runs import open_run
    from vibench.library.serving import ModelServer

    model = open_run(run, at=places_of(at)).model(cell)
    # The port of UM-Bridge.
    with ModelServer(model, host, 4242 if port is None else port) as server:
        given, outputs = (", ".join(names) for names in (model.parameters.names, server.outputs))
        worth = "no bounds" if model.certificate is None else f"{model.certificate.base.guarantee.value} bounds"
        url = f"http://{host}:{server.server_address[1]}"
        echo(f"({given}) to ({outputs}), {worth}: `umbridge.HTTPModel('{url}', {server.name!r})`")
        server.serve()
