"""What a run prints at its end: the best cells, what failed, whether the numbers agree, and what to do next."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vibench.cli.console import echo, print_frame, run_argument
from vibench.library.progress import REASONS, kind_of_failure
from vibench.qp.status import Status
from vibench.results import consistency, formats, show
from vibench.results.consistency import sentence
from vibench.results.read import read_in_parts, read_table

if TYPE_CHECKING:
    import pandas as pd

WHOLE = 20
"""Cells up to which the summary is printed whole."""

Rows = Sequence[Mapping[str, Any]]


def print_summary(study: str, path: Path, rows: Rows) -> None:
    """Print the summary of a run, why cells are not ok, and violated invariants."""
    cells = read_table(path, "cells")
    table = show.look_up(path, "summary" if len(cells) <= WHOLE else "best")
    if len(table.rows):
        title = study if len(cells) <= WHOLE else f"{study}, the fastest query at every error reached"
        print_frame(table.readable, title, table.priority, axes=table.axes)
    elif len(cells):
        echo(table.view.empty)
    not_ok = [row for row in rows if row["status"] != Status.OK]
    echo(*failures(rows, run_argument(path.parent)))
    echo(f"{len(rows)} cells, {len(rows) - len(not_ok)} ok, {len(not_ok)} not ok")
    queries, violations = _judged_queries(path, cells)
    for violation in violations[:REASONS]:
        echo(f"invariant: {violation}; this is a bug of vibench or of a plugin's inner products")
    if violations[REASONS:]:
        echo(f"invariant: {len(violations) - REASONS} more like these")
    if queries and not violations:
        echo(f"invariants of the constants and the error bounds hold in all {queries} queries")
    if agreement := sentence(read_table(path, "disagreements"), cells["solver"].nunique()):
        echo(agreement)


def _judged_queries(path: Path, cells: pd.DataFrame) -> tuple[int, list[consistency.Violation]]:
    """Number of queries, and the invariants that they violate; queries may be more than memory holds."""
    kinds, count, violations = cells.set_index("cell")["enrichment_kind"], 0, list[consistency.Violation]()
    for part in read_in_parts(path, "queries"):
        count += len(part)
        violations += consistency.violations(part, kinds)
    return count, consistency.added_up(violations)


def failures(rows: Rows, run: str) -> Iterator[str]:
    """A line for every reason why cells are not ok; reasons that differ in their numbers alone are one.

    A solver that has missed its accuracy has a remedy: those that are ok on the same model, or the command, with the
    run as its argument, that tries them.
    """
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["status"] != Status.OK:
            groups.setdefault(kind_of_failure(row), []).append(row)
    ranked = sorted(groups.values(), key=len, reverse=True)
    for group in ranked[:REASONS]:
        first = group[0]
        count = f"{len(group)} cells " * (len(group) > 1)
        if first["status"] == Status.UNAVAILABLE:
            yield f"{count}{first['status']}: {first['reason']}"
            continue
        which = f"the first is {first['cell']}, " if len(group) > 1 else f"{first['cell']}, "
        queries = f"{first['queries_ok']} of {first['queries']} queries ok"
        remedy = _remedy(first, rows, run) if first["status"] == Status.INACCURATE else ""
        yield f"{count}{first['status']}: {which}{formats.name_of_cell(first)}: {queries}; {first['reason']}{remedy}"
    if others := sum(map(len, ranked[REASONS:])):
        yield f"{others} cells not ok for {len(ranked) - REASONS} other reasons"


def _remedy(cell: Mapping[str, Any], rows: Rows, run: str) -> str:
    same = [row for row in rows if all(row[name] == cell[name] for name in ("model", "accuracy", "correction"))]
    fine = sorted({row["solver"] for row in same if row["status"] == Status.OK})
    return f"; ok with {', '.join(fine)}" if fine else f"; `vibench replay {run} {cell['cell']}` tries other solvers"


def reasons(rows: Rows) -> str:
    """The reasons of cells, each once."""
    distinct = list(dict.fromkeys(str(row["reason"]) for row in rows))
    more = [f"{len(distinct) - REASONS} other reasons"] if len(distinct) > REASONS else []
    return "; ".join([*distinct[:REASONS], *more])


def next_steps(folder: Path, cells: int, not_ok: int, *, figures: bool) -> None:
    """Print the commands that show more of a run."""
    run = run_argument(folder)
    steps = [(f"vibench show {run}", f"all {cells} cells" if cells > WHOLE else "this table again")]
    if not_ok:
        steps.append((f"vibench show {run} --columns cell,reason --where \"status != 'ok'\"", "what is not ok"))
    steps.append((f"vibench report {run}", "one HTML page: findings, tables, figures"))
    if not figures:
        steps.append((f"vibench figures {run}", "the figures as PNG and SVG"))
    echo("next:", *aligned(steps))


def aligned(steps: Iterable[tuple[str, str]]) -> list[str]:
    """Commands and what they do, in two columns; a command that is too long for the first has a line of its own."""
    steps = list(steps)
    width = max([len(command) for command, _ in steps if len(command) <= SHORT_COMMAND], default=SHORT_COMMAND)
    lines = []
    for command, what in steps:
        alone = len(command) > SHORT_COMMAND
        lines += [f"  {command}", f"  {'':<{width}}  {what}"] if alone else [f"  {command:<{width}}  {what}"]
    return lines


SHORT_COMMAND = 36
"""Characters of a command that others are aligned with: 80 columns have room for what it does beside it."""
