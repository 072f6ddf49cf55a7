"""High-fidelity solutions and their multipliers (paper, Figures 4 and 10)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from vibench.interfaces.problem import Picture
from vibench.report.figures.data import Data
from vibench.report.figures.style import Layout, Sheet, line

MAP = "cividis"
"""A colour map whose lightness rises evenly: it survives grey print and colour blindness."""

WIDE = Layout(width=3.3, height=2.9, right=1.0)
"""Room for a colour bar."""


def solutions(data: Data) -> Figure | None:
    """The field above, the multiplier below, at some training parameters."""
    shown = [(one.title, one.picture) for one in data.pictures if one.picture is not None]
    if not shown:
        return None
    sheet = Sheet(2, len(shown), f"{data.problem}: high-fidelity solutions", WIDE)
    for column, (title, picture) in enumerate(shown):
        _field(sheet.at(0, column), picture)
        _multiplier(sheet.at(1, column), picture)
        sheet.at(0, column).set_title(title)
    return sheet.finish()


def _field(axes: Axes, picture: Picture) -> None:
    """The mesh in the configuration of the picture, coloured by its nodal values; a line where it is an interval."""
    if len(picture.points) == 1:
        order = np.argsort(picture.points[0])
        axes.plot(picture.points[0][order], picture.values[order], color=line(0)["color"])
        axes.set(xlabel="x", ylabel=picture.name)
        return
    mesh = Triangulation(picture.points[0], picture.points[1], picture.triangles.T)
    colours = axes.tripcolor(mesh, picture.values, shading="gouraud", cmap=MAP, rasterized=True)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x", ylabel="y")
    axes.grid(visible=False)
    _bar(axes, colours, picture.name)


def _multiplier(axes: Axes, picture: Picture) -> None:
    """The multiplier over its line, or as coloured points in the plane."""
    if len(picture.positions) == 1:
        order = np.argsort(picture.positions[0])
        axes.plot(picture.positions[0][order], picture.multiplier[order], drawstyle="steps-mid", color=line(1)["color"])
        axes.set(xlabel="x", ylabel=picture.multiplier_name)
        return
    x, y = picture.positions
    size = float(np.clip(3000.0 / max(len(x), 1), 4.0, 40.0))
    points = axes.scatter(x, y, c=picture.multiplier, s=size, cmap=MAP, rasterized=True)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x", ylabel="y")
    _bar(axes, points, picture.multiplier_name)


def _bar(axes: Axes, colours: ScalarMappable, name: str) -> None:
    """A colour bar in the room right of a panel."""
    inside = axes.inset_axes((1.03, 0.0, 0.04, 1.0))
    axes.figure.colorbar(colours, cax=inside, label=name)
