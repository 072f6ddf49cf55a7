"""Figures of a run, drawn from its results file alone."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path

from matplotlib.figure import Figure

from vibench.errors import RequestError, unknown_name
from vibench.files import write_atomically
from vibench.report.figures import constants, convergence, costs
from vibench.report.figures.constants import inf_sup, shares
from vibench.report.figures.convergence import diagnostics, enrichment, orthogonality, projection_errors
from vibench.report.figures.costs import break_even, dimension, outputs, total_cost, work_precision
from vibench.report.figures.data import Data, file_names, problems
from vibench.report.figures.plugins import FigureError, of_plugins
from vibench.report.figures.solutions import solutions
from vibench.report.figures.solvers import precision, solvers
from vibench.report.figures.style import ABREAST, DEEP, FORMATS, WRITTEN, caption_of, save, styled
from vibench.text import parsed_json

Drawing = Callable[[Data], Figure | None]

Drawn = tuple[str, Drawing, Data]
"""A figure to be drawn: its name, the function that draws it, and the data."""

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
    "break-even": break_even,
}
"""Figures of every problem, by the end of their file names."""

OF_DUAL: dict[str, Drawing] = {"enrichment": enrichment, "inf-sup": inf_sup}
"""Figures of every problem and dual strategy."""

OF_HISTORIES: frozenset[Drawing] = frozenset({diagnostics, projection_errors, orthogonality, enrichment})
"""Those that read the histories; no other one does."""

LONG: dict[str, tuple[Callable[[Data], int], int]] = {
    "shares": (constants.compared, ABREAST * DEEP),
    "dimension": (costs.sized, DEEP),
    "work-precision": (costs.timed, DEEP),
    "total-cost": (costs.pairs, ABREAST * DEEP),
    "outputs": (costs.reported, ABREAST * DEEP),
    "break-even": (costs.decided, ABREAST * DEEP),
    "enrichment": (convergence.enriched, DEEP),
    "inf-sup": (constants.pairs, constants.MOST_PAIRS),
}
"""Figures that grow with the study: how many panels or rows of panels they have, and how many go into one file."""

CAPTIONS = "captions.json"
"""File beside the figures: the caption of every figure, by the name of its files."""


def drawings(path: Path, note: Callable[[str], None] = lambda _: None) -> Iterator[Drawn]:
    """Every figure a results file may have: its name, the function that draws it, and the data.

    The functions of plugins raise `FigureError`; those of this package do not. `note` is called with a line for every
    column of a plugin that the data do not have.
    """
    for name, data in problems(path, note=note):
        yield from _drawings_of(name, data, data.duals, _pages)


def for_report(name: str, data: Data, duals: Collection[str]) -> Iterator[Drawn]:
    """The figures of a problem that a report shows: of these dual strategies, and of a long figure half a page."""
    return _drawings_of(name, data, duals, _beginning)


def _drawings_of(
    name: str, data: Data, duals: Collection[str], paged: Callable[[str, str, Drawing, Data], Iterator[Drawn]]
) -> Iterator[Drawn]:
    """The figures of a problem and of some of its dual strategies; `paged` gives what is drawn of each of vibench."""
    for kind, draw in OF_PROBLEM.items():
        yield from paged(f"{name}-{kind}", kind, draw, data)
    for dual, file in zip(data.duals, file_names(data.duals), strict=True):
        if dual in duals:
            of_dual = data.of_dual(dual)
            for kind, draw in OF_DUAL.items():
                yield from paged(f"{name}-{file}-{kind}", kind, draw, of_dual)
    yield from ((f"{name}-{kind}", draw, data) for kind, draw in of_plugins(data, {*OF_PROBLEM, *OF_DUAL}).items())


def _pages(name: str, kind: str, draw: Drawing, data: Data) -> Iterator[Drawn]:
    """A drawing, or several of a figure that is too long for one."""
    panels, most = _length(kind, data)
    pages = max(1, -(-panels // most))
    for page in range(pages):
        yield name + f"-{page + 1}" * (page > 0), draw, replace(data, page=(page, pages))


def _beginning(name: str, kind: str, draw: Drawing, data: Data) -> Iterator[Drawn]:
    """The drawing of a figure, or of its first panels where it is too long for one file."""
    panels, most = _length(kind, data)
    if panels <= most:
        yield name, draw, replace(data, page=(0, 1))
    else:
        yield name, draw, replace(data, page=(0, -(-panels // (most // 2))), halved=True)


def _length(kind: str, data: Data) -> tuple[int, int]:
    """Number of panels, or rows of panels, of a figure, and how many go into one file."""
    count, most = LONG.get(kind, (lambda _: 1, 1))
    return count(data), most


def draw(
    path: Path,
    kind: str,
    problem: str | None = None,
    dual: str | None = None,
    note: Callable[[str], None] = lambda _: None,
) -> Figure:
    """One figure of a results file.

    Parameters
    ----------
    kind
        A key of `OF_PROBLEM` or `OF_DUAL`, or a figure of a plugin.
    problem, dual
        Label of the problem ("LABEL, TRAINING" where it has several training sets), and of the dual strategy for a kind
        of `OF_DUAL`; `None` where there is only one.
    note
        Called with a line for every column of a plugin that the data do not have.

    Raises
    ------
    RequestError
        If there is no such figure, or nothing to draw in it.
    FigureError
        If it is a plugin's figure, which cannot be drawn.
    """
    faults: list[str] = []
    known = {one.problem: one for _, one in problems(path, note=faults.append)}
    for line in faults:  # called here, so that a warning can name the line of the caller
        note(line)
    others = {name for one in known.values() for name in of_plugins(one, {*OF_PROBLEM, *OF_DUAL})}
    if kind not in {*OF_PROBLEM, *OF_DUAL, *others}:
        raise unknown_name("figure", kind, (*OF_PROBLEM, *OF_DUAL, *sorted(others)))
    data = _only("problem", known, problem)
    if kind in OF_DUAL:
        data = _only("dual strategy", {name: data.of_dual(name) for name in data.duals}, dual)
    drawing = (OF_PROBLEM | OF_DUAL | of_plugins(data, {*OF_PROBLEM, *OF_DUAL})).get(kind)
    with styled():
        figure = None if drawing is None else drawing(data)
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
    forms = f".({'|'.join(WRITTEN)})"
    own = re.compile(rf".*-({'|'.join(map(re.escape, (*OF_PROBLEM, *OF_DUAL)))})(-\d+)?\{forms}")
    known = {f"{name}.{form}" for name in read_captions(folder) for form in WRITTEN}
    for file in folder.glob("*"):
        if file.is_file() and (file.name in known or file.name == CAPTIONS or own.fullmatch(file.name)):
            file.unlink()


def read_captions(folder: Path) -> dict[str, str]:
    """The captions beside the figures of a folder, by the names of the figures; empty where there are none."""
    try:
        found = parsed_json((folder / CAPTIONS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {str(name): str(text) for name, text in found.items()} if isinstance(found, dict) else {}


@dataclass(frozen=True)
class Written:
    """What became of one drawing: the files, their caption, and why a figure could not be drawn."""

    files: tuple[Path, ...] = ()
    caption: str = ""
    failure: str = ""


def draw_all(
    path: Path,
    folder: Path,
    formats: tuple[str, ...] = FORMATS,
    jobs: int = 1,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    note: Callable[[str], None] = lambda _: None,
) -> list[Path]:
    """Draw every figure that a results file has data for, in every format; returns the files written to the folder.

    Beside them is `CAPTIONS`, with the caption of every figure.

    Parameters
    ----------
    path
        The results file.
    folder
        Where the figures go.
    formats
        Keys of `style.WRITTEN`.
    jobs
        Processes that draw, this one included.
    progress
        Called before a figure is drawn here, with its name, the number of those done, and that of all there may be.
    note
        Called with a line for every column of a plugin that the data do not have, and for every figure of a plugin
        that could not be drawn.
    """
    known, faults = _drawings(path)
    written: dict[int, Written] = {}
    with contextlib.ExitStack() as stack:
        others: dict[int, Future[Written]] = {}
        if jobs > 1:
            pool = ProcessPoolExecutor(jobs - 1, get_context("spawn"))
            stack.callback(pool.shutdown, cancel_futures=True)
            with interrupts_ignored():  # the processes inherit it: Ctrl-C is for this one to handle
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
    failures = [written[k].failure for k in sorted(written) if written[k].failure]
    for line in dict.fromkeys([*faults, *failures]):
        note(line)
    captions = {known[k][0]: written[k].caption for k in sorted(written) if written[k].files}
    if captions:
        text = json.dumps(read_captions(folder) | captions, ensure_ascii=False, indent=1) + "\n"
        write_atomically(folder / CAPTIONS, text.encode("utf-8"))
    return [file for k in sorted(written) for file in written[k].files]


@cache
def _drawings(path: Path) -> tuple[list[Drawn], list[str]]:
    """The drawings of a results file, read once in a process that draws, and what they lack of plugins."""
    faults: list[str] = []
    return list(drawings(path, faults.append)), faults


def _draw(path: Path, folder: Path, formats: tuple[str, ...], number: int) -> Written:
    """Draw one figure of `drawings`."""
    name, draw, data = _drawings(path)[0][number]
    folder.mkdir(parents=True, exist_ok=True)
    with styled():
        try:
            figure = draw(data)
        except FigureError as error:
            return Written(failure=str(error))
        return Written() if figure is None else Written(tuple(save(figure, folder, name, formats)), caption_of(figure))


@contextlib.contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C inside the block, and in the processes that start there."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
