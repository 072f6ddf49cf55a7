"""Figures of a run, drawn from its results file alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from matplotlib.figure import Figure

from vibench.figures.constants import inf_sup
from vibench.figures.convergence import diagnostics, enrichment, orthogonality, projection_errors
from vibench.figures.costs import dimension, total_cost, work_precision
from vibench.figures.data import Data, file_names, problems
from vibench.figures.solutions import solutions
from vibench.figures.solvers import solvers
from vibench.figures.style import FORMATS, save, styled

Drawing = Callable[[Data], Figure | None]

OF_PROBLEM: dict[str, Drawing] = {
    "solutions": solutions,
    "diagnostics": diagnostics,
    "errors": projection_errors,
    "orthogonality": orthogonality,
    "dimension": dimension,
    "work-precision": work_precision,
    "solvers": solvers,
    "total-cost": total_cost,
}
"""Figures of every problem, by the end of the file's name; `None` where there is nothing to draw."""

OF_DUAL: dict[str, Drawing] = {"enrichment": enrichment, "inf-sup": inf_sup}
"""Figures of every problem and dual strategy."""


def drawings(path: Path) -> Iterator[tuple[str, Drawing, Data]]:
    """Every figure a results file may have: its name, the function that draws it, and what from."""
    for name, data in problems(path):
        yield from ((f"{name}-{kind}", draw, data) for kind, draw in OF_PROBLEM.items())
        for dual, file in zip(data.duals, file_names(data.duals), strict=True):
            yield from ((f"{name}-{file}-{kind}", draw, data.of_dual(dual)) for kind, draw in OF_DUAL.items())


def draw_all(path: Path, folder: Path, formats: tuple[str, ...] = FORMATS) -> list[Path]:
    """Draw what a results file has data for; returns the files written.

    Parameters
    ----------
    path
        Results file.
    folder
        Where the files go.
    formats
        What is written of every figure.
    """
    files = []
    for name, draw, data in drawings(path):
        folder.mkdir(parents=True, exist_ok=True)
        with styled():
            figure = draw(data)
            if figure is not None:
                files += save(figure, folder, name, formats)
    return files
