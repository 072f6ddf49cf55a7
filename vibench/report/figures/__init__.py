"""Figures of a run, drawn from its results file alone."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

from matplotlib.figure import Figure

from vibench.errors import RequestError, unknown_name
from vibench.report.figures.constants import inf_sup, shares
from vibench.report.figures.convergence import diagnostics, enrichment, orthogonality, projection_errors
from vibench.report.figures.costs import dimension, outputs, total_cost, work_precision
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
    "outputs": outputs,
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
        Label of the problem ("LABEL, TRAINING" where it has several training sets), and of the dual strategy for a kind
        of `OF_DUAL`; `None` where there is only one.

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


def draw_all(
    path: Path,
    folder: Path,
    formats: tuple[str, ...] = FORMATS,
    jobs: int = 1,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> list[Path]:
    """Draw every figure that a results file has data for, in every format; returns the files written to the folder.

    Parameters
    ----------
    path
        The results file.
    folder
        Where the figures go.
    formats
        Formats of Matplotlib.
    jobs
        Processes that draw, this one included.
    progress
        Called before a figure is drawn here, with its name, the number of those done, and that of all there may be.
    """
    known = _drawings(path)
    written: dict[int, list[Path]] = {}
    with contextlib.ExitStack() as stack:
        others: dict[int, Future[list[Path]]] = {}
        if jobs > 1:
            pool = ProcessPoolExecutor(jobs - 1, get_context("spawn"))
            stack.callback(pool.shutdown, cancel_futures=True)
            with _interrupts_ignored():  # the processes inherit it: Ctrl-C is for this one to handle
                others = {k: pool.submit(_draw, path, folder, formats, k) for k in reversed(range(len(known)))}
        # the others draw from the last figure on, this process from the first one on what they have not begun
        for k in range(len(known)):
            if k not in others or others[k].cancel():
                others.pop(k, None)
                progress(known[k][0], len(written) + sum(other.done() for other in others.values()), len(known))
                written[k] = _draw(path, folder, formats, k)
        for k, other in others.items():
            progress(known[k][0], len(written), len(known))
            written[k] = other.result()
    _drawings.cache_clear()
    return [file for k in sorted(written) for file in written[k]]


@cache
def _drawings(path: Path) -> list[tuple[str, Drawing, Data]]:
    """The drawings of a results file, read once in a process that draws."""
    return list(drawings(path))


def _draw(path: Path, folder: Path, formats: tuple[str, ...], number: int) -> list[Path]:
    """Draw one figure of `drawings`; returns the files."""
    name, draw, data = _drawings(path)[number]
    folder.mkdir(parents=True, exist_ok=True)
    with styled():
        figure = draw(data)
        return [] if figure is None else save(figure, folder, name, formats)


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C inside the block, and in the processes that start there."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
