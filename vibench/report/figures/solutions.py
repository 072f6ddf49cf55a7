"""High-fidelity solutions and their multipliers (paper, Figures 4 and 10)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.tri import Triangulation

from vibench.arrays import Array
from vibench.interfaces.outputs import Picture
from vibench.report.figures.data import ProblemTables
from vibench.report.figures.style import COLOURS, CaptionedFigure, Layout, Sheet
from vibench.results.pictures import Shown
from vibench.signatures import Rule

Limits = tuple[float, float]


def solutions(data: ProblemTables) -> CaptionedFigure | None:
    """High-fidelity solution above and multiplier below, at some training parameters; one range of values for all."""
    shown = [(one.title, one.picture) for one in data.pictures if one.picture is not None][:3]
    return draw_solutions(f"{data.problem}: high-fidelity solutions", shown) if shown else None


def draw_solutions(title: str, shown: Sequence[tuple[str, Picture]]) -> CaptionedFigure:
    """A column for each of some titled pictures of one problem: the solution above, the multiplier below."""
    pictures = [picture for _, picture in shown]
    sheet = Sheet(2, len(shown), title, Layout(2.7, 2.4, "last"))
    ranges = (_range([one.values for one in pictures]), _range([one.multiplier for one in pictures]))
    ends = [f"{low:.3g} to {high:.3g}" for low, high in ranges]
    for column, (heading, picture) in enumerate(shown):
        field, multiplier = sheet.panel(0, column), sheet.panel(1, column)
        field.set_title(heading, fontsize=8)
        last = column == len(shown) - 1
        draw_field(field, picture, ranges[0], bar=last)
        draw_multiplier(multiplier, picture, ranges[1], bar=last)
    for row, places in enumerate(([one.points for one in pictures], [one.positions for one in pictures])):
        for panel in (sheet.panel(row, column) for column in range(len(shown))):
            name_axes(panel, pictures[0].length_unit, places)
    first, parameters = pictures[0], "; ".join(heading for heading, _ in shown)
    return sheet.finish(
        f"High-fidelity solutions ({title.partition(':')[0]}) at {parameters}: {first.name} above, from "
        f"{ends[0]}; {first.multiplier_name} below, from {ends[1]}. Colours and axes of values have "
        "the same range at all parameters. The orange line is the boundary of the contact, where the multiplier "
        "becomes zero."
    )


def draw_alone(axes: Axes, shown: Shown) -> str:
    """Draw the recorded solution of one parameter in a panel; returns what the panel shows, a sentence."""
    picture = shown.picture
    assert picture is not None
    draw_field(axes, picture, _range([picture.values]))
    name_axes(axes, picture.length_unit, [picture.points])
    axes.set_title(shown.title, fontsize=8)
    return f"Upper left, {picture.name} of the full model at {shown.title}; orange is the boundary of the contact."


def draw_field(axes: Axes, picture: Picture, limits: Limits, *, bar: bool = True) -> None:
    """The solution on its mesh: a filled field in the plane, a graph on a line."""
    if len(picture.points) == 1:
        axes.set(ylabel=picture.name)
        _graph(axes, picture, picture.points[0], picture.values, limits, COLOURS[0], "default")
        return
    mesh = Triangulation(picture.points[0], picture.points[1], picture.triangles.T)
    filled = axes.tripcolor(mesh, picture.values, shading="gouraud", **_colours(limits))
    _contact_boundary(axes, picture)
    _plane(axes, filled, picture.name if bar else "")


def draw_multiplier(axes: Axes, picture: Picture, limits: Limits, *, bar: bool = True) -> None:
    """The multiplier: a filled field where its points are nodes of the mesh, else points; on a line a graph."""
    if len(picture.positions) == 1:
        axes.set(ylabel=picture.multiplier_name)
        _graph(axes, picture, picture.positions[0], picture.multiplier, limits, COLOURS[2], "steps-mid")
        return
    part = _on_mesh(picture)
    filled: ScalarMappable
    if part is not None:
        filled = axes.tripcolor(part, picture.multiplier, shading="gouraud", **_colours(limits))
        _contact_boundary(axes, picture)
    else:
        size = float(np.clip(3000.0 / max(len(picture.multiplier), 1), 4.0, 40.0))
        x, y = picture.positions
        filled = axes.scatter(x, y, c=picture.multiplier, s=size, **_colours(limits))
    _plane(axes, filled, picture.multiplier_name if bar else "")


def name_axes(axes: Axes, unit: str, places: Annotated[Sequence[Array], Rule("at least one array", len)]) -> None:
    """Name the axes of space, with the same limits wherever the points of these pictures are drawn."""
    points = np.hstack(places)
    ends = np.array([points.min(axis=1), points.max(axis=1)]) if points.size else np.zeros((2, len(points)))
    room = 0.04 * float((ends[1] - ends[0]).max()) or 0.5
    for name, low, high in zip("xy", *ends, strict=False):
        axes.set(**{f"{name}label": f"{name}{f' [{unit}]' * bool(unit)}", f"{name}lim": (low - room, high + room)})


def _range(values: Sequence[Array]) -> Limits:
    """One range for several fields; that of a constant field is not empty."""
    everything = np.concatenate([one[np.isfinite(one)] for one in values])
    low, high = (float(everything.min()), float(everything.max())) if everything.size else (0.0, 1.0)
    return low, high if high > low else low + max(abs(low), 1.0)


def _colours(limits: Limits) -> dict[str, Any]:
    # This map has evenly rising lightness: it is legible in grey print and to colour-blind readers.
    return {"vmin": limits[0], "vmax": limits[1], "cmap": "cividis", "rasterized": True}


def _on_mesh(picture: Picture) -> Triangulation | None:
    """The triangles between points of the multiplier, if each of these is a node of the mesh."""
    if len(picture.points) != 2 or not len(picture.multiplier):
        return None
    places = {tuple(point): k for k, point in enumerate(picture.points.T)}
    nodes = [places.get(tuple(point)) for point in picture.positions.T]
    if None in nodes or len(set(nodes)) < len(nodes):
        return None
    numbers = np.full(picture.points.shape[1], -1)
    numbers[np.array(nodes, dtype=int)] = np.arange(len(nodes))
    triangles = numbers[picture.triangles]
    inside = np.all(triangles >= 0, axis=0)
    x, y = picture.positions
    return Triangulation(x, y, triangles[:, inside].T) if inside.any() else None


def _contact_boundary(axes: Axes, picture: Picture) -> None:
    part = _on_mesh(picture) if len(picture.positions) == 2 else None
    touching = (picture.multiplier > 0.0).astype(float)
    if part is not None and 0.0 < touching.mean() < 1.0:
        axes.tricontour(part, touching, levels=[0.5], colors="#D55E00", linewidths=1.0)


def _graph(axes: Axes, picture: Picture, x: Array, values: Array, limits: Limits, colour: str, drawstyle: str) -> None:
    """A graph with lines where intervals of contact end, but for those that end at the last point of the multiplier."""
    order, room = np.argsort(x), 0.05 * (limits[1] - limits[0])
    axes.plot(x[order], values[order], color=colour, drawstyle=drawstyle)
    axes.set(xlabel="x", ylim=(limits[0] - room, limits[1] + room))
    if len(picture.positions) == 1:
        order = np.argsort(picture.positions[0])
        places, touching = picture.positions[0][order], picture.multiplier[order] > 0.0
        for k in np.flatnonzero(touching[1:] != touching[:-1]):
            axes.axvline(0.5 * (places[k] + places[k + 1]), color="#D55E00", linewidth=1.0, linestyle=(0, (1, 1)))


def _plane(axes: Axes, colours: ScalarMappable, name: str) -> None:
    """Axes of the plane, and a colour bar in the room right of the panel if it has a name."""
    axes.set_aspect("equal", adjustable="box")
    axes.grid(visible=False)
    axes.set(xlabel="x", ylabel="y")
    if name:
        bar = axes.figure.colorbar(colours, cax=axes.inset_axes((1.03, 0.0, 0.04, 1.0)), label=name)
        bar.outline.set_edgecolor("black")
