"""Commands that write files of finished runs: reports, sites, figures, quadratic programs and reduced models."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from enum import StrEnum
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer
from typer import Argument, Exit, Option

from vibench.cli.completion import cells
from vibench.cli.console import echo, run_argument, warn
from vibench.cli.result_commands import At, RunArgument, RunsArgument, places_of
from vibench.errors import RequestError


class FigureFormat(StrEnum):
    """Formats of figures; typer takes no list of literals."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"


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
    written = html.write(path, out or path.parent / REPORT, figures=figures)
    echo(f"report: {written}")


def draw_figures(
    names: RunsArgument,
    out: Annotated[Path | None, Option(metavar="DIR", help="Folder; RUN/figures by default.")] = None,
    formats: Annotated[list[FigureFormat] | None, Option("--format", help="Default: png and svg (repeatable).")] = None,
) -> None:
    """Draw the figures of runs, with captions."""
    from vibench.results.read import results_file

    # A run may be named twice: as a folder and by its name.
    paths = list({results_file(name).resolve(): results_file(name) for name in names}.values())
    forms = tuple(dict.fromkeys(map(str, formats or ("png", "svg"))))
    if out is not None and len(paths) > 1:
        raise RequestError("--out is for the figures of one run; those of several go into their folders")
    for path in paths:
        draw_run(path, out or path.parent / "figures", forms)


def draw_run(path: Path, folder: Path, formats: tuple[str, ...] = ("png", "svg")) -> None:
    """Draw all figures of a results file; Ctrl-C leaves the results and the figures that are drawn."""
    from vibench.library.progress import DrawingDisplay
    from vibench.report import figures

    # The run is complete at this point: Ctrl-C costs pictures alone, and says how to get them.
    try:
        with DrawingDisplay() as display:
            drawn, failures = figures.draw_all(path, folder, formats, display.show)
    except KeyboardInterrupt:
        missing = f"some figures are missing; `vibench figures {run_argument(path.parent)}` draws them"
        echo(f"interrupted while drawing: results and tables are complete, {missing}")
        raise Exit(130) from None
    for line in failures:
        warn(line)
    echo(f"{len(drawn)} figures: {folder}")


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
            "with CELL a new file: NAME.npz for its model, NAME.c for a C program, too, or NAME.vtu for ParaView.",
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

    A model is used without vibench, in Python or C; the fields for ParaView are u, λ and their errors at a parameter.
    """
    # The suffix tells what a cell is exported as; programs of a whole run go into a folder, which has none.
    *cell, last = words
    target, kind = Path(last), Path(last).suffix
    if len(cell) > 1 or bool(cell) != (kind in {".npz", ".c", ".vtu"}):
        raise RequestError("expected DIR, a folder for programs, or CELL FILE, whose name ends in .npz, .c or .vtu")
    others: dict[str, object] = {"--mu": mu and kind != ".vtu", "--sequence": sequence and cell}
    if kind not in {".npz", ".c"}:
        others |= {"--tolerance": tolerance, "--no-bases": not bases}
    if wrong := [option for option, is_wrong in others.items() if is_wrong]:
        raise RequestError(f"{', '.join(wrong)} has no meaning for '{last}'")
    if not cell:
        from vibench.report import replay

        count = replay.export(run, target, places_of(at), sequence=sequence)
        echo(f"{count} programs in {target / 'programs'}; `python {target / 'check.py'}` rechecks every solution")
    elif kind == ".vtu":
        from vibench.library.runs import open_run
        from vibench.library.vtu import export_vtu

        try:
            components = [float(each) for each in mu.split(",")]
        except ValueError:
            raise RequestError(f"--mu is {mu!r}, expected numbers separated by commas, such as 1.2,0.05") from None
        export_vtu(open_run(run, at=places_of(at)).model(cell[0]), components, target)
        echo(f"u, λ and their errors at mu = {components}: {target}")
    else:
        _export_model(run, cell[0], target, tolerance, bases, places_of(at))


def _export_model(
    run: str, cell: str, target: Path, tolerance: float | None, bases: bool, places: Mapping[str, str]
) -> None:
    """Export a model, and say which errors its polynomials have, what it bounds and how long its queries take."""
    from vibench.library import reduced_model
    from vibench.library.export import export_model
    from vibench.library.runs import open_run
    from vibench.model.chebyshev import MEASURED
    from vibench.offline.polynomials import TOLERANCE
    from vibench.timing import timed

    model, file = open_run(run, at=places).model(cell), target.with_suffix(".npz")
    exported = export_model(
        model, file, TOLERANCE if tolerance is None else tolerance, bases=bases, c=target.suffix == ".c"
    )
    for name, member in exported.members.items():
        terms = f"{len(member.terms)} term{'s' * (len(member.terms) > 1)}"
        form = f"{terms}, polynomials of degree ({', '.join(map(str, member.degrees))})"
        echo(f"{name}: {form if any(member.degrees) else 'constant'}, relative error {member.error:.1e}")
    echo(f"relative errors are those at {MEASURED} random parameters and at the corners of the box")
    # The script has fewer solvers than vibench.
    if exported.about["solver"] != model.solver:
        echo(f"the cell's solver is {model.solver}, the script solves by {exported.about['solver']}")
    why = exported.about["no_bounds"]
    echo(f"no error bounds: {why}" if why else f"error bounds in C: {exported.about['certificate']}")
    outputs = exported.about["outputs"]
    held, others = ", ".join(output["name"] for output in outputs["linear"]), ", ".join(outputs["left_out"])
    if held or others:
        echo(f"outputs: {held or 'none'}{f'; code that the file cannot hold computes {others}' * bool(others)}")
    # The script and the high-fidelity model take turns, so that a change of the machine's pace concerns both.
    mus = model.parameters.sample(5, seed=0)
    calls: list[Callable[..., Any]] = [reduced_model.Model(file).solve, model.high_fidelity]
    seconds = [[timed(partial(call, mu))[1].cpu for call in calls] for mu in (mus[0], *mus)]
    # The first query of both is longer than the others, as caches are cold.
    query, solution = (f"{1e3 * median(column):.2g} ms" for column in zip(*seconds[1:], strict=True))
    echo(f"a query takes {query}; the high-fidelity solution {solution}")
    sources = [file.with_suffix(end) for end in (".c", ".h") if target.suffix == ".c"]
    written = ", ".join(map(str, [file, file.with_name("reduced_model.py"), *sources]))
    echo(f"{written}: `from reduced_model import Model`, then `Model({str(file)!r}).solve(mu)`")
