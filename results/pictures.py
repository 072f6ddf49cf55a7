"""Draw high-fidelity solutions of a problem: the paper's Figures 4 and 10; used by make.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench import plugins
from vibench.figures import STYLE
from vibench.highfidelity import Solver
from vibench.problem import Picture


def draw(name: str, mus: Sequence[Sequence[float]], folder: Path) -> None:
    """Draw the solutions of a registered problem, with its default options, at some parameters."""
    problem = plugins.create("problem", name, {})
    solver = Solver(problem)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.0 * len(mus), 7.2), layout="constrained")
        axes = figure.subplots(2, len(mus), squeeze=False)
        for column, mu in enumerate(map(np.array, mus)):
            found = solver.solve(mu)
            picture = problem.picture(mu, found.u, found.lam)
            draw_field(axes[0, column], picture)
            draw_multiplier(axes[1, column], picture)
            title = ", ".join(f"{value:g}" for value in mu)
            axes[0, column].set_title(f"µ = ({title})")
        figure.savefig(folder / f"{name}-solutions.png")


def draw_field(axes: Axes, picture: Picture) -> None:
    """The mesh in the configuration of the picture, coloured by its nodal values."""
    colours = axes.tripcolor(*picture.points, picture.triangles.T, picture.values, shading="gouraud", cmap="cividis")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.grid(visible=False)
    axes.figure.colorbar(colours, ax=axes, label=picture.name, shrink=0.8)


def draw_multiplier(axes: Axes, picture: Picture) -> None:
    """The multiplier over its line, or as coloured points in the plane."""
    if len(picture.positions) == 1:
        axes.plot(picture.positions[0], picture.multiplier, drawstyle="steps-mid")
        axes.set(xlabel="x [m]", ylabel=picture.multiplier_name)
        return
    points = axes.scatter(*picture.positions, c=picture.multiplier, s=6, cmap="cividis")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.figure.colorbar(points, ax=axes, label=picture.multiplier_name, shrink=0.8)
