"""Plots of the report to work with, and its pictures with a text that says what they show."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from vibench.errors import foreign
from vibench.report.figures.data import ProblemTables, label
from vibench.report.figures.style import Look, Looks, Series, caption_of, first_sentence
from vibench.results import ranking
from vibench.results.break_even import HIGH_FIDELITY, TAIL
from vibench.results.formats import cell_text
from vibench.results.paired_timing import PairedTiming
from vibench.text import printable

with foreign("matplotlib cannot be used"):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure


@cache
def library() -> str:
    """The JavaScript that draws the plots, with its licence."""
    folder = files("bokeh") / "server" / "static" / "js"
    names = ("bokeh.min.js", "bokeh-api.min.js")
    return "\n".join((folder / name).read_text(encoding="utf-8").strip() for name in names)


@dataclass(frozen=True)
class Plot:
    """A plot of one problem."""

    name: str
    title: str
    # Series, points with their rows in the table of cells, panels with coordinates or null, curves of costs.
    data: dict[str, Any]


def overview(
    name: str, data: ProblemTables, rows: Mapping[str, int], paired: PairedTiming, certified: pd.Series
) -> Plot | None:
    """Errors, and certified ones, of all models against the seconds of a query, and total costs over the queries.

    The name begins with that of the problem; `rows` has the row of every cell in the table of cells. There is no plot
    where no cell has a point in it.
    """
    cells = data.cells[ranking.eligible(data.cells) & data.cells["online_s"].notna()]
    errors, bounds = ranking.errors_of_solution(cells), cells["cell"].map(certified).astype(float)
    # Seconds of a high-fidelity solution, which has no error: the abscissa of a line.
    solution = 1e3 * float(np.exp(np.log(cells["hf_s"]).mean()))
    times = solution * (cells["online_s"] / cells["hf_s"]).astype(float)
    panels = []
    for values, label_of_axis in ((errors, "larger mean error of u and λ"), (bounds, "certified error, in energy")):
        # Both coordinates are missing if one of them is, or is not positive.
        there = np.isfinite(times) & (times > 0.0) & np.isfinite(values) & (values > 0.0)
        if there.any():
            # Four digits are more than a screen shows.
            ends = {end: [short(value, 4) for value in of.where(there)] for end, of in (("x", times), ("y", values))}
            axes = {"x_label": "time of a query [ms]", "y_label": label_of_axis, "line": short(solution, 4)}
            panels.append(axes | ends)
    if not panels:
        return None
    ways = [Series(primal, way=way) for primal, way in zip(cells["primal"], cells["way"], strict=True)]
    looks, places, duals = Looks(ways), list(dict.fromkeys(ways)), list(dict.fromkeys(cells["dual"]))
    colours = dict(zip(cells["cell"], (looks[way].colour for way in ways), strict=True))
    drawn = {
        "series": [_series(way, looks[way]) for way in places],
        "rows": [rows[cell] for cell in cells["cell"]],
        "of": [places.index(way) for way in ways],
        # Opacity distinguishes the dual strategies.
        "fills": [(0.85, 0.0, 0.4)[duals.index(dual) % 3] for dual in cells["dual"]],
        "panels": panels,
        "costs": _costs(cells, errors, paired, rows, colours),
    }
    return Plot(f"{name}-overview", printable(f"{data.problem}: which model, for how many queries"), drawn)


def _costs(
    cells: pd.DataFrame, errors: pd.Series, paired: PairedTiming, rows: Mapping[str, int], colours: Mapping[str, str]
) -> dict[str, Any]:
    """Total costs over the number of queries with their 95 % bands, of the high-fidelity model and of the cheapest."""
    numbers = np.logspace(0.0, 6.0, 61)
    every = {one.key: one for one in ranking.candidates(cells, paired)}
    winners: dict[str | None, None] = {None: None}
    for level in ranking.reached_errors(errors):
        allowed = [every[None], *(every[cell] for cell in cells["cell"][errors <= level * (1.0 + 1e-12)])]
        totals = np.array([one.offline + numbers * one.online for one in allowed])
        winners |= dict.fromkeys(allowed[k].key for k in dict.fromkeys(totals.argmin(axis=0)))
    curves = []
    # The high-fidelity model and at most six others, each the cheapest at some error for some number of queries.
    for key in list(winners)[:7]:
        one = every[key]
        drawn = one.offline_draws[:, None] + one.online_draws[:, None] * numbers
        low, high = np.quantile(drawn, (TAIL, 1.0 - TAIL), axis=0)
        name = HIGH_FIDELITY if key is None else label(one.row["primal"], one.row["primal_tol"], str(one.row["way"]))
        drawn_as = {"colour": "#000000" if key is None else colours[key], "dashed": key is None}
        bounds = {"y": one.offline + numbers * one.online, "low": low, "high": high}
        ordinates = {side: [short(value, 4) for value in values] for side, values in bounds.items()}
        curves.append({"name": printable(name), "row": None if key is None else rows[key]} | drawn_as | ordinates)
    return {"x": [short(value, 4) for value in numbers], "curves": curves}


def _series(way: Series, look: Look) -> dict[str, Any]:
    """Name and look of a series; those with the same colour and marker differ in the width of the edge."""
    # Markers of BokehJS for those of Matplotlib.
    markers = {
        "o": "circle", "s": "square", "^": "triangle", "v": "inverted_triangle", "D": "diamond", "P": "plus",
        "X": "square_x", "*": "star", "d": "diamond_dot", "p": "hex_dot", "h": "hex",
    }  # fmt: skip
    name = printable(label(way.name, None, way.way))
    return {"name": name, "colour": look.colour, "marker": markers[look.marker], "edge": 1.0 + 1.4 * look.rank}


@dataclass(frozen=True)
class FigureImage:
    """The picture of a figure."""

    name: str
    caption: str
    alternative: str  # text for readers who do not see it
    source: str  # data URI
    width: int  # pixels
    height: int


def image_of(name: str, figure: Figure) -> FigureImage:
    # Sharp enough at the width of a page, and a tenth of the bytes of a vector picture of many lines.
    figure.set_dpi(110)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    whole, stream = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"), io.BytesIO()
    # Line drawings need fewer than 256 colours.
    dots = whole.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).convert("RGB")
    # A third of the time of more thorough compression, for a quarter more bytes.
    dots.save(stream, "webp", lossless=True, method=1, quality=0)
    source = "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
    caption = caption_of(figure)
    return FigureImage(name, caption, first_sentence(caption), source, *dots.size)


def script_safe(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def short(value: Any, digits: int) -> float | int | str | None:
    """A number with some significant digits; an infinite one is a text, since JSON has none."""
    if pd.isna(value):
        return None
    number = float(value)
    if math.isinf(number):
        return str(number)
    rounded = float(f"{number:.{digits}g}")
    # The page rounds once more: what some digits leave halfway, or whole, would end apart from what other tables print.
    if cell_text(rounded) != cell_text(number):
        return number
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e15 else rounded
