"""The pictures of a report: drawn as for `vibench figures`, compact, with a text that says what is seen."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any, cast

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from vibench.arrays import Array
from vibench.report.figures import OF_DUAL, OF_HISTORIES, OF_PROBLEM, Drawing, Drawn, interrupts_ignored
from vibench.report.figures.data import Data
from vibench.report.figures.plugins import FigureError
from vibench.report.figures.style import caption_of, styled
from vibench.text import unbroken

DPI = 110
"""Dots per inch: sharp enough at the width of a page, and a tenth of the bytes of a vector picture of many lines."""

EFFORT = {"method": 1, "quality": 0}
"""Of the compression: a third of the time of more thorough ones, for a quarter more bytes."""

NAMED = 6
"""Series of a panel that an alternative text describes one by one."""


@dataclass(frozen=True)
class Still:
    """A picture: its name, what its caption says, what is seen, its data URI, and its size in pixels."""

    name: str
    caption: str
    alternative: str
    source: str
    width: int
    height: int


@dataclass(frozen=True)
class Helpers:
    """Processes that draw beside this one."""

    pool: ProcessPoolExecutor
    count: int


@contextmanager
def helpers(jobs: int) -> Iterator[Helpers | None]:
    """Context with processes that draw: as many as `jobs`, this one included. They load Matplotlib in the meantime."""
    if jobs < 2:
        yield None
        return
    with ProcessPoolExecutor(jobs - 1, get_context("spawn")) as pool:
        with interrupts_ignored():  # the processes inherit it: Ctrl-C is for this one to handle
            for _ in range(jobs - 1):
                pool.submit(_draw_all, ())
        yield Helpers(pool, jobs - 1)


def stills(known: Sequence[Drawn], others: Helpers | None = None) -> tuple[list[Still], list[str]]:
    """The pictures that there are data for, drawn here and by others, and why figures of plugins have none."""
    found = _draw_all(known) if others is None else _in_parallel(known, others)
    return [one for one in found if isinstance(one, Still)], [one for one in found if isinstance(one, str)]


def _in_parallel(known: Sequence[Drawn], others: Helpers) -> list[Still | str | None]:
    """All pictures in their order.

    Those of plugins are drawn here, since their functions need not go to other processes, and so are those of
    histories: of a large study these are millions of rows, which take longer to send than their few lines to draw.
    """
    elsewhere = {*OF_PROBLEM.values(), *OF_DUAL.values()} - OF_HISTORIES
    shared = [k for k, (_, draw, _) in enumerate(known) if draw in elsewhere]
    own = [k for k in range(len(known)) if k not in set(shared)]
    jobs = 1 + others.count
    shares = [[*shared[0::jobs], *own], *(shared[k::jobs] for k in range(1, jobs))]
    # None, for a figure that reads histories without being one of OF_HISTORIES would be left out if they were empty
    sent = [(name, draw, replace(data, histories=cast(pd.DataFrame, None))) for name, draw, data in known]
    awaited = [others.pool.submit(_draw_all, [sent[k] for k in share]) for share in shares[1:]]
    drawn = [_draw_all([known[k] for k in shares[0]]), *(other.result() for other in awaited)]
    placed = {k: one for share, found in zip(shares, drawn, strict=True) for k, one in zip(share, found, strict=True)}
    return [placed[k] for k in range(len(known))]


def _draw_all(known: Sequence[Drawn]) -> list[Still | str | None]:
    return [_drawn(*one) for one in known]


def _drawn(name: str, draw: Drawing, data: Data) -> Still | str | None:
    """A picture, `None` where there is nothing to draw, or why a plugin could not draw it."""
    with styled():
        try:
            figure = draw(data)
        except FigureError as error:
            return str(error)
        if figure is None:
            return None
        picture = _picture(figure)
    stream = io.BytesIO()
    picture.save(stream, "webp", lossless=True, **EFFORT)
    source = "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
    return Still(name, caption_of(figure), seen(figure), source, *picture.size)


def _picture(figure: Figure) -> Image.Image:
    """The dots of a figure in a palette of 256 colours, of which line drawings need fewer."""
    figure.set_dpi(DPI)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    whole = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    return whole.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).convert("RGB")


def seen(figure: Figure) -> str:
    """What a figure shows, for those who do not see it: panel by panel what is drawn, and its range."""
    panels = [text for panel in figure.axes if (text := _panel(panel))]
    title = unbroken(figure.get_suptitle())
    count = f"{len(panels)} panels. " if len(panels) > 1 else ""
    return f"{f'{title}. ' if title else ''}{count}{' '.join(panels)}"


def _panel(panel: Axes) -> str:
    if not panel.axison and not panel.collections:
        return ""
    said = list(_series(panel)) or list(_areas(panel))
    if not said:
        return ""
    title, x, y = (unbroken(text) for text in (panel.get_title(), panel.get_xlabel(), panel.get_ylabel()))
    what = f"{y} over {x}" if x and y else x or y
    return f"{': '.join(filter(None, (title, what)))}: {'; '.join(said)}."


def _series(panel: Axes) -> Iterator[str]:
    """Each labelled line with its range; of many, the number of them and the range of all."""
    lines = [line for line in panel.lines if _values(line).size]
    if len(lines) <= NAMED:
        for line in lines:
            yield _line(line)
        return
    values = np.concatenate([_values(line) for line in lines])
    lowest = min(lines, key=lambda line: float(_values(line).min()))
    highest = max(lines, key=lambda line: float(_values(line).max()))
    yield f"{len(lines)} series between {values.min():.3g} and {values.max():.3g}"
    for which, line, value in (("lowest", lowest, values.min()), ("highest", highest, values.max())):
        if _name(line):
            yield f"the {which} is {value:.3g} of {_name(line)}"


def _areas(panel: Axes) -> Iterator[str]:
    """A field drawn in colours, with its range."""
    for one in panel.collections:
        values = one.get_array()
        if values is not None and np.isfinite(values).any():
            yield f"a field between {np.nanmin(values):.3g} and {np.nanmax(values):.3g}"


def _line(line: Line2D) -> str:
    values, name = _values(line), _name(line)
    before = f"{name} " if name else ""
    if values.size == 1:
        return f"{before}at {values[0]:.3g}"
    if line.get_linestyle() in ("None", "none", "", " "):
        return f"{before}{values.size} points between {values.min():.3g} and {values.max():.3g}"
    between = "" if values.min() >= min(values[0], values[-1]) else f", at least {values.min():.3g}"
    return f"{before}from {values[0]:.3g} to {values[-1]:.3g}{between}"


def _name(line: Line2D) -> str:
    label = unbroken(str(line.get_label()))
    return "" if label.startswith("_child") else label


def _values(line: Line2D) -> Array:
    found: Array = np.asarray(line.get_ydata(), dtype=float).ravel()
    return found[np.isfinite(found)]
