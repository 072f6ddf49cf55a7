"""Figures 3 and 4, aspect ratios and a solution of the obstacle problem; claims about its data in §5.1."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vibench import HighFidelitySolution, HighFidelitySolver
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
from vibench_problems.paper.claims import MESH, Claim, holds, judged_figure, number, span, unknown
from vibench_problems.paper.evidence import Evidence
from vibench_problems.paper.published import MEMBRANE

SETS = {"training": "D_train", "validation": "D_valid"}


def data(evidence: Evidence) -> Iterator[Claim]:
    """Geometry, parameters, mesh."""
    problem: Obstacle = evidence.problem
    box, training, section = problem.parameters, problem.training_set(), "Obstacle, §5.1"
    yield number(f"{section}, Fig. 2", "side A of Ω [m]", 1, float(np.ptp(problem.mesh.p[0])), given=True)
    yield number(
        "Obstacle, (35)",
        "range of the radius r = µ₁ of ω(µ) [m]",
        (0.8, 1.2),
        [_radius(problem, scale) for scale in (box.lower[0], box.upper[0])],
        cause="A disc of radius 0.8 m does not fit into a square of side 1 m. µ₁ is taken as the ratio of the radius "
        f"to that of ω̂, {RADIUS} m.",
    )
    yield number(
        section,
        "radius of ω̂ that 467 of 3594 nodes imply [m]",
        float(np.sqrt(467 / 3594 / np.pi)),
        RADIUS,
        within=0.05,
        why="√(467 / 3594 / π) on a uniform mesh, within 5 %.",
        given=True,
    )
    total = problem.constraint(np.array(MEMBRANE))[0].data.sum()
    yield holds(
        "Obstacle, (40)",
        "sign of b(v, η) for v, η ≥ 0",
        "positive" if total > 0.0 else "negative",
        total > 0.0,
        paper="positive",
        cause="b(u, η) ≤ g(η) means u ≥ ψ only with a minus sign in b and in g.",
    )
    centre = (float(box.lower[1]), float(box.upper[1]))
    yield number("Obstacle, (35)", "range of the coordinates of the centre [m]", (-0.05, 0.05), centre, given=True)
    yield number(section, "coefficient of ψ [1/m]", -1.25, problem.obstacle, given=True)
    yield number(section, "load [1/m]", -1, problem.load, given=True)
    yield inactive_rim(evidence, section)
    steps = [float(np.diff(np.unique(training[:, k]))[0]) for k in (0, 1)]
    yield number(section, "training points, steps of the grid", (125, 0.1, 0.025), (len(training), *steps), given=True)
    yield number(
        section,
        "validation points, uniform random",
        64,
        int(evidence.cells["queries"].max()),
        why="The sample is another one; that of the paper is not published.",
        given=True,
    )
    yield mesh_size(evidence)
    yield number(section, "nodes in ω̂", 467, len(problem.disc_nodes), within=MESH, given=True)
    cause = "The paper counts the nodes on Γ, where u = 0."
    yield number(section, "primal degrees of freedom", 3594, problem.V.dim, within=MESH, cause=cause)
    yield number(section, "dual degrees of freedom", 467, problem.W.dim, within=MESH, given=True)
    yield unknown(section, "norm of V", "not given", "(44), ℓ̂ = 1 m", "The constants, σ and N depend on it.")
    yield unknown(section, "h(µ) outside ω̂", "smooth, invertible", "harmonic extension", "The paper gives no formula.")


def _radius(problem: Obstacle, scale: float) -> float:
    points = problem.points(np.array([scale, 0.0, 0.0]))[:, problem.disc_nodes]
    return float(np.linalg.norm(points, axis=0).max())


def mesh_size(evidence: Evidence) -> Claim:
    """The size of the mesh."""
    return number("Obstacle, §5.1", "nodes", evidence.paper.nodes, evidence.problem.nodes, within=MESH, given=True)


def inactive_rim(evidence: Evidence, place: str) -> Claim:
    """Inactive constraints at the boundary of ω(µ), at all training parameters."""
    problem, lam = evidence.problem, evidence.reduction.snapshots.lam
    radii = np.linalg.norm(problem.mesh.p[:, problem.disc_nodes], axis=0)
    rim, reach = radii > RADIUS * (1.0 - 1e-9), radii[np.any(lam > 0.0, axis=1)].max() / RADIUS
    return holds(
        place,
        "constraints at the boundary of ω(µ) are inactive",
        f"{np.count_nonzero(lam[rim])} active at {rim.sum()} nodes",
        not np.any(lam[rim]),
        why=f"At all {lam.shape[1]} training parameters; the contact extends to {reach:.2g} of the radius.",
    )


def aspect_ratio_claims(evidence: Evidence) -> Iterator[Claim]:
    """The regularity of the meshes, which is a matter of a criterion that is not given."""
    histories = evidence.tables.histories
    yield unknown(
        "Obstacle, Fig. 3",
        "largest aspect ratio of the mesh, over D_train ∪ D_valid",
        "satisfactory",
        span(histories[histories["quantity"] == "aspect_ratio"]["value"]),
        "The text has no number. Here 1 is equilateral; Salome may define the ratio otherwise.",
    )


def aspect_ratios(evidence: Evidence) -> CaptionedFigure | None:
    """Figure 3: largest aspect ratio of the mesh at every parameter of the training and of the validation set."""
    histories = evidence.tables.histories
    rows = histories[histories["quantity"] == "aspect_ratio"].drop_duplicates(["stage", "step"])
    if rows.empty:
        return None
    sheet = Sheet(1, 1, "Figure 3: largest aspect ratio, §5.1, obstacle", Layout(4.2, 2.5))
    (panel,) = sheet.panels
    looks, first = Looks(map(Series, SETS)), 1
    for stage, name in SETS.items():
        values = rows[rows["stage"] == stage].sort_values("step")["value"].to_numpy(float)
        scatter(panel, first + np.arange(len(values)), values, looks[Series(stage)], name, markersize=3)
        first += len(values)
    panel.set(xlabel="parameter, D_train then D_valid", ylabel="largest aspect ratio", ylim=(1.0, None))
    counts = rows["stage"].value_counts()
    caption = (
        f"Largest aspect ratio of a triangle (1: equilateral) of the mapped mesh at the {counts.get('training', 0)} "
        f"parameters of D_train and the {counts.get('validation', 0)} of D_valid, §5.1, obstacle."
    )
    return judged_figure(sheet, caption, aspect_ratio_claims(evidence))


def solution_claims(evidence: Evidence, solution: HighFidelitySolution) -> Iterator[Claim]:
    """The parameter of Figure 4, and the contact of the solution there."""
    problem, place, mu = evidence.problem, "Fig. 4", np.array(MEMBRANE)
    active = solution.lam > 0.0
    distance = np.linalg.norm(problem.points(mu)[:, problem.disc_nodes] - mu[1:, None], axis=0)
    reach, radius = float(distance[active].max()), RADIUS * mu[0]
    rim = np.isclose(distance, radius, rtol=1e-9)
    yield unknown(
        place,
        "µ₁ = 0.18 lies in [0.8, 1.2], (35)",
        "0.18 m, which is outside",
        f"µ₁ = {mu[0]:g}, for which the radius is {_radius(problem, mu[0]):.2g} m",
        "The paper contradicts itself.",
    )
    yield holds(
        place,
        "constraints at the boundary of ω(µ) are inactive at this µ",
        f"{np.count_nonzero(active[rim])} active at {rim.sum()} nodes",
        rim.any() and not active[rim].any(),
        why=f"The contact reaches {reach:.3g} m from the centre, the disc {radius:g} m.",
    )
    yield unknown(
        place,
        "u(µ) and λ(µ)",
        "in the figure only",
        f"{np.count_nonzero(active)} of {len(active)} multipliers positive, λ up to {solution.lam.max():.3g} 1/m",
        "The text has no number.",
    )


def membrane_solution(evidence: Evidence) -> HighFidelitySolution:
    """The high-fidelity solution at the parameter of Figure 4."""
    return HighFidelitySolver(evidence.problem).solve(np.array(MEMBRANE))


def solution(evidence: Evidence) -> CaptionedFigure:
    """Figure 4: high-fidelity solution and multiplier at µ = (0.18, 0.025, −0.025)."""
    problem, mu = evidence.problem, np.array(MEMBRANE)
    solved = membrane_solution(evidence)
    picture = problem.picture(mu, solved.u, solved.lam)
    sheet = Sheet(1, 2, "Figure 4: solution, §5.1, obstacle", Layout(3.2, 2.9, "every"))
    left, right = sheet.panels
    draw_field(left, picture, (float(picture.values.min()), float(picture.values.max())))
    draw_multiplier(right, picture, (0.0, float(picture.multiplier.max())))
    name_axes(left, "m", [picture.points])
    name_axes(right, "m", [picture.positions])
    left.set_title("u(µ)")
    right.set_title("λ(µ)")
    caption = (
        f"High-fidelity solution of the obstacle problem at radius {RADIUS * mu[0]:g} m and centre ({mu[1]:g}, "
        f"−{-mu[2]:g}) m: left, the deflection u, {span(picture.values)} m; right, the multiplier λ on the disc, "
        f"{span(solved.lam)} 1/m. The orange line is the boundary of the contact, where λ becomes zero."
    )
    return judged_figure(sheet, caption, [*solution_claims(evidence, solved), mesh_size(evidence)])
