"""Style of the figures: looks of strategies and solvers, panels of fixed size, captions, labels, reproducible files."""

from __future__ import annotations

import hashlib
import math
import re
import textwrap
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.arrays import Array
from vibench.text import printable

COLOURS = ("#520186", "#91071B", "#A22174", "#615CDB", "#DF5225", "#2CA980", "#AEA0F2", "#E4BD20")
"""Equidistant in lightness (CIELAB, 22 to 78 in steps of 8), so that print in grey keeps them apart, with the hues that
are farthest apart for readers with and without a colour vision deficiency; markers differ, too."""

BLACK = "#000000"
"""The colour of the high-fidelity model, and of what belongs to no strategy."""

DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
MARKERS = "os^vDPX*dph"
"""Triangles to the left and to the right mark break-evens."""

SEED = (120727).to_bytes(8, "big")
"""Salt of the hash of names; with this number all dual strategies that are shipped have colours of their own, all
primal ones, too, and no two of these and of the solvers look the same."""

MARKED = 9
"""Number of markers on a line, to identify it in grey print."""


@dataclass(frozen=True)
class Look:
    """How a series is drawn: colour and marker, and what tells it from others that share these.

    Attributes
    ----------
    colour, marker
        Determined by the name of the strategy or solver.
    rank
        Place among the series with the same colour and marker in a figure; sets line style and filling.
    """

    colour: str
    marker: str
    rank: int = 0

    def line(self, count: int = 0) -> dict[str, Any]:
        """The look as arguments of `Axes.plot`; of `count` points only about `MARKED` carry the marker."""
        return {
            "color": self.colour,
            "linestyle": DASHES[self.rank % len(DASHES)],
            "marker": self.marker,
            "markersize": 3.5,
            "markevery": (self.rank % 3, max(1, count // MARKED)),
            **self._filling(),
        }

    def point(self) -> dict[str, Any]:
        """The same for points without a line, which filling and edge alone tell apart."""
        edge = 1.0 + 0.6 * (self.rank // len(self._faces()))
        return {"color": self.colour, "marker": self.marker, "linestyle": "none", "markersize": 5} | {
            **self._filling(),
            "markeredgewidth": edge,
        }

    def _filling(self) -> dict[str, Any]:
        faces = self._faces()
        return {"markerfacecolor": faces[self.rank % len(faces)]}

    def _faces(self) -> tuple[str, ...]:
        return (self.colour, "white", "0.75")


HIGH_FIDELITY_LOOK = Look(BLACK, "s", 3)
"""The look of the high-fidelity model: dotted black lines."""


class Series(NamedTuple):
    """A series of a figure: the name of its strategy or solver, and what tells it from others of that name."""

    name: str
    variant: str | float = ""


def look_of(name: str) -> Look:
    """The look of a strategy or a solver; it depends on the name alone."""
    number = int.from_bytes(hashlib.blake2b(name.encode(errors="replace"), digest_size=8, salt=SEED).digest(), "big")
    return Look(COLOURS[number % len(COLOURS)], MARKERS[number // len(COLOURS) % len(MARKERS)])


class Looks:
    """The looks of the series of one figure.

    Series that share colour and marker, those of one strategy at several tolerances in particular, get ranks in their
    order, so that no two series of a figure look the same.
    """

    def __init__(self, series: Iterable[Series]) -> None:
        alike: dict[Look, list[Series]] = defaultdict(list)
        for one in sorted(set(series), key=_order):
            alike[look_of(one.name)].append(one)
        self._known = {one: replace(look, rank=rank) for look, group in alike.items() for rank, one in enumerate(group)}

    def __getitem__(self, series: Series) -> Look:
        return self._known[series]

    def __iter__(self) -> Iterator[Series]:
        return iter(self._known)


def _order(series: Series) -> tuple[str, bool, float, str]:
    """The key by which series are sorted: name, then variants, texts before numbers."""
    number = isinstance(series.variant, float)
    return series.name, number, float(series.variant) if number else 0.0, str(series.variant)


Box = tuple[float, float, float, float]
"""Left, bottom, right and top, in points (1/72 inch)."""

SIZE = 6.0
"""Size of the font of labels, in points."""

LABEL_CHARACTER, HEIGHT = 0.62, 1.15
"""Width of a character and height of a line, in sizes of the font; no text is rendered to measure it."""

MARKER = 3.5
"""Half the width of what a label keeps clear around a point, in points."""

SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Sides of a point, in the order in which a label is tried there."""


def label_points(axes: Axes, points: list[tuple[float, float, str]]) -> int:
    """Write a label at every point (x, y, text) where there is room; returns the number of those without room.

    A point without a text is only kept clear. The axes must have their final size and limits.
    """
    drawn = [(x, y, text) for x, y, text in points if np.isfinite([x, y]).all()]
    if not drawn:
        return 0
    scale = 72.0 / float(axes.figure.dpi)
    places = scale * axes.transData.transform([(x, y) for x, y, _ in drawn])
    left, bottom, right, top = (scale * float(end) for end in axes.bbox.extents)
    taken: list[Box] = [(x - MARKER, y - MARKER, x + MARKER, y + MARKER) for x, y in places]
    missing = 0
    for (x, y, text), place in zip(drawn, places, strict=True):
        if not text:
            continue
        box = _free(place, text, taken, (left, bottom, right, top))
        if box is None:
            missing += 1
            continue
        taken.append(box)
        offset = (box[0] - place[0], box[1] - place[1])
        axes.annotate(
            text, (x, y), offset, textcoords="offset points", fontsize=SIZE, color="0.25", va="bottom", ha="left"
        )
    return missing


def _free(place: Array, text: str, taken: list[Box], inside: Box) -> Box | None:
    """The first box beside a point that is inside the panel and covers nothing."""
    width, height = LABEL_CHARACTER * SIZE * len(text), HEIGHT * SIZE
    for across, up in SIDES:
        x = place[0] + (MARKER + 1.0 if across > 0 else -MARKER - 1.0 - width if across < 0 else -0.5 * width)
        y = place[1] + (MARKER if up > 0 else -MARKER - height if up < 0 else -0.5 * height)
        box = (x, y, x + width, y + height)
        within = box[0] >= inside[0] and box[1] >= inside[1] and box[2] <= inside[2] and box[3] <= inside[3]
        if within and not any(_overlap(box, other) for other in taken):
            return box
    return None


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


Share = Literal["none", "all", "row", "col"]

WRITTEN: dict[str, dict[str, Any]] = {
    "png": {"metadata": {"Software": None}, "pil_kwargs": {"compress_level": 3}},
    "svg": {"metadata": {"Date": None}},
    "pdf": {"metadata": {"CreationDate": None}},
}
"""Options of `savefig`: no date, so that the same results give the same files."""

DESCRIBED = {"png": "Description", "svg": "Description", "pdf": "Subject"}
"""Where a file of each format has the caption."""

FORMATS = ("png", "svg")
"""Formats that are written where none is asked for."""

ABREAST = 3
"""Panels in a row."""

SERIES = 10
"""Series in a panel, that of the high-fidelity model included."""

DEEP = 4
"""Rows of panels in a figure; the others are in further figures."""

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titley": 1.0,  # no ticks above a panel move its title: where they are need not be measured
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
    "pdf.fonttype": 42,  # journals refuse the Type 3 fonts of Matplotlib's default
    # Labels are text of others: a dollar sign in them is no formula, whatever the user's own settings are.
    "text.parse_math": False,
    "text.usetex": False,
    "axes.formatter.use_mathtext": False,
}

CHARACTER, TITLE_CHARACTER = 0.068, 0.085
"""Average widths of a character of a legend and of a title, in inches."""

FEW, WIDE, DENSE = 0.6, 1.4, 2.2
"""Decades below which a logarithmic axis has the ticks of a linear one, ticks at 1, 2 and 5, and at 1 and 3, all as
plain numbers."""

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Layout:
    """Size of a panel and of the margins around it for ticks, labels and its title, in inches.

    `tail` is the room right of the last panels, for a colour bar.
    """

    width: float = 3.1
    height: float = 2.5
    left: float = 0.88
    right: float = 0.16
    below: float = 0.55
    above: float = 0.34
    tail: float = 0.0


class CaptionedFigure(Figure):
    """A figure with its caption.

    Attributes
    ----------
    caption
        What it shows, in sentences for readers who do not see it, and what it leaves out.
    part
        Which part it is of a figure that has too many panels for one page, as a sentence; "" if it is the whole.
    published, compared
        What is published of a figure that is drawn again, and what agrees and what differs.
    """

    caption: str = ""
    part: str = ""
    published: str = ""
    compared: str = ""

    @property
    def alternative(self) -> str:
        """Alternative text for a page: the first sentence of the caption."""
        return first_sentence(self.caption)


Pages = Iterator[CaptionedFigure]
"""A figure: one page, several where it has too many panels for one, none where there is nothing to draw."""


def caption_of(figure: Figure) -> str:
    """The caption of a figure in a line; "" if it has none."""
    return " ".join(str(getattr(figure, "caption", "")).split())


def first_sentence(text: str) -> str:
    """The first sentence of a text; a point after a digit or a single letter ends none."""
    found = re.match(r".+?[^\W\d_]{2}[)’”]?\.(?= |$)", text)
    return found[0] if found else text


class Sheet:
    """A figure of equal panels with a title above and one legend below them all.

    Sizes follow from the layout and the number of characters of title and legend: no text is rendered to measure it.

    Parameters
    ----------
    rows, columns
        Numbers of panels.
    title
        Line above them.
    layout
        Size of a panel.
    sharex, sharey
        Which panels share an axis, so that they can be compared: "all", "row", "col" or "none".
    """

    def __init__(
        self,
        rows: int,
        columns: int,
        title: str = "",
        layout: Layout = Layout(),
        sharex: Share = "none",
        sharey: Share = "none",
    ) -> None:
        self._rows, self._columns, self._title, self._layout = rows, columns, title, layout
        self.figure = CaptionedFigure()
        made = self.figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
        self.panels: list[Axes] = list(made.ravel())
        self._labels: dict[int, list[tuple[float, float, str]]] = {}
        for panel in self.panels:  # numbers at every panel, shared axes or not
            panel.tick_params(labelbottom=True, labelleft=True)

    @classmethod
    def of(cls, count: int, title: str = "", layout: Layout = Layout(), share: Share = "none") -> Sheet:
        """A sheet with at least `count` panels, at most `ABREAST` in a row; those beyond `count` are not shown."""
        columns = max(1, min(count, ABREAST))
        sheet = cls(-(-count // columns) or 1, columns, title, layout, share, share)
        for panel in sheet.panels[count:]:
            panel.set_axis_off()
        return sheet

    def at(self, row: int, column: int) -> Axes:
        """One panel."""
        return self.panels[row * self._columns + column]

    def label(self, panel: Axes, x: float, y: float, text: str) -> None:
        """Write a text at a point, where there is room for it in the finished figure; without one keep it clear."""
        self._labels.setdefault(self.panels.index(panel), []).append((x, y, text))

    def finish(self, caption: str = "", part: str = "") -> CaptionedFigure:
        """Set ticks, sizes and a legend in which every label of the panels occurs once; returns the figure.

        The caption says, too, which part of a figure it is, and how many labels of points have no room.
        """
        layout = self._layout
        column, row = layout.left + layout.width + layout.right, layout.above + layout.height + layout.below
        wide = self._columns * column + layout.tail
        legend = self._legend(wide)
        lines = textwrap.wrap(self._title, int(wide / TITLE_CHARACTER))
        high = self._rows * row + legend + 0.17 * len(lines) + 0.1
        self.figure.set_size_inches(wide, high)
        self.figure.suptitle("\n".join(lines), fontsize=10, x=0.08 / wide, y=1.0 - 0.06 / high, ha="left", va="top")
        for k, panel in enumerate(self.panels):
            down, along = divmod(k, self._columns)
            left, bottom = along * column + layout.left, legend + (self._rows - 1 - down) * row + layout.below
            panel.set_position((left / wide, bottom / high, layout.width / wide, layout.height / high))
            set_ticks(panel)
        missing = sum(label_points(self.panels[k], points) for k, points in self._labels.items())
        unlabelled = f"{missing} points have no label, since others are too close." if missing else ""
        self.figure.caption = " ".join(f"{caption} {part} {unlabelled}".split())
        self.figure.part = part
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


def two_rows(count: int, title: str) -> tuple[Sheet, list[Axes], list[Axes]]:
    """A sheet of `count` upper panels with a lower one each; upper panels share their axes, and so do lower ones."""
    columns = max(1, min(count, ABREAST))
    blocks = -(-count // columns) or 1
    sheet = Sheet(2 * blocks, columns, title, sharex="all")
    upper, lower = (
        [sheet.at(2 * (k // columns) + row, k % columns) for k in range(blocks * columns)] for row in (0, 1)
    )
    for panels in (upper, lower):
        for panel in panels[1:]:
            panel.sharey(panels[0])
        for panel in panels[count:]:
            panel.set_axis_off()
    return sheet, upper[:count], lower[:count]


def plot(axes: Axes, x: Any, y: Any, look: Look, label: str | None = None, **more: Any) -> None:
    """Draw a line in a look."""
    axes.plot(x, y, label=legend_label(label), **look.line(len(x)) | more)


def scatter(axes: Axes, x: Any, y: Any, look: Look, label: str | None = None, **more: Any) -> None:
    """Draw points in a look."""
    axes.plot(x, y, label=legend_label(label), **look.point() | more)


def legend_label(text: str | None) -> str | None:
    """A label for the legend; Matplotlib would leave out one that begins with an underscore."""
    return f" {text}" if text is not None and text.startswith("_") else text


def set_ticks(axes: Axes) -> None:
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
            # numbers such as 0.00005 at 2 and 5 of every decade would touch where there are more than about five
            axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0) if decades < WIDE else (1.0, 3.0)))
        axis.set_major_formatter("{x:.3g}" if decades < DENSE else _power)


def _power(value: float, _: float) -> str:
    return "10" + f"{round(math.log10(value))}".translate(SUPERSCRIPTS)


def counted(axes: Axes) -> None:
    """Whole numbers along x."""
    axes.xaxis.set_major_locator(ticker.MaxNLocator(6, integer=True))


def positive(values: Any, floor: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Values for a logarithmic axis; values up to the floor become NaN."""
    numbers = np.asarray(values, float)
    return np.where(numbers > floor, numbers, np.nan)


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
    """Write a figure in a format, with its caption; a character that the font does not have is a box, no warning."""
    options = dict(WRITTEN[form])
    if caption := caption_of(figure):
        options["metadata"] = options["metadata"] | {DESCRIBED[form]: printable(caption)}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+|Matplotlib currently does not support", UserWarning)
        figure.savefig(target, format=form, **options)
