"""High-fidelity solutions and their multipliers (paper, Figures 4 and 10)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from vibench.arrays import Array
from vibench.report.figures.data import Data
from vibench.report.figures.style import COLOURS, Layout, Sheet

MAP = "cividis"
"""A colour map of evenly rising lightness, legible in grey print and to colour-blind readers."""


def solutions(data: Data) -> Figure | None:
    """High-fidelity solution above and multiplier below, at some training parameters."""
    shown = [(one.title, one.picture) for one in data.pictures if one.picture is not None]
    if not shown:
        return None
    layout = Layout(width=3.3, height=2.9, right=1.0)  # right: room for a colour bar
    sheet = Sheet(2, len(shown), f"{data.problem}: high-fidelity solutions", layout)
    for column, (title, picture) in enumerate(shown):
        field, multiplier = sheet.at(0, column), sheet.at(1, column)
        field.set_title(title)
        if len(picture.points) == 1:
            _graph(field, picture.points[0], picture.values, picture.name, 0, "default")
        else:
            mesh = Triangulation(picture.points[0], picture.points[1], picture.triangles.T)
            colours = field.tripcolor(mesh, picture.values, shading="gouraud", cmap=MAP, rasterized=True)
            field.grid(visible=False)
            _plane(field, colours, picture.name)
        if len(picture.positions) == 1:
            _graph(multiplier, picture.positions[0], picture.multiplier, picture.multiplier_name, 1, "steps-mid")
        else:
            size = float(np.clip(3000.0 / max(len(picture.multiplier), 1), 4.0, 40.0))
            x, y = picture.positions
            points = multiplier.scatter(x, y, c=picture.multiplier, s=size, cmap=MAP, rasterized=True)
            _plane(multiplier, points, picture.multiplier_name)
    return sheet.finish()


def _graph(axes: Axes, x: Array, values: Array, name: str, k: int, drawstyle: str) -> None:
    order = np.argsort(x)
    axes.plot(x[order], values[order], color=COLOURS[k], drawstyle=drawstyle)
    axes.set(xlabel="x", ylabel=name)


def _plane(axes: Axes, colours: ScalarMappable, name: str) -> None:
    """Axes of the plane, and a colour bar in the room right of the panel."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x", ylabel="y")
    axes.figure.colorbar(colours, cax=axes.inset_axes((1.03, 0.0, 0.04, 1.0)), label=name)
