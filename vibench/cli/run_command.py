"""`vibench run`, and what a run prints at its end: the best cells, failures, agreement of numbers, next commands."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from vibench.cli.completion import corrections, duals, formulations, primals, problems, solvers, studies
from vibench.cli.console import echo, run_argument, warn
from vibench.cli.result_commands import At, draw_run, places_of
from vibench.errors import RequestError, VibenchError, in_a_line, unknown_name
from vibench.interrupts import interrupted_at_once
from vibench.qp.status import Status
from vibench.text import unbroken

if TYPE_CHECKING:
    from vibench.execution.run import RunResult
    from vibench.study.spec import Study

Names = list[str] | None
Tolerances = list[float] | None


def run_study_command(
    study: Annotated[
        str | None,
        Argument(help="A study, quick by default, or a file; with --cell a results file, too.", autocompletion=studies),
    ] = None,
    cell: Annotated[str, Option(metavar="KEY", help="Run one cell alone, by its key or the beginning of that.")] = "",
    problem: Annotated[
        Names, Option(help="The problem: NAME, FILE.py:CLASS, or a pack (repeatable).", autocompletion=problems)
    ] = None,
    formulation: Annotated[
        Names, Option(help="Replace the formulations: NAME or FILE.py:CLASS.", autocompletion=formulations)
    ] = None,
    dual: Annotated[
        Names, Option(help="Replace the dual strategies: NAME or FILE.py:CLASS.", autocompletion=duals)
    ] = None,
    primal: Annotated[
        Names, Option(help="Replace the primal strategies: NAME or FILE.py:CLASS.", autocompletion=primals)
    ] = None,
    solver: Annotated[Names, Option(help="Replace the QP solvers.", autocompletion=solvers)] = None,
    correction: Annotated[Names, Option(help="Replace the corrections.", autocompletion=corrections)] = None,
    pod_tol: Annotated[Tolerances, Option(help="Replace the tolerances (or sizes) of the POD.")] = None,
    dual_tol: Annotated[Tolerances, Option(help="Replace the tolerances (or sizes) of the dual strategies.")] = None,
    primal_tol: Annotated[Tolerances, Option(help="Replace the tolerances of the primal strategies.")] = None,
    validation: Annotated[int | None, Option(min=1, metavar="N", help="Number of validation parameters.")] = None,
    at: At = None,
    out: Annotated[Path | None, Option(help="Results folder; runs/STUDY by default.")] = None,
    jobs: Annotated[int | None, Option("--jobs", "-j", min=0, help="Worker processes; default: one per core.")] = None,
    repeats: Annotated[int | None, Option(min=0, metavar="K", help="Cold processes that measure, at least.")] = None,
    dry_run: Annotated[bool, Option("--dry-run", help="List the cells of the matrix and stop.")] = False,
    fresh: Annotated[bool, Option("--fresh", help="Remove earlier results and recompute everything.")] = False,
    retry: Annotated[bool, Option("--retry", help="Also rerun cells that did not end ok.")] = False,
    strict: Annotated[bool, Option("--strict", help="Exit with 1 if a cell is neither ok nor unavailable.")] = False,
    draw: Annotated[bool, Option("--figures/--no-figures", help="Draw an answer sheet per problem.")] = True,
    executor: Annotated[Literal["local", "dask"], Option(help="Local processes, or a dask cluster.")] = "local",
    scheduler: Annotated[str | None, Option(metavar="ADDRESS", help="A dask scheduler; a new one by default.")] = None,
) -> None:
    """Run a study. An interrupted run resumes where it stopped."""
    # The libraries and plugins of a study take a second to import; Ctrl-C ends the command meanwhile.
    with interrupted_at_once():
        from vibench.execution.run import Options, run_study
        from vibench.library.progress import ProgressDisplay
        from vibench.study.matrix import expand

        overrides = {
            "problem": [problem_entry(one) for one in problem or ()],
            "formulation": [plugin_entry(one, "formulation") for one in formulation or ()],
            "dual": [plugin_entry(one, "dual strategy") for one in dual or ()],
            "primal": [plugin_entry(one, "primal strategy") for one in primal or ()],
            "solvers": solver, "correction": correction, "pod": pod_tol, "dual_tol": dual_tol,
            "primal_tol": primal_tol, "validation": validation and [validation],
        }  # fmt: skip
        usual = study is None and problem is not None
        loaded = _study(
            study or ("default" if usual else "quick"),
            cell,
            {axis: values for axis, values in overrides.items() if values},
            at,
        )
    if usual:
        # Runs of several problems have folders of their own.
        loaded = loaded.model_copy(update={"name": " ".join(one.title for one in loaded.problem)})
    if dry_run:
        cells = expand(loaded)
        echo(*(f"{cell.key}  {cell}" for cell in cells), f"{len(cells)} cells")
        return
    if scheduler is not None:
        from vibench.execution.executors import is_authenticated

        if executor != "dask":
            raise RequestError(f"--scheduler {scheduler} is for --executor dask")
        if not is_authenticated(scheduler):
            reason = "the connection is not authenticated: others who reach the scheduler can run code on its workers"
            warn(f"{unbroken(scheduler)}: {reason}")
    folder = out or Path("runs") / loaded.name
    options = Options(jobs or 0, fresh, retry, executor, scheduler, repeats or 0)
    with ProgressDisplay() as progress:
        outcome = run_study(loaded, folder, progress, options)
    _conclude(outcome, folder, draw=draw, fresh=fresh, strict=strict)


def _conclude(outcome: RunResult, folder: Path, *, draw: bool, fresh: bool, strict: bool) -> None:
    """Write the tables, print the summary and draw the figures of a run; exit by its statuses."""
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
        raise typer.Exit(130)
    # A run without any result still has its tables, but no summary and no figures.
    statuses = [row["status"] for row in outcome.rows]
    nothing_ran = set(statuses) == {Status.UNAVAILABLE}
    if not nothing_ran:
        print_summary(path, outcome.rows)
    echo(f"results: {path}, tables: {folder / 'tables'}")
    # Figures of an earlier run would show other numbers.
    if (fresh or draw) and (folder / "figures").is_dir():
        from vibench.report import figures

        figures.remove(folder / "figures")
    if nothing_ran:
        reasons = list(dict.fromkeys(str(row["reason"]) for row in outcome.rows))
        raise VibenchError(f"no cell could run here: {'; '.join(_first(reasons, 'other reasons'))}")
    if draw:
        draw_run(path, folder / "figures", ("png",), ("answer",))
    next_steps(folder, all_ok=set(statuses) == {Status.OK})
    if strict and any(status not in (Status.OK, Status.UNAVAILABLE) for status in statuses):
        raise typer.Exit(1)


def problem_entry(text: str) -> Any:
    """A problem of the command line: its name, the class of a Python file, or the entry of a pack's folder."""
    from vibench.packs.manifest import FILE

    # Methods of Path raise an OSError if a name is too long for a file.
    if os.path.isfile(os.path.join(text, FILE)):  # noqa: PTH113, PTH118
        return {"name": "pack", "label": Path(text).absolute().name, "options": {"path": str(Path(text).absolute())}}
    return plugin_entry(text, "problem")


def plugin_entry(text: str, noun: str) -> Any:
    """A plugin of the command line: its name, or the class of a Python file."""
    import runpy

    file, _, name = text.rpartition(":")
    if not file.endswith(".py"):
        return text
    try:
        contents = runpy.run_path(file)
    except (Exception, SystemExit) as error:  # noqa: BLE001  the file may raise anything
        raise RequestError(f"the {noun} '{text}': {file} cannot be run: {in_a_line(error)}") from None
    if not isinstance(contents.get(name), type):
        classes = [one for one, value in contents.items() if isinstance(value, type)]
        raise unknown_name(f"class of {file}", name, classes)
    return contents[name]


def _study(request: str, key: str, overrides: dict[str, list[Any]], at: list[str] | None) -> Study:
    """The study of a name or file, or of one cell of it or of a results file."""
    from vibench.execution.recorded_cell import recorded_study
    from vibench.results.selection import key_of
    from vibench.study.matrix import expand, read_study, study_of_cell

    if key and Path(request).suffix == ".sqlite":
        if overrides:
            raise RequestError(f"a cell of a results file is run as it is recorded: leave out {', '.join(overrides)}")
        return recorded_study(request, key, places_of(at))
    # The options of a study file's problems name its folders; only recorded cells have places that may have moved.
    if at:
        raise RequestError("--at is for a cell of a results file; a study file says itself where its files are")
    study = read_study(request, overrides)
    if not key:
        return study
    cells = {cell.key: cell for cell in expand(study)}
    cell = cells[key_of(key, cells, request, f"vibench run {request} --dry-run")]
    # One cell is timed as often as in its study.
    rounds = {name: getattr(study, name) for name in ("timing_rounds", "timing_rounds_min", "timing_budget")}
    return study_of_cell(cell, study.name, limits=study.limits, **rounds)


def _first(lines: Sequence[str], others: str) -> list[str]:
    """The first ten of some lines, all that a screen has room for, and the number of the others."""
    return [*lines[:10], *[f"{len(lines) - 10} {others}"] * bool(lines[10:])]


Rows = Sequence[Mapping[str, Any]]


def print_summary(path: Path, rows: Rows) -> None:
    """Print whether reduction pays, failures, and violated invariants of a run."""
    from vibench.results import consistency
    from vibench.results.read import in_order, read_in_parts, read_table
    from vibench.results.verdict import verdicts

    cells = in_order(read_table(path, "cells"))
    echo(*map(str, verdicts(cells, read_table(path, "thresholds"))))
    echo(*failures(rows, run_argument(path.parent)))
    kinds, violations = cells.set_index("cell")["enrichment_kind"], list[consistency.Violation]()
    # Queries are read in parts: a large run has more than memory holds.
    for part in read_in_parts(path, "queries"):
        violations += consistency.violations(part, kinds)
    bug = "this is a bug of vibench or of a plugin's inner products"
    violated = [f"invariant: {violation}; {bug}" for violation in consistency.added_up(violations)]
    echo(*_first(violated, "more violated invariants"))
    disagreements, ok = read_table(path, "disagreements"), sum(row["status"] == Status.OK for row in rows)
    differ = bool(disagreements["flagged"].sum())
    if differ:
        echo(consistency.agreement_sentence(disagreements, cells["solver"].nunique()))
    if len(noted := cells.loc[cells["fallbacks"].fillna("") != "", "fallbacks"]):
        echo(f"{len(noted)} of {len(cells)} cells deviate from their algorithm (column fallbacks): {noted.iloc[0]}")
    counted = f"{len(rows)} cells, {f'{ok} ok, {len(rows) - ok} not ok' if ok < len(rows) else 'all ok'}"
    echo(counted + "; no check of constants, bounds and solvers failed" * (ok > 0 and not violated and not differ))


def failures(rows: Rows, run: str) -> Iterator[str]:
    """A line for every reason why cells are not ok; reasons that differ in their numbers alone are one."""
    # For an inaccurate solver it names those that are ok on the same model, or the command that tries them.
    from vibench.library.progress import kind_of_failure
    from vibench.results import formats

    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["status"] != Status.OK:
            groups.setdefault(kind_of_failure(row), []).append(row)
    # The reason of most cells comes first: it is the one to mend.
    ranked = sorted(groups.values(), key=len, reverse=True)
    for group in ranked[:10]:
        first = group[0]
        count = f"{len(group)} cells " * (len(group) > 1)
        if first["status"] == Status.UNAVAILABLE:
            yield f"{count}{first['status']}: {first['reason']}"
            continue
        which = f"the first is {first['cell']}, " if len(group) > 1 else f"{first['cell']}, "
        queries = f"{first['queries_ok']} of {first['queries']} queries ok"
        remedy = ""
        if first["status"] == Status.INACCURATE:
            # Solvers of one model solve the same programs.
            same = [row for row in rows if all(row[key] == first[key] for key in ("model", "accuracy", "correction"))]
            fine = ", ".join(sorted({row["solver"] for row in same if row["status"] == Status.OK}))
            remedy = f"; ok with {fine}" if fine else f"; `vibench replay {run} {first['cell']}` tries other solvers"
        yield f"{count}{first['status']}: {which}{formats.name_of_cell(first)}: {queries}; {first['reason']}{remedy}"
    if ranked[10:]:
        yield f"{sum(map(len, ranked[10:]))} cells not ok for {len(ranked) - 10} other reasons"


def next_steps(folder: Path, *, all_ok: bool) -> None:
    """Print the commands that show more of a run, each with its purpose."""
    run = run_argument(folder)
    steps = [(f"vibench report {run}", "one HTML page: answers, tables, figures")]
    if all_ok:
        steps.append((f"vibench show {run} --table benefits", "which model pays, from how many queries on"))
    else:
        steps.append((f"vibench show {run} --columns cell,reason --where \"status != 'ok'\"", "what is not ok"))
    # Beside 36 characters of a command 80 columns have room for its purpose; a longer command has its own line.
    width = max((len(command) for command, _ in steps if len(command) <= 36), default=36)
    echo("next:")
    for command, purpose in steps:
        lines = [f"{command:<{width}}"] if len(command) <= 36 else [command, " " * width]
        lines[-1] += f"  {purpose}"
        echo(*(f"  {line}" for line in lines))
