"""Style of the figures: looks of strategies and solvers, panels of fixed size, captions, reproducible files."""

from __future__ import annotations

import hashlib
import math
import re
import textwrap
import warnings
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

import matplotlib as mpl
import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.errors import RequestError
from vibench.files import writing
from vibench.signatures import AtLeastOne, Count, Positive, Rule, bordered, bordered_constructor, refuse_others, rule_of
from vibench.text import printable

# Equidistant in lightness (CIELAB, 22 to 78 in steps of 8), so that grey print keeps them apart, with the hues that are
# farthest apart for readers with and without a colour vision deficiency; markers differ, too.
COLOURS = ("#520186", "#91071B", "#A22174", "#615CDB", "#DF5225", "#2CA980", "#AEA0F2", "#E4BD20")
# Triangles to the left and to the right are missing: they mark break-evens.
MARKERS = "os^vDPX*dph"


def _are_numbers(value: Any) -> bool:
    is_list = isinstance(value, list | tuple) and all(isinstance(one, Real) for one in value)
    kind = "f" if is_list else getattr(getattr(value, "dtype", None), "kind", "")
    return kind in set("fiub") and np.ndim(value) == 1


# Names in files of others have any characters.
Text = Annotated[Any, Rule("a text", lambda value: isinstance(value, str))]
Points = Annotated[Any, Rule("numbers of points", _are_numbers), "k"]
Formats = Annotated[Collection[str], Rule("formats of png, svg and pdf", {"png", "svg", "pdf"}.issuperset)]
Share = Literal["none", "all", "row", "col"]


@bordered
@dataclass(frozen=True)
class Look:
    """Colour and marker of a strategy or solver, the line style of its assembly, and a rank among those that share all.

    The rank, that of a tolerance, sets filling and width.
    """

    colour: str
    marker: str
    rank: Count
    dashes: Literal["-", "--", "-.", ":"] | tuple[float, tuple[float, ...]] = "-"

    def line(self, count: Count) -> dict[str, Any]:
        """Arguments of `Axes.plot` for a line of `count` points."""
        # About nine markers identify a line in grey print; their offset keeps those of equal curves apart.
        every = (self.rank % 3, max(1, count // 9))
        return {"linestyle": self.dashes, "markevery": every, **self._marker(3.5)}

    def point(self) -> dict[str, Any]:
        """Arguments of `Axes.plot` for points without a line."""
        return {"linestyle": "none", **self._marker(5.0)}

    def _marker(self, size: float) -> dict[str, Any]:
        face, edge = (self.colour, "white", "0.75")[self.rank % 3], 1.0 + 0.6 * (self.rank // 3)
        return {"color": self.colour, "marker": self.marker, "markersize": size, "markerfacecolor": face,
                "markeredgewidth": edge}  # fmt: skip


HIGH_FIDELITY_LOOK = Look("#000000", "s", 0)


@bordered_constructor
@dataclass(frozen=True)
class Series:
    """A series of a figure: name of its strategy or solver, variant such as a tolerance, and `way` of its queries."""

    name: Text
    variant: Text | float = ""
    way: Text = ""


def look_of(name: str) -> Look:
    """The look that the name of a strategy or a solver determines; figures change it where two of theirs collide."""
    # With this salt the shipped dual strategies have colours of their own, the primal ones, too, and no two of these
    # and of the solvers look the same.
    salt = (120727).to_bytes(8, "big")
    number = int.from_bytes(hashlib.blake2b(name.encode(errors="replace"), digest_size=8, salt=salt).digest(), "big")
    return Look(COLOURS[number % len(COLOURS)], MARKERS[number // len(COLOURS) % len(MARKERS)], 0)


def _looks_of(names: Iterable[str]) -> dict[str, Look]:
    """Looks of the names of one figure: up to eight have eight colours, others differ in their markers."""
    wanted = {name: look_of(name) for name in sorted(set(names))}
    looks: dict[str, Look] = {}
    # Names whose colour is free keep it; the others take those that are left.
    for name, look in wanted.items():
        if look.colour not in {one.colour for one in looks.values()}:
            looks[name] = look
    for name, look in wanted.items():
        if name not in looks:
            taken = {(one.colour, one.marker) for one in looks.values()}
            free = [colour for colour in COLOURS if colour not in {colour for colour, _ in taken}]
            rest = (pair for pair in product(COLOURS, MARKERS) if pair not in taken)
            colour, marker = (free[0], look.marker) if free else next(rest, (look.colour, look.marker))
            looks[name] = Look(colour, marker, 0)
    return looks


@bordered_constructor
class Looks:
    """The looks of the series of one figure, of which no two are the same.

    Names have colours and markers, ways of a query have line styles: full assembly solid, any other way dashed. Series
    that share all three, one strategy at several tolerances, get ranks in their order.
    """

    def __init__(self, series: Collection[Series] | Iterator[Series]) -> None:
        given = list(series)
        for one in given:
            refuse_others("a series of Looks", one, rule_of(Series))
        given = list(dict.fromkeys(given))
        looks, alike = _looks_of(one.name for one in given), defaultdict[Look, list[Series]](list)
        ways = list(dict.fromkeys(sorted(one.way for one in given)))
        dashes = {way: _dashes(way, ways) for way in ways}
        # Texts come before numbers.
        numbers = {one: one.variant if isinstance(one.variant, float) else None for one in given}
        order = {one: (one.name, n is not None, n or 0.0, str(one.variant)) for one, n in numbers.items()}
        for one in sorted(order, key=order.__getitem__):
            alike[replace(looks[one.name], dashes=dashes[one.way])].append(one)
        self._known = {one: replace(look, rank=rank) for look, group in alike.items() for rank, one in enumerate(group)}

    def __getitem__(self, series: Series) -> Look:
        return self._known[series]


def _dashes(way: str, ways: Sequence[str]) -> Any:
    """The line style of a way of a query among those of a figure."""
    usual = {"": "-", "reduced": "--", "reduced with bounds": "-."}
    others = [other for other in ways if other not in usual]
    more = (":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (1, 3)))
    return usual[way] if way in usual else more[others.index(way) % len(more)]


@bordered_constructor
@dataclass(frozen=True)
class Layout:
    """Size of a panel in inches, and the panels that have room for a colour bar right of them."""

    width: Positive
    height: Positive
    bars: Literal["none", "every", "last"] = "none"


class CaptionedFigure(Figure):
    """A figure with its caption.

    Attributes
    ----------
    caption
        What it shows, in sentences for readers who do not see it, and what it leaves out.
    published, compared
        What is published of a figure that is drawn again, and what agrees and what differs.
    """

    caption: str = ""
    published: str = ""
    compared: str = ""

    @property
    def alternative(self) -> str:
        """Alternative text for a page: the first sentence of the caption."""
        return first_sentence(self.caption)


def caption_of(figure: Figure) -> str:
    """The caption of a figure in a line; "" if it has none."""
    return " ".join(str(getattr(figure, "caption", "")).split())


def first_sentence(text: str) -> str:
    """The first sentence of a text; a point after a digit or a single letter ends none."""
    found = re.match(r".+?[^\W\d_]{2}[)’”]?\.(?= |$)", text)
    return found[0] if found else text


@bordered
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
        self, rows: AtLeastOne, columns: AtLeastOne, title: Text = "", layout: Layout = Layout(3.1, 2.5),
        sharex: Share = "none", sharey: Share = "none",
    ) -> None:  # fmt: skip
        self._rows, self._columns, self._title, self._layout = rows, columns, title, layout
        self.figure = CaptionedFigure()
        made = self.figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)
        self.panels: list[Axes] = list(made.ravel())
        self._labelled_ends: list[Axes] = []
        for panel in self.panels:
            # Every panel has numbers, whether it shares its axes or not.
            panel.tick_params(labelbottom=True, labelleft=True)

    @classmethod
    def with_panels(cls, count: Count, title: Text, layout: Layout = Layout(3.1, 2.5), share: Share = "none") -> Sheet:
        """A sheet with at least `count` panels, at most three in a row; those beyond `count` are not shown."""
        columns = max(1, min(count, 3))
        sheet = cls(-(-count // columns) or 1, columns, title, layout, share, share)
        for panel in sheet.panels[count:]:
            panel.set_axis_off()
        return sheet

    def panel(self, row: Count, column: Count) -> Axes:
        """One panel."""
        if not (row < self._rows and column < self._columns):
            raise RequestError(f"there is no panel ({row}, {column}) among {self._rows}×{self._columns}")
        return self.panels[row * self._columns + column]

    def label_ends(self, panel: Axes) -> None:
        """Name the lines, or points, of a panel right of it, at most five, in place of the legend."""
        self._labelled_ends.append(panel)

    def finish(self, caption: Text = "", part: Text = "") -> CaptionedFigure:
        """Set ticks, sizes and a legend in which every label of the panels occurs once; returns the figure.

        The caption says, too, what it leaves out (`part`).
        """
        layout = self._layout
        # Room in inches left of and below a panel for ticks and labels, right of it, and for the title above it.
        left, below, right = 0.88, 0.55, 0.95 if layout.bars == "every" else 0.16
        column, row = left + layout.width + right, below + layout.height + 0.34
        wide = self._columns * column + (0.9 if layout.bars == "last" else 0.0)
        legend = self._legend(wide)
        # A character of the title has an average width of 0.085 inches.
        lines = textwrap.wrap(self._title, int(wide / 0.085))
        high = self._rows * row + legend + 0.17 * len(lines) + 0.1
        self.figure.set_size_inches(wide, high)
        self.figure.suptitle("\n".join(lines), fontsize=10, x=0.08 / wide, y=1.0 - 0.06 / high, ha="left", va="top")
        for k, panel in enumerate(self.panels):
            down, along = divmod(k, self._columns)
            x, y = along * column + left, legend + (self._rows - 1 - down) * row + below
            panel.set_position((x / wide, y / high, layout.width / wide, layout.height / high))
            set_ticks(panel)
        for panel in self._labelled_ends:
            _label_ends(panel)
        self.figure.caption = " ".join(f"{caption} {part}".split())
        return self.figure

    def _legend(self, wide: float) -> float:
        """Draw the legend; returns its height in inches."""
        named: dict[str, Any] = {}
        for panel in (one for one in self.panels if one not in self._labelled_ends):
            for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
                named.setdefault(label, handle)
        if not named:
            return 0.0
        # A character of a label has an average width of 0.068 inches; its handle and the gap take 0.6.
        longest = max(map(len, named)) * 0.068 + 0.6
        columns = max(1, min(len(named), int(wide / longest)))
        self.figure.legend(named.values(), named.keys(), loc="lower center", ncols=columns)
        return 0.19 * math.ceil(len(named) / columns) + 0.12


def plot(axes: Axes, x: Points, y: Points, look: Look, label: str | None = None, **more: Any) -> None:
    """Draw a line in a look."""
    axes.plot(x, y, label=_legend_label(label), **look.line(len(x)) | more)


def scatter(axes: Axes, x: Points, y: Points, look: Look, label: str | None = None, **more: Any) -> None:
    """Draw points in a look."""
    axes.plot(x, y, label=_legend_label(label), **look.point() | more)


def _legend_label(text: str | None) -> str | None:
    # Matplotlib leaves out a label that begins with an underscore.
    return f" {text}" if text is not None and text.startswith("_") else text


def set_ticks(axes: Axes) -> None:
    """Set the ticks of logarithmic axes, however many decades they span."""
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if axis.get_scale() != "log":
            continue
        limits = getattr(axes, f"get_{name}lim")()
        if not 0.0 < limits[0] < limits[1]:
            # There is no positive value on this axis.
            limits = (0.1, 1.0)
            getattr(axes, f"set_{name}lim")(limits)
        # Minor ticks would take most of the time of drawing.
        axis.set_minor_locator(ticker.NullLocator())
        decades = math.log10(limits[1] / limits[0])
        few = decades < 2.2
        if decades < 0.6:
            axis.set_major_locator(ticker.MaxNLocator(5))
        elif few:
            # Numbers such as 0.00005 at 2 and 5 of every decade would touch where there are more than about five.
            axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0) if decades < 1.4 else (1.0, 3.0)))
        axis.set_major_formatter(_plain if few else _power)


def _plain(value: float, _: float) -> str:
    digits, exponent = (*f"{value:.3g}".split("e"), "0")[:2]
    if 0 <= int(exponent) < 6:
        return f"{float(digits) * 10 ** int(exponent):,.10g}"
    return f"{digits}·".removeprefix("1·") + _power(float(f"1e{exponent}"), 0.0)


def _power(value: float, _: float) -> str:
    exponent = f"{round(math.log10(value))}".translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{exponent}"


def counted(axes: Axes) -> None:
    """Set whole numbers along x."""
    axes.xaxis.set_major_locator(ticker.MaxNLocator(6, integer=True))


def positive(values: Any, floor: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Values for a logarithmic axis; values up to the floor become NaN."""
    numbers = np.asarray(values, float)
    return np.where(numbers > floor, numbers, np.nan)


def _label_ends(axes: Axes) -> None:
    """Write the names of lines right of the panel, each beside the end of its line or as close as others allow."""
    height = 72.0 * axes.bbox.height / axes.figure.dpi
    ends = []
    named = ((line, str(line.get_label())) for line in axes.get_lines())
    for line, name in ((line, name) for line, name in named if not name.startswith("_")):
        points = axes.transAxes.inverted().transform(axes.transData.transform(line.get_xydata()))
        finite = points[np.isfinite(points).all(axis=1)]
        if len(finite):
            ends.append((float(np.clip(finite[-1, 1], 0.0, 1.0)), textwrap.wrap(name, 15), line))
    # From below, each at least a label above the one before; then from above, none beyond the panel.
    ends.sort(key=lambda end: end[0])
    room = [9.5 * len(lines) / height for _, lines, _ in ends]
    places = [place for place, *_ in ends]
    for k in range(1, len(ends)):
        places[k] = max(places[k], places[k - 1] + 0.5 * (room[k] + room[k - 1]))
    for k in reversed(range(len(ends))):
        highest = 1.0 if k == len(ends) - 1 else places[k + 1] - 0.5 * (room[k] + room[k + 1])
        places[k] = min(places[k], highest)
    for place, (_, lines, line) in zip(places, ends, strict=True):
        # Typing knows no marker of a line that a plot would not take.
        look: dict[str, Any] = {"color": line.get_color(), "marker": line.get_marker()}
        axes.plot(1.05, place, transform=axes.transAxes, clip_on=False, ms=3.5, mfc=line.get_markerfacecolor(), **look)
        axes.text(1.09, place, "\n".join(lines), transform=axes.transAxes, fontsize=7.5, va="center_baseline")


@cache
def _style() -> mpl.RcParams:
    return mpl.rc_params_from_file(Path(__file__).with_name("vibench.mplstyle"), use_default_template=False)


def styled() -> AbstractContextManager[None]:
    """Context in which figures are made and written in the common style."""
    return mpl.rc_context(_style())


def save(figure: Figure, folder: Path, name: str, formats: Formats = ("png", "svg")) -> list[Path]:
    """Write a figure in every format, "png", "svg" or "pdf"; returns the files."""
    files = {form: folder / f"{name}.{form}" for form in formats}
    for form, file in files.items():
        with writing(file):
            write_figure(figure, file, form)
    return list(files.values())


def write_figure(figure: Figure, target: Path | BinaryIO, form: str) -> None:
    """Write a figure in a format, with its caption; a character that the font does not have is a box, no warning."""
    # No date and no version of the software: the same results give the same files.
    metadata: dict[str, str | None] = {{"png": "Software", "svg": "Date", "pdf": "CreationDate"}[form]: None}
    if caption := caption_of(figure):
        metadata["Subject" if form == "pdf" else "Description"] = printable(caption)
    # Weak compression: line drawings are small anyway, and there are many of them.
    more: dict[str, Any] = {"pil_kwargs": {"compress_level": 3}} if form == "png" else {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+|Matplotlib currently does not support", UserWarning)
        figure.savefig(target, format=form, metadata=metadata, **more)
