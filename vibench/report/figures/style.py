"""Style of the figures: panels of fixed size, colours and lines legible in grey print, reproducible files."""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import matplotlib as mpl
import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, which colour-blind readers can distinguish; lines and markers differ, too."""

LINES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
MARKERS = "os^vDPX"
BLACK = 6
"""Index of the style reserved for the high-fidelity model."""

MARKED = 9
"""Number of markers on a line, to identify it in grey print."""

POINTS: dict[str, Any] = {"linestyle": "none", "markevery": None}
"""Changes a line to points."""

WRITTEN: dict[str, dict[str, Any]] = {
    "png": {"metadata": {"Software": None}, "pil_kwargs": {"compress_level": 3}},
    "svg": {"metadata": {"Date": None}},
}
"""Options of `savefig`: no date, so that the same results give the same files."""

FORMATS = tuple(WRITTEN)

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.grid": True,
    "axes.grid.which": "major",
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.3,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "savefig.dpi": 150,
    "svg.hashsalt": "vibench",
    # Labels are text of others: a dollar sign in them is no formula, whatever the user's own settings are.
    "text.parse_math": False,
    "text.usetex": False,
    "axes.formatter.use_mathtext": False,
}

CHARACTER, TITLE_CHARACTER = 0.068, 0.085
"""Average widths of a character of a legend and of a title, in inches."""

FEW, DENSE = 0.6, 2.2
"""Decades below which a logarithmic axis has the ticks of a linear one, and ticks at 1, 2 and 5, as plain numbers."""

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Layout:
    """Size of a panel and of the margins around it for ticks, labels and its title, in inches."""

    width: float = 3.1
    height: float = 2.5
    left: float = 0.88
    right: float = 0.16
    below: float = 0.55
    above: float = 0.34


class Sheet:
    """A figure of rows × columns equal panels with a title above and one legend below them all.

    Sizes follow from the layout and the number of characters of title and legend: no text is rendered to measure it.
    """

    def __init__(self, rows: int, columns: int, title: str = "", layout: Layout = Layout()) -> None:
        self._rows, self._columns, self._title, self._layout = rows, columns, title, layout
        self.figure = Figure()
        self.panels: list[Axes] = list(self.figure.subplots(rows, columns, squeeze=False).ravel())

    def at(self, row: int, column: int) -> Axes:
        """One panel."""
        return self.panels[row * self._columns + column]

    def finish(self) -> Figure:
        """Set ticks, sizes and a legend in which every label of the panels occurs once; returns the figure."""
        layout = self._layout
        column, row = layout.left + layout.width + layout.right, layout.above + layout.height + layout.below
        wide = self._columns * column
        legend = self._legend(wide)
        lines = textwrap.wrap(self._title, int(wide / TITLE_CHARACTER))
        high = self._rows * row + legend + 0.17 * len(lines) + 0.1
        self.figure.set_size_inches(wide, high)
        self.figure.suptitle("\n".join(lines), fontsize=10, x=0.08 / wide, y=1.0 - 0.06 / high, ha="left", va="top")
        for k, panel in enumerate(self.panels):
            down, along = divmod(k, self._columns)
            left, bottom = along * column + layout.left, legend + (self._rows - 1 - down) * row + layout.below
            panel.set_position((left / wide, bottom / high, layout.width / wide, layout.height / high))
            _ticks(panel)
        return self.figure

    def _legend(self, wide: float) -> float:
        """Draw the legend; returns its height."""
        named: dict[str, Any] = {}
        for panel in self.panels:
            for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
                named.setdefault(label, handle)
        if not named:
            return 0.0
        longest = max(map(len, named)) * CHARACTER + 0.6
        columns = max(1, min(len(named), int(wide / longest)))
        self.figure.legend(named.values(), named.keys(), loc="lower center", ncols=columns)
        return 0.19 * math.ceil(len(named) / columns) + 0.12


def line(k: int, count: int = 0) -> dict[str, Any]:
    """Style k: colour, line and marker; lines and markers change where the colours repeat.

    `count` is the number of points; of many, only about `MARKED` carry the marker.
    """
    colour, other = COLOURS[k % len(COLOURS)], k + k // len(COLOURS)
    return {
        "color": colour,
        "linestyle": LINES[other % len(LINES)],
        "marker": MARKERS[other % len(MARKERS)],
        "markersize": 3.5,
        "markevery": (k % 3, max(1, count // MARKED)),
        "markerfacecolor": "white" if k % 2 else colour,
    }


def style_of(name: str, known: dict[str, int]) -> int:
    """Style of a name in all panels of a figure; a new name takes the next one and is added to `known`."""
    return known.setdefault(name, len(known) + (len(known) >= BLACK))


def plot(axes: Axes, x: Any, y: Any, k: int, label: str | None = None, **more: Any) -> None:
    """Draw a line in style k."""
    axes.plot(x, y, label=legend_label(label), **line(k, len(x)) | more)


def legend_label(text: str | None) -> str | None:
    """A label for the legend; Matplotlib would leave out one that begins with an underscore."""
    return f" {text}" if text is not None and text.startswith("_") else text


def _ticks(axes: Axes) -> None:
    """Set the ticks of logarithmic axes, however many decades they span."""
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if axis.get_scale() != "log":
            continue
        limits = getattr(axes, f"get_{name}lim")()
        if not 0.0 < limits[0] < limits[1]:  # no positive value on this axis
            limits = (0.1, 1.0)
            getattr(axes, f"set_{name}lim")(limits)
        axis.set_minor_locator(ticker.NullLocator())  # minor ticks would take most of the time of drawing
        decades = math.log10(limits[1] / limits[0])
        if decades < FEW:
            axis.set_major_locator(ticker.MaxNLocator(5))
        elif decades < DENSE:
            axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:.3g}" if decades < DENSE else _power)


def _power(value: float, _: float) -> str:
    return "10" + f"{round(math.log10(value))}".translate(SUPERSCRIPTS)


def counted(axes: Axes) -> None:
    """Whole numbers along x."""
    axes.xaxis.set_major_locator(ticker.MaxNLocator(6, integer=True))


def positive(values: Any, floor: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Values for a logarithmic axis; values up to the floor become NaN."""
    found = np.asarray(values, float)
    return np.where(found > floor, found, np.nan)


def styled() -> AbstractContextManager[None]:
    """Context in which figures are made and written in the common style."""
    return mpl.rc_context(STYLE)


def save(figure: Figure, folder: Path, name: str, formats: Iterable[str] = FORMATS) -> list[Path]:
    """Write a figure in every format; returns the files."""
    files = {form: folder / f"{name}.{form}" for form in formats}
    for form, file in files.items():
        write_figure(figure, file, form)
    return list(files.values())


def write_figure(figure: Figure, target: Path | BinaryIO, form: str) -> None:
    """Write a figure in a format; a character that the font does not have is a box, and no warning."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+|Matplotlib currently does not support", UserWarning)
        figure.savefig(target, format=form, **WRITTEN[form])
