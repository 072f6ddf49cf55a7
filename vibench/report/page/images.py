"""The pictures of a report: drawn as for `vibench figures`, compact, with a text that says what is seen."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from vibench.arrays import Array
from vibench.report.figures.style import caption_of
from vibench.text import unbroken

DPI = 110
"""Dots per inch: sharp enough at the width of a page, and a tenth of the bytes of a vector picture of many lines."""

EFFORT = {"method": 1, "quality": 0}
"""Options of the compression: a third of the time of more thorough ones, for a quarter more bytes."""

NAMED = 6
"""Series of a panel that an alternative text describes one by one."""


@dataclass(frozen=True)
class FigureImage:
    """The picture of a figure."""

    name: str
    caption: str
    cut: bool
    """Whether it is only the beginning of the figure."""
    alternative: str
    """What is seen."""
    source: str
    """Its data URI."""
    width: int
    """Pixels in a row."""
    height: int
    """Rows of pixels."""


def image_of(name: str, figure: Figure) -> FigureImage:
    """The picture of a figure."""
    dots, stream = _dots(figure), io.BytesIO()
    dots.save(stream, "webp", lossless=True, **EFFORT)
    source = "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
    return FigureImage(name, caption_of(figure), bool(getattr(figure, "part", "")), seen(figure), source, *dots.size)


def _dots(figure: Figure) -> Image.Image:
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
    values: Array = np.asarray(line.get_ydata(), dtype=float).ravel()
    return values[np.isfinite(values)]
