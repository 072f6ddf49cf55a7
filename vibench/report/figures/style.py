"""How figures look: panels of fixed size on a sheet, colours and lines that survive grey print, files."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, told apart by colour-blind readers; lines and markers differ too."""

LINES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
MARKERS = "os^vDPX"
BLACK = 6
"""Index of the style kept for the high-fidelity model."""

MARKED = 9
"""Markers on a line, so that it is known again in grey print."""

WRITTEN: dict[str, dict[str, Any]] = {
    "png": {"metadata": {"Software": None}, "pil_kwargs": {"compress_level": 3}},
    "svg": {"metadata": {"Date": None}},
}
"""How files are written: without a date, so that the same results give the same files."""

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
}

CHARACTER = 0.068
"""Inches that a character of a legend takes on average."""

TITLE_CHARACTER = 0.085
"""The same of a title."""

DENSE = 2.2
"""Decades below which a logarithmic axis has ticks at 1, 2 and 5."""

FEW = 0.6
"""Decades below which it has the ticks of a linear one."""

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Layout:
    """Sizes in inches: a panel, and the room around it for ticks, labels and its title."""

    width: float = 3.1
    height: float = 2.5
    left: float = 0.88
    right: float = 0.16
    below: float = 0.55
    above: float = 0.34


class Sheet:
    """A figure of equal panels, with one legend below them all; nothing is measured, so nothing is clipped late.

    Parameters
    ----------
    rows, columns
        How many panels.
    title
        What the figure shows, above everything.
    layout
        Sizes of a panel.
    """

    def __init__(self, rows: int, columns: int, title: str = "", layout: Layout = Layout()) -> None:
        self._rows, self._columns, self._title, self._layout = rows, columns, title, layout
        self.figure = Figure()
        grid = self.figure.subplots(rows, columns, squeeze=False)
        self.panels: list[Axes] = list(grid.ravel())
        self._arrange(0.0)

    def at(self, row: int, column: int) -> Axes:
        """One panel."""
        return self.panels[row * self._columns + column]

    def finish(self) -> Figure:
        """Set the ticks, and draw what is named in any panel, once, into a legend below; gives the figure."""
        named: dict[str, Any] = {}
        for panel in self.panels:
            for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
                named.setdefault(label, handle)
        for panel in self.panels:
            _ticks(panel)
        if named:
            longest = max(map(len, named)) * CHARACTER + 0.6
            columns = max(1, min(len(named), int(self._wide / longest)))
            self._arrange(0.19 * math.ceil(len(named) / columns) + 0.12)
            self.figure.legend(named.values(), named.keys(), loc="lower center", ncols=columns)
        return self.figure

    @property
    def _wide(self) -> float:
        layout = self._layout
        return self._columns * (layout.left + layout.width + layout.right)

    def _arrange(self, legend: float) -> None:
        layout = self._layout
        lines = textwrap.wrap(self._title, int(self._wide / TITLE_CHARACTER))
        title = 0.17 * len(lines) + 0.1
        row = layout.above + layout.height + layout.below
        wide, high = self._wide, self._rows * row + legend + title
        self.figure.set_size_inches(wide, high)
        for k, panel in enumerate(self.panels):
            down, along = divmod(k, self._columns)
            left = along * (layout.left + layout.width + layout.right) + layout.left
            bottom = legend + (self._rows - 1 - down) * row + layout.below
            panel.set_position((left / wide, bottom / high, layout.width / wide, layout.height / high))
        self.figure.suptitle("\n".join(lines), fontsize=10, x=0.08 / wide, y=1.0 - 0.06 / high, ha="left", va="top")


def line(k: int, count: int = 0) -> dict[str, Any]:
    """Colour, line and marker of the k-th thing in a panel; lines change when the colours have run out.

    `count` is the number of points: of many only a few carry the marker.
    """
    return {
        "color": COLOURS[k % len(COLOURS)],
        "linestyle": LINES[(k + k // len(COLOURS)) % len(LINES)],
        "marker": MARKERS[(k + k // len(COLOURS)) % len(MARKERS)],
        "markersize": 3.5,
        "markevery": (k % 3, max(1, count // MARKED)),
        "markerfacecolor": "white" if k % 2 else COLOURS[k % len(COLOURS)],
    }


def plot(axes: Axes, x: Any, y: Any, k: int, label: str | None = None, **more: Any) -> None:
    """Draw the k-th line of a panel."""
    axes.plot(x, y, label=label, **line(k, len(x)) | more)


def logarithmic(axes: Axes, which: str = "y") -> None:
    """Make axes logarithmic."""
    for name in which:
        getattr(axes, f"set_{name}scale")("log")


def _ticks(axes: Axes) -> None:
    """Enough ticks on logarithmic axes, few or many decades long; minor ones would take most of the time of drawing."""
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if axis.get_scale() != "log":
            continue
        limits = getattr(axes, f"get_{name}lim")()
        if not 0.0 < limits[0] < limits[1]:  # nothing on it that can be shown
            limits = (0.1, 1.0)
            getattr(axes, f"set_{name}lim")(limits)
        axis.set_minor_locator(ticker.NullLocator())
        decades = math.log10(limits[1] / limits[0])
        if decades < FEW:
            axis.set_major_locator(ticker.MaxNLocator(5))
        elif decades < DENSE:
            axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(ticker.FuncFormatter(_number if decades < DENSE else _power))


def _number(value: float, _: int | None) -> str:
    """A number as people write it."""
    return f"{value:.3g}"


def _power(value: float, _: int | None) -> str:
    """A power of ten."""
    return "10" + f"{round(math.log10(value))}".translate(SUPERSCRIPTS)


def counted(axes: Axes) -> None:
    """Whole numbers along x."""
    axes.xaxis.set_major_locator(ticker.MaxNLocator(6, integer=True))


def positive(values: Any, floor: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Values for a logarithmic axis: what is not above the floor is left out."""
    found = np.asarray(values, float)
    return np.where(found > floor, found, np.nan)


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the style of the figures."""
    with mpl.rc_context(STYLE):
        yield


def save(figure: Figure, folder: Path, name: str, formats: Iterable[str] = FORMATS) -> list[Path]:
    """Write a figure in every format; the same results give the same files."""
    files = []
    for form in formats:
        files.append(folder / f"{name}.{form}")
        figure.savefig(files[-1], **WRITTEN[form])
    return files
