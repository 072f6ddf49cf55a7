"""Plots of the report to work with, and its pictures with a text that says what they show."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
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
from vibench.results.paired_timing import PairedTiming
from vibench.text import printable

with foreign("matplotlib"):
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
    data: dict[str, Any]  # series, points with their rows in the table of cells, panels with coordinates or null


def overview(
    name: str, data: ProblemTables, rows: Mapping[str, int], paired: PairedTiming, certified: pd.Series
) -> Iterator[Plot]:
    """Errors, and certified ones, of all models against the seconds of a query, and total costs over the queries.

    The name begins with that of the problem; `rows` has the row of every cell in the table of cells.
    """
    cells = data.cells[ranking.eligible(data.cells) & data.cells["online_s"].notna()]
    if cells.empty:
        return
    errors = ranking.errors_of_solution(cells)
    solution, bounds = 1e3 * float(np.exp(np.log(cells["hf_s"]).mean())), cells["cell"].map(certified).astype(float)
    relative = cells["online_s"] / cells["hf_s"]
    shown = cells.assign(online_ms=solution * relative, error=errors, certified=bounds)
    columns = {"error": "larger mean error of u and λ", "certified": "certified error, in energy"}
    title = f"{data.problem}: which model, for how many queries"
    for plot in _plot(f"{name}-overview", title, shown, columns, rows, short(solution, 4)):
        colours = [plot.data["series"][k]["colour"] for k in plot.data["of"]]
        costs = _costs(cells, errors, paired, rows, dict(zip(cells["cell"], colours, strict=True)))
        yield replace(plot, data=plot.data | {"costs": costs})


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


def _plot(
    name: str, title: str, cells: pd.DataFrame, columns: Mapping[str, str], rows: Mapping[str, int], line: Any = None
) -> Iterator[Plot]:
    """Columns of cells, with their labels, against the time of a query; no plot if no cell has a point in it.

    The line is the abscissa of the high-fidelity model, which has no error.
    """
    drawn: dict[str, pd.DataFrame] = {}
    for column in columns:
        values = cells[["online_ms", column]].astype(float)
        # Both values are missing if one of them is, or is not positive.
        points = values.where(np.isfinite(values).all(axis=1) & (values > 0.0).all(axis=1))
        if points.notna().to_numpy().any():
            drawn[column] = points
    if not drawn:
        return
    ways = [Series(name, way=way) for name, way in zip(cells["primal"], cells["way"], strict=True)]
    looks, places, duals = Looks(ways), list(dict.fromkeys(ways)), list(dict.fromkeys(cells["dual"]))
    data = {
        "series": [_series(way, looks[way]) for way in places],
        "rows": [rows[cell] for cell in cells["cell"]],
        "of": [places.index(way) for way in ways],
        # Opacity distinguishes the dual strategies.
        "fills": [(0.85, 0.0, 0.4)[duals.index(dual) % 3] for dual in cells["dual"]],
        "panels": [
            {"x_label": "time of a query [ms]", "y_label": columns[column], "line": line}
            # Four digits are more than a screen shows.
            | {end: [short(value, 4) for value in points[of]] for end, of in (("x", "online_ms"), ("y", column))}
            for column, points in drawn.items()
        ],
    }
    yield Plot(name, printable(title), data)


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
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e15 else rounded
