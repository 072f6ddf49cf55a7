"""Figures of a run, drawn from its results file alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from itertools import islice, zip_longest
from multiprocessing import get_context
from pathlib import Path

from matplotlib.figure import Figure

from vibench.errors import RequestError, unknown_name
from vibench.report.figures.constants import inf_sup, shares
from vibench.report.figures.convergence import diagnostics, enrichment, orthogonality, projection_errors
from vibench.report.figures.costs import dimension, total_cost, work_precision
from vibench.report.figures.data import Data, file_names, problems
from vibench.report.figures.solutions import solutions
from vibench.report.figures.solvers import precision, solvers
from vibench.report.figures.style import FORMATS, save, styled

Drawing = Callable[[Data], Figure | None]

OF_PROBLEM: dict[str, Drawing] = {
    "solutions": solutions,
    "diagnostics": diagnostics,
    "errors": projection_errors,
    "orthogonality": orthogonality,
    "dimension": dimension,
    "work-precision": work_precision,
    "shares": shares,
    "solvers": solvers,
    "precision": precision,
    "total-cost": total_cost,
}
"""Figures of every problem, by the end of their file names."""

OF_DUAL: dict[str, Drawing] = {"enrichment": enrichment, "inf-sup": inf_sup}
"""Figures of every problem and dual strategy."""


def drawings(path: Path) -> Iterator[tuple[str, Drawing, Data]]:
    """Every figure a results file may have: its name, the function that draws it, and the data."""
    for name, data in problems(path):
        yield from ((f"{name}-{kind}", draw, data) for kind, draw in OF_PROBLEM.items())
        for dual, file in zip(data.duals, file_names(data.duals), strict=True):
            yield from ((f"{name}-{file}-{kind}", draw, data.of_dual(dual)) for kind, draw in OF_DUAL.items())


def draw(path: Path, kind: str, problem: str | None = None, dual: str | None = None) -> Figure:
    """One figure of a results file.

    Parameters
    ----------
    kind
        A key of `OF_PROBLEM` or `OF_DUAL`.
    problem, dual
        Label of the problem, and of the dual strategy for a kind of `OF_DUAL`; `None` where there is only one.

    Raises
    ------
    RequestError
        If there is no such figure, or nothing to draw in it.
    """
    if kind not in OF_PROBLEM and kind not in OF_DUAL:
        raise unknown_name("figure", kind, (*OF_PROBLEM, *OF_DUAL))
    data = _only("problem", {one.problem: one for _, one in problems(path)}, problem)
    if kind in OF_DUAL:
        data = _only("dual strategy", {name: data.of_dual(name) for name in data.duals}, dual)
    with styled():
        figure = (OF_PROBLEM | OF_DUAL)[kind](data)
    if figure is None:
        raise RequestError(f"the run has no data for the figure '{kind}' of {data.problem}")
    return figure


def _only(what: str, found: Mapping[str, Data], label: str | None) -> Data:
    """The data under a label, or the only ones."""
    if label is None:
        if len(found) != 1:
            known = f"name one of {', '.join(found)}" if found else "the run has none with queries"
            raise RequestError(f"the figure is of one {what}: {known}")
        return next(iter(found.values()))
    if label not in found:
        raise unknown_name(what, label, found)
    return found[label]


def remove(folder: Path) -> None:
    """Remove the figures that an earlier call of `draw_all` may have left in a folder; other files stay."""
    for kind in (*OF_PROBLEM, *OF_DUAL):
        for form in FORMATS:
            for file in folder.glob(f"*-{kind}.{form}"):
                file.unlink()


def draw_all(path: Path, folder: Path, formats: tuple[str, ...] = FORMATS, jobs: int = 1) -> list[Path]:
    """Draw every figure that a results file has data for, in every format; returns the files written to the folder.

    `jobs` is the number of processes that draw, this one included.
    """
    if jobs == 1:
        return [file for files in _part(path, folder, formats, 0, 1) for file in files]
    with ProcessPoolExecutor(jobs - 1, get_context("spawn")) as pool:
        others = [pool.submit(_part, path, folder, formats, k, jobs) for k in range(1, jobs)]
        parts = [_part(path, folder, formats, 0, jobs), *(other.result() for other in others)]
    return [file for turn in zip_longest(*parts, fillvalue=[]) for files in turn for file in files]


def _part(path: Path, folder: Path, formats: tuple[str, ...], first: int, step: int) -> list[list[Path]]:
    """Draw every `step`-th figure from number `first` on; returns the files of each."""
    written = []
    for name, draw, data in islice(drawings(path), first, None, step):
        folder.mkdir(parents=True, exist_ok=True)
        with styled():
            figure = draw(data)
            written.append([] if figure is None else save(figure, folder, name, formats))
    return written
