"""Twins of Figures 3 and 4: aspect ratios of the meshes, and a solution of the obstacle problem."""

from __future__ import annotations

import numpy as np

from vibench import HighFidelitySolver, ProblemTables, create
from vibench.report import (
    CaptionedFigure,
    Layout,
    Looks,
    Series,
    Sheet,
    draw_field,
    draw_multiplier,
    name_axes,
    scatter,
)
from vibench_problems.obstacle import RADIUS, Obstacle
from vibench_problems.paper.curves import compared, span
from vibench_problems.paper.published import MEMBRANE, NODES

SETS = {"training": "D_train", "validation": "D_valid"}


def aspect_ratios(tables: ProblemTables) -> CaptionedFigure | None:
    """Figure 3: largest aspect ratio of the mesh at every parameter of the training and of the validation set."""
    found = tables.histories[tables.histories["quantity"] == "aspect_ratio"].drop_duplicates(["stage", "step"])
    if found.empty:
        return None
    sheet = Sheet(1, 1, "Figure 3: largest aspect ratio, §5.1, obstacle", Layout(width=4.2))
    (panel,) = sheet.panels
    looks, first = Looks(map(Series, SETS)), 1
    for stage, name in SETS.items():
        values = found[found["stage"] == stage].sort_values("step")["value"].to_numpy(float)
        scatter(panel, first + np.arange(len(values)), values, looks[Series(stage)], name, markersize=3)
        first += len(values)
    panel.set(xlabel="parameter, D_train then D_valid", ylabel="largest aspect ratio", ylim=(1.0, None))
    values, counts = found["value"], found["stage"].value_counts()
    figure = sheet.finish(
        f"Largest aspect ratio of a triangle (1: equilateral) of the mapped mesh at the {counts.get('training', 0)} "
        f"parameters of D_train and the {counts.get('validation', 0)} of D_valid, §5.1, obstacle."
    )
    figure.published = "For all parameters of D_train ∪ D_valid; the meshes keep satisfactory regularity properties."
    figure.compared = compared(
        (bool(values.max() < 5.0), f"the meshes stay regular, with ratios of {span(values)}"),
        (None, "numbers in the text; the definition of the ratio in Salome may be another one"),
    )
    return figure


def solution(tables: ProblemTables) -> CaptionedFigure:
    """Figure 4: high-fidelity solution and multiplier at µ = (0.18, 0.025, −0.025)."""
    problem: Obstacle = create("problem", "obstacle", tables.problem_options)
    mu = np.array(MEMBRANE)
    found = HighFidelitySolver(problem).solve(mu)
    picture = problem.picture(mu, found.u, found.lam)
    sheet = Sheet(1, 2, "Figure 4: solution, §5.1, obstacle", Layout(width=3.2, height=2.9, right=0.95))
    left, right = sheet.panels
    draw_field(left, picture, (float(picture.values.min()), float(picture.values.max())))
    draw_multiplier(right, picture, (0.0, float(picture.multiplier.max())))
    name_axes(left, "m", [picture.points])
    name_axes(right, "m", [picture.positions])
    left.set_title("u(µ)")
    right.set_title("λ(µ)")
    active = found.lam > 0.0
    distance = np.linalg.norm(picture.positions - mu[1:, None], axis=0)
    reach, radius = float(distance[active].max()), RADIUS * mu[0]
    figure = sheet.finish(
        f"High-fidelity solution of the obstacle problem at radius {radius:g} m and centre ({mu[1]:g}, −{-mu[2]:g}) m: "
        f"left, the deflection u, {span(picture.values)} m; right, the multiplier λ on the disc, {span(found.lam)} "
        "1/m. The orange line is the boundary of the contact, where λ becomes zero."
    )
    figure.published = (
        "µ = (0.18, 0.025, −0.025) m, which is outside the printed D = [0.8, 1.2] × [−0.05, 0.05]²; the constraints at "
        f"the boundary of ω(µ) are inactive; {NODES['obstacle']} nodes."
    )
    edge = np.isclose(distance, radius, rtol=1e-9)
    figure.compared = compared(
        (
            not bool(active[edge].any()) and bool(edge.any()),
            f"no constraint is active at the boundary of ω(µ): the contact reaches {reach:.3g} m from the centre, the "
            f"disc {radius:g} m",
        ),
        (abs(problem.nodes - NODES["obstacle"]) <= 0.02 * NODES["obstacle"], f"{problem.nodes} nodes"),
        (
            False,
            f"µ₁ is read as the ratio of the radius to that of the reference disc, {RADIUS:g} m, so that 0.18 m is "
            f"µ₁ = {mu[0]:g}, inside D",
        ),
        (None, f"values; here {int(active.sum())} of {len(active)} multipliers are positive"),
    )
    return figure
