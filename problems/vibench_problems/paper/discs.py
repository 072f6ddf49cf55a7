"""Figures 9 and 10, configuration, deformation and pressures of Hertz contact; claims about its data in §5.2."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from vibench import Array, HighFidelitySolution, HighFidelitySolver
from vibench.report import CaptionedFigure, Layout, Sheet, draw_field, name_axes
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import LineContact, measured, theory
from vibench_problems.paper.claims import MESH, ORDER, Claim, holds, judged_figure, number, span, text, unknown
from vibench_problems.paper.evidence import Evidence
from vibench_problems.paper.published import DEFORMED, RADII

MAP = "cividis"

INNER = 0.8
"""Share of the half-width within which the pressure is compared with the ellipse: it jumps at the end."""

NO_PENETRATION = 1e-9
"""Penetration that is round-off, relative to the half-width of the contact."""


def data(evidence: Evidence) -> Iterator[Claim]:
    """Material, parameters, and what Figure 9 shows: geometry and mesh."""
    problem: Hertz = evidence.problem
    training, section = problem.training_set(), "Hertz, §5.2"
    (upper, small), (same, large) = (problem.points(np.array([mu])) for mu in (0.7, 1.3))
    radii = (float(small[0].max()), float(large[0].max()))
    yield number("Hertz, (43)", "range of the radius R₂ = µ [m]", (0.7, 1.3), radii, given=True)
    yield holds(section, "h(µ) does not depend on µ on Ω̂₁", "equal nodes", np.array_equal(upper, same), given=True)
    yield from configuration_claims(evidence)
    d = problem.approach(np.array([0.7]))
    yield holds(section, "d ≥ γ₀ / 2", f"{d:g} ≥ {problem.gap / 2:g}", d >= problem.gap / 2.0, given=True)
    share = d / max(1.0, float(problem.parameters.lower[0]))
    yield holds(section, "d below 10 % of max(R₁, R₂)", f"at most {100 * share:.3g} %", share < 0.1, given=True)
    yield from contact_claims(problem)
    yield number(section, "E [Pa], ν", (15, 0.35), (problem.young, problem.poisson), given=True)
    steps = (len(training), float(training[1, 0] - training[0, 0]))
    yield number(section, "training points, step [m]", (81, 0.0075), steps, given=True)
    yield number(
        section,
        "validation points, uniform random",
        30,
        int(evidence.cells["queries"].max()),
        why="The sample is another one; that of the paper is not published.",
        given=True,
    )
    why = "The paper counts all components, 2 · 6130; here those that are fixed are left out."
    yield number(section, "primal degrees of freedom", 12260, problem.V.dim, within=MESH, why=why, given=True)
    yield unknown("Hertz, (44)", "characteristic length ℓ̂", "not given", "1 m", "The constants and σ depend on it.")
    yield unknown("Hertz, (48)", "load ℓ(µ)", "not given", "0", "The flats are moved by a lifting without stress.")


def contact_claims(problem: Hertz) -> Iterator[Claim]:
    """Signs of b, and g."""
    (B, g), (_, other) = (problem.constraint(np.array([mu])) for mu in (0.7, 1.3))
    upward = float(B[:, np.searchsorted(problem.free, 2 * problem.slave.zone + 1)].sum())
    yield holds(
        "Hertz, (49), (51)",
        "sign of v₁·e_y in b",
        "positive" if upward > 0.0 else "negative",
        upward > 0.0,
        paper="positive",
        cause="With n = e_y and the signs as printed, the imposed displacements pull the discs apart.",
    )
    change = float(np.linalg.norm(g - other) / np.linalg.norm(other))
    yield holds(
        "Hertz, (52)",
        "g does not depend on µ",
        f"changes by {100 * change:.0f} % from µ = 0.7 to 1.3",
        change <= 1e-12,
        paper="constant",
        cause="φ projects vertically on the disc of radius µ and depends on µ.",
    )


def configuration_claims(evidence: Evidence) -> Iterator[Claim]:
    """What Figure 9 shows: the discs, the gap, the approach and the mesh."""
    problem, section = evidence.problem, "Hertz, §5.2"
    first, second = problem.points(np.array([0.7]))
    gap = float(first[1, first[0] == 0.0].min() - second[1, second[0] == 0.0].max())
    yield number(
        f"{section}, Fig. 9", "radius R₁ [m]", 1, float(first[0].max()), why="Quarter-disks are meshed.", given=True
    )
    yield number(section, "initial gap γ₀ [m]", 0.001, round(gap, 12), given=True)
    yield number(section, "imposed displacement d [m]", 0.09, problem.approach(np.array([0.7])), given=True)
    cause = "The mesh of the run, or its master surface, is finer or coarser."
    yield number(section, "nodes", evidence.paper.nodes, problem.nodes, within=MESH, cause=cause, given=True)
    zone = len(problem.slave.zone)
    yield number(section, "nodes on the potential contact manifold", 560, zone, within=MESH, given=True)
    why = "Macro-edges of two slave edges (LAC)."
    yield number(section, "dual degrees of freedom", 280, problem.W.dim, why=why, given=True)
    yield unknown(
        section, "extent of the potential contact zones", "not given", "30° on disc 1", "It limits the contact."
    )


def configuration(evidence: Evidence) -> CaptionedFigure:
    """Figure 9: the two quarter discs before they touch, with their meshes, boundaries and potential contact zones."""
    problem, mu = evidence.problem, np.array([1.0])
    sheet = Sheet(1, 1, "Figure 9: configuration, §5.2, Hertz contact", Layout(3.6, 5.2))
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
    caption = (
        f"The two quarter discs of the Hertz problem at µ = {mu[0]:g} m before they touch, with their meshes of "
        f"{problem.nodes} nodes: the gap γ₀ on the axis of symmetry, the flats that are moved by d towards each other, "
        "and the potential contact zones."
    )
    return judged_figure(sheet, caption, configuration_claims(evidence))


@dataclass(frozen=True)
class Pressed:
    """The contact at one radius, and how far it is from an ellipse.

    Attributes
    ----------
    x
        Abscissae [m] of the multipliers (m,).
    solution
        The high-fidelity solution.
    fit, theory
        The elliptic pressure fitted to λ, and that of Hertz's theory at the computed load.
    oscillation
        Largest distance of λ from the fitted ellipse within 0.8 of its half-width, relative to its peak.
    penetration
        Largest (B u − g)₊ over the macro length, relative to the half-width.
    """

    x: Array
    solution: HighFidelitySolution
    fit: LineContact
    theory: LineContact
    oscillation: float
    penetration: float

    @classmethod
    def at(cls, problem: Hertz, solver: HighFidelitySolver, mu: Array) -> Pressed:
        """Solve and measure."""
        solved = solver.solve(mu)
        fit, exact = measured(problem, mu, solved.lam), theory(problem, mu, solved.u)
        x = problem.points(mu)[0][0, problem.slave.zone[1::2]]
        inner = x < INNER * fit.half_width
        B, g = problem.constraint(mu)
        gap = float(((B @ solved.u - g) / problem.macro_lengths).max())
        noise = float(np.abs(solved.lam[inner] - _pressure(fit, x[inner])).max()) / fit.peak
        return cls(x, solved, fit, exact, noise, max(gap, 0.0) / fit.half_width)


def pressed(problem: Hertz) -> list[Pressed]:
    """The contact at the radii of Figure 10: those on the right, then that on the left."""
    solver = HighFidelitySolver(problem)
    return [Pressed.at(problem, solver, np.array([radius])) for radius in (*RADII, DEFORMED)]


def solution_claims(evidence: Evidence, contacts: Sequence[Pressed]) -> Iterator[Claim]:
    """Figure 10: penetration, and oscillations of the pressure where integration points are projected directly."""
    shown = contacts[: len(RADII)]
    widths, peaks = zip(*(one.fit.differences(one.theory) for one in shown), strict=True)
    yield unknown(
        "Fig. 10 right",
        f"λ for µ = {text(RADII)} m",
        "in the figure only",
        f"half-width {text([one.fit.half_width for one in shown])} m, peak {text([one.fit.peak for one in shown])} Pa",
        f"Against the theory of line contact: half-width {span(100 * x for x in widths)} %, peak "
        f"{span(100 * x for x in peaks)} %; see `results/hertz-theory`.",
    )
    deepest = max(one.penetration for one in contacts)
    yield holds(
        "Fig. 10 left",
        "non-interpenetration holds",
        f"violated by at most {deepest:.1g} of the half-width",
        deepest <= NO_PENETRATION,
        why=f"Means over macro-edges, for µ = {DEFORMED:g} m and the radii of Fig. 10 right.",
    )
    exact = evidence.problem.quadrature == "exact"
    options: dict[str, Any] = {**evidence.tables.problem_options, "quadrature": 1 if exact else "exact"}
    own, other = (max(one.oscillation for one in pressures) for pressures in (contacts, pressed(Hertz(**options))))
    direct, none = (other, own) if exact else (own, other)
    points = "one Gauss point" if exact else f"{evidence.problem.quadrature} Gauss points"
    yield holds(
        "Fig. 10 right",
        "λ oscillates slightly where integration points are projected directly",
        f"{100 * direct:.2g} % of the peak with {points} per edge, {100 * none:.2g} % with exact quadrature",
        direct > ORDER * none,
        why=f"Largest distance from the fitted ellipse within {INNER:g} of the half-width. The run has "
        f"{'exact quadrature' if exact else points}; an order of magnitude, {ORDER:.2g}, counts.",
    )


def solution(evidence: Evidence) -> CaptionedFigure:
    """Figure 10: deformed discs for µ = 0.9 m, and the contact pressure for five radii with Hertz's ellipses."""
    problem, contacts = evidence.problem, pressed(evidence.problem)
    sheet = Sheet(1, 2, "Figure 10: solution, §5.2, Hertz contact", Layout(3.6, 4.0, "every"))
    left, right = sheet.panels
    deformed = contacts[-1].solution
    picture = problem.picture(np.array([DEFORMED]), deformed.u, deformed.lam)
    draw_field(left, picture, (float(picture.values.min()), float(picture.values.max())))
    name_axes(left, "m", [picture.points])
    left.set_title(f"deformed discs, µ = {DEFORMED:g} m")
    for radius, one, shade in zip(RADII, contacts, np.linspace(0.0, 0.85, len(RADII)), strict=False):
        name, colour = f"λ(µ), µ = {radius:g} m", colormaps[MAP](shade)
        right.plot(one.x, one.solution.lam, color=colour, drawstyle="steps-mid", label=name)
        _ellipse(right, one.theory)
    right.set(xlabel="x [m]", ylabel="contact pressure λ [Pa]", title="contact pressure", xlim=(0.0, None))
    caption = (
        f"Left: the deformed discs of the Hertz problem for µ = {DEFORMED:g} m, coloured by the vertical displacement. "
        f"Right: the contact pressure λ(µ) over the abscissa for µ = {text(RADII)} m, and for each the ellipse of "
        "Hertz's theory of line contact at the computed load (dashed)."
    )
    return judged_figure(sheet, caption, solution_claims(evidence, contacts))


def _pressure(ellipse: LineContact, x: Array) -> Array:
    inside = np.clip(1.0 - (x / ellipse.half_width) ** 2, 0.0, None)
    return np.asarray(ellipse.peak * np.sqrt(inside))


def _ellipse(axes: Axes, ellipse: LineContact) -> None:
    x = ellipse.half_width * np.sin(np.linspace(0.0, 0.5 * np.pi, 80))  # dense where the ellipse is steep
    axes.plot(x, _pressure(ellipse, x), color="black", linewidth=0.8, linestyle="--", label="Hertz's theory")
