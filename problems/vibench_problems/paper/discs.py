"""Twins of Figures 9 and 10: the configuration of the Hertz problem, its deformation and its contact pressures."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from vibench import Array, HighFidelitySolver, ProblemTables, create
from vibench.report import CaptionedFigure, Layout, Sheet, draw_field, name_axes
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import LineContact, measured, theory
from vibench_problems.paper.curves import compared, span
from vibench_problems.paper.published import DEFORMED, NODES, RADII

MAP = "cividis"
ROUND_OFF = 1e-12
"""Penetration [m] that is round-off."""

INNER = 0.8
"""Share of the half-width within which the pressure is compared with the ellipse: it jumps at the end."""


def configuration(tables: ProblemTables) -> CaptionedFigure:
    """Figure 9: the two quarter discs before they touch, with their meshes, boundaries and potential contact zones."""
    problem: Hertz = create("problem", "hertz", tables.problem_options)
    mu = np.array([1.0])
    sheet = Sheet(1, 1, "Figure 9: configuration, §5.2, Hertz contact", Layout(width=3.6, height=5.2))
    (panel,) = sheet.panels
    discs = ((problem.slave, "Ω₁", 0.5), (problem.master, "Ω₂(µ)", -0.5))
    for points, (disc, name, height) in zip(problem.points(mu), discs, strict=True):
        panel.triplot(points[0], points[1], disc.mesh.t.T, color="0.8", linewidth=0.3)
        for nodes, colour, boundary in ((disc.axis, "#0072B2", "left"), (disc.flat, "#009E73", "moved flat")):
            ordered = nodes[np.lexsort(points[:, nodes])]
            panel.plot(*points[:, ordered], color=colour, linewidth=2.0, label=f"Γ {boundary}")
        panel.plot(*points[:, disc.zone], color="#D55E00", linewidth=2.0, label="Γ_c, potential contact")
        panel.text(0.3, height, name, fontsize=11, ha="center")
    panel.annotate(f"γ₀ = {problem.gap:g} m", (0.0, 0.0), (0.62, 0.03), fontsize=8, arrowprops={"arrowstyle": "->"})
    panel.text(0.5, 1.03, "R₁ = 1 m, moves by −d", fontsize=8, ha="center")
    panel.text(0.5, -1.04, "R₂ = µ, moves by d", fontsize=8, ha="center", va="top")
    panel.set_aspect("equal")
    panel.grid(visible=False)
    panel.set(xlabel="x [m]", ylabel="y [m]", ylim=(-1.15, 1.15))
    slaves = len(problem.slave.zone)
    figure = sheet.finish(
        f"The two quarter discs of the Hertz problem at µ = {mu[0]:g} m before they touch, with their meshes of "
        f"{problem.nodes} nodes: the gap γ₀ on the axis of symmetry, the flats that are moved by d towards each other, "
        "and the potential contact zones."
    )
    figure.published = (
        f"R₁ = 1 m, R₂ = µ, γ₀ = 0.001 m, d = 0.09 m; {NODES['hertz']} nodes, 560 on the potential contact zone, 280 "
        "multipliers."
    )
    d = problem.approach(mu)
    figure.compared = compared(
        (bool(np.isclose(problem.gap, 0.001) and np.isclose(d, 0.09)), f"γ₀ = {problem.gap:g} m, d = {d:g} m"),
        (abs(problem.nodes - NODES["hertz"]) <= 0.02 * NODES["hertz"], f"{problem.nodes} nodes"),
        (abs(slaves - 560) <= 12, f"{slaves} nodes on the potential contact zone"),
        (problem.W.dim == 280, f"{problem.W.dim} multipliers"),
        (None, "the extent of the potential contact zones, here 30° on disc 1"),
    )
    return figure


def solution(tables: ProblemTables) -> CaptionedFigure:
    """Figure 10: deformed discs for µ = 0.9 m, and the contact pressure for five radii with Hertz's ellipses."""
    problem: Hertz = create("problem", "hertz", tables.problem_options)
    solver = HighFidelitySolver(problem)
    sheet = Sheet(1, 2, "Figure 10: solution, §5.2, Hertz contact", Layout(width=3.6, height=4.0, right=0.95))
    left, right = sheet.panels
    mu = np.array([DEFORMED])
    found = solver.solve(mu)
    picture = problem.picture(mu, found.u, found.lam)
    draw_field(left, picture, (float(picture.values.min()), float(picture.values.max())))
    name_axes(left, "m", [picture.points])
    left.set_title(f"deformed discs, µ = {DEFORMED:g} m")
    contacts, oscillations = [], []
    for radius, shade in zip(RADII, np.linspace(0.0, 0.85, len(RADII)), strict=True):
        one = solver.solve(np.array([radius]))
        exact = theory(problem, np.array([radius]), one.u)
        x = problem.points(np.array([radius]))[0][0, problem.slave.zone[1::2]]
        right.plot(x, one.lam, color=colormaps[MAP](shade), drawstyle="steps-mid", label=f"λ(µ), µ = {radius:g} m")
        _ellipse(right, exact)
        fit = measured(problem, np.array([radius]), one.lam)
        contacts.append((fit, exact))
        inner = x < INNER * fit.half_width
        oscillations.append(np.abs(one.lam[inner] - _pressure(fit, x[inner])).max() / fit.peak)
    right.set(xlabel="x [m]", ylabel="contact pressure λ [Pa]", title="contact pressure", xlim=(0.0, None))
    return _compared(sheet.finish(_caption()), problem, found.u, mu, contacts, max(oscillations))


def _caption() -> str:
    radii = ", ".join(f"{radius:g}" for radius in RADII)
    return (
        f"Left: the deformed discs of the Hertz problem for µ = {DEFORMED:g} m, coloured by the vertical displacement. "
        f"Right: the contact pressure λ(µ) over the abscissa for µ = {radii} m, and for each the ellipse of Hertz's "
        "theory of line contact at the computed load (dashed)."
    )


def _compared(
    figure: CaptionedFigure,
    problem: Hertz,
    u: Array,
    mu: Array,
    contacts: list[tuple[LineContact, LineContact]],
    oscillation: float,
) -> CaptionedFigure:
    B, g = problem.constraint(mu)
    penetration = max(float(((B @ u - g) / problem.macro_lengths).max()), 0.0)
    widths, peaks = zip(*(fit.differences(exact) for fit, exact in contacts), strict=True)
    figure.published = (
        f"Left: µ = {DEFORMED:g} m, the discs do not penetrate. Right: µ = {', '.join(f'{r:g}' for r in RADII)} m, "
        "small oscillations of the pressure, due to the direct projection of the integration points."
    )
    half, peak = ([getattr(fit, name) for fit, _ in contacts] for name in ("half_width", "peak"))
    figure.compared = compared(
        (
            penetration <= ROUND_OFF,
            "the discs do not penetrate"
            if penetration <= ROUND_OFF
            else f"the discs penetrate by {penetration:.1g} m in the mean over a macro-edge",
        ),
        (
            oscillation > 0.01,
            f"the pressure oscillates by {100 * oscillation:.2g} % of its peak, with "
            + ("exact quadrature" if problem.quadrature == "exact" else f"{problem.quadrature} points per edge"),
        ),
        (
            None,
            f"values; here the half-width is {span(half)} m and the peak {span(peak)} Pa, from Hertz's theory by "
            f"{_percent(widths)} and {_percent(peaks)}",
        ),
    )
    return figure


def _percent(differences: tuple[float, ...]) -> str:
    low, high = 100 * min(differences), 100 * max(differences)
    return f"{low:+.2f} to {high:+.2f} %".replace("-", "−")


def _pressure(contact: LineContact, x: Array) -> Array:
    inside = np.clip(1.0 - (x / contact.half_width) ** 2, 0.0, None)
    return np.asarray(contact.peak * np.sqrt(inside))


def _ellipse(axes: Axes, contact: LineContact) -> None:
    x = contact.half_width * np.sin(np.linspace(0.0, 0.5 * np.pi, 80))  # dense where the ellipse is steep
    axes.plot(x, _pressure(contact, x), color="black", linewidth=0.8, linestyle="--", label="Hertz's theory")
