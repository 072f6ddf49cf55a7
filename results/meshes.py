"""Which conclusions depend on the triangulation: the page of the study `meshes`.

vibench run meshes --no-figures && python results/meshes.py runs/meshes results/meshes
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.strategies import Stop
from vibench.reduction.cones import greedy_cone, project_on_cone
from vibench.reduction.lazy_greedy import TIE
from vibench.results import tables
from vibench.study import registry

LOOSE, TIGHT = 1e-2, 1e-3
"""δ_dual."""


@dataclass(frozen=True)
class Mesh:
    """The cells of one mesh, by dual strategy, primal strategy and δ_dual."""

    name: str
    cells: pd.DataFrame

    def value(self, dual: str, primal: str, tolerance: float, column: str) -> float:
        """One column of one cell."""
        return float(self.cells.loc[(dual, primal, tolerance), column])


@dataclass(frozen=True)
class Conclusion:
    """A statement on one mesh: a figure to judge it by, and whether it holds."""

    statement: str
    figure: Callable[[Mesh], float]
    holds: Callable[[float], bool]


def _ratio(dual: str, tolerance: float, column: str, one: str, other: str) -> Callable[[Mesh], float]:
    return lambda mesh: mesh.value(dual, one, tolerance, column) / mesh.value(dual, other, tolerance, column)


def conclusions() -> list[Conclusion]:
    """What the pages of this repository and the paper conclude."""
    found = [
        Conclusion(
            f"mCPG needs fewer generators than CPG at δ = {tolerance:g} (ratio)",
            lambda mesh, tolerance=tolerance: (
                mesh.value("mcpg", "decorrelated", tolerance, "R") / mesh.value("cpg", "decorrelated", tolerance, "R")
            ),
            lambda ratio: ratio < 1.0,
        )
        for tolerance in (LOOSE, TIGHT)
    ]
    found.append(
        Conclusion(
            f"without enrichment β over the cone is smaller for mCPG than for CPG at δ = {TIGHT:g} (ratio)",
            lambda mesh: (
                mesh.value("mcpg", "decorrelated", TIGHT, "beta_cone_lower_min")
                / mesh.value("cpg", "decorrelated", TIGHT, "beta_cone_upper_min")
            ),
            lambda ratio: ratio < 1.0,
        )
    )
    for dual, tolerance in (("cpg", TIGHT), ("mcpg", LOOSE), ("mcpg", TIGHT)):
        case = f"{dual}, δ = {tolerance:g}"

        def of(primal: str, column: str, dual: str = dual, tolerance: float = tolerance) -> Callable[[Mesh], float]:
            return lambda mesh: mesh.value(dual, primal, tolerance, column)

        def guaranteed(mesh: Mesh, dual: str = dual, tolerance: float = tolerance) -> float:
            pair = [
                mesh.value(dual, "offline-pga", tolerance, f"share_{what}") for what in ("validation", "guaranteed")
            ]
            return pair[0] / pair[1]

        found += [
            Conclusion(
                f"{case}: without enrichment β over the span is less than a tenth of that of V (share)",
                of("decorrelated", "share_validation"),
                lambda share: share < 0.1,
            ),
            Conclusion(
                f"{case}: enrichment halves the error of λ at least (ratio online / none)",
                _ratio(dual, tolerance, "error_lambda_mean", "online-supremizers", "decorrelated"),
                lambda ratio: ratio < 0.5,
            ),
            Conclusion(
                f"{case}: the offline enrichment has the error of λ of the online one within 10 % (ratio)",
                _ratio(dual, tolerance, "error_lambda_mean", "offline-pga", "online-supremizers"),
                lambda ratio: ratio < 1.1,
            ),
            Conclusion(
                f"{case}: √(1 − σ²) bounds the share of β off the training set, too (share over bound)",
                guaranteed,
                lambda ratio: ratio >= 1.0 - 1e-6,
            ),
        ]
    return found


def main() -> None:
    if len(sys.argv) != 3:
        sys.exit("usage: python results/meshes.py RUN_FOLDER TARGET_FOLDER")
    path, target = tables.results_file(sys.argv[1]), Path(sys.argv[2])
    cells = tables.in_order(tables.read(path, "cells"))
    target.mkdir(parents=True, exist_ok=True)
    tables.in_order(cells).to_csv(target / "cells.csv", index=False, float_format="%.6g")
    (target / "README.md").write_text(page(cells), encoding="utf-8")


def page(cells: pd.DataFrame) -> str:
    """The whole page."""
    meshes = [
        Mesh(str(name), rows.set_index(["dual", "primal", "dual_tol"])) for name, rows in cells.groupby("problem")
    ]
    obstacle, hertz = (
        sorted((mesh for mesh in meshes if mesh.name.startswith(kind)), key=lambda mesh: mesh.name != first)
        for kind, first in (("obstacle", "obstacle, symmetric"), ("hertz", "hertz, staggered"))
    )
    found = [(kind, judged(of)) for kind, of in (("the obstacle", obstacle), ("Hertz contact", hertz))]
    lines = []
    for kind, table in found:
        depends = table[table["on all meshes"] == "no"]["conclusion"]
        lines.append(f"- For {kind}: {'; '.join(depends) or 'nothing; every conclusion is the same on all meshes'}.")
    parts = [
        "# Conclusions and meshes",
        "Generated by `vibench run meshes --no-figures && python results/meshes.py runs/meshes results/meshes` on one "
        f"machine: {cells['machine'].iloc[0]}. The problems of the paper on meshes of one size that differ in their "
        "triangulation alone. For the obstacle: ours, symmetric as the training grid is, and the same one with nodes "
        "displaced at random (`asymmetric`). For Hertz contact: layers of nodes shifted by half a spacing (ours), not "
        "shifted and cut by diagonals that all point one way, and displaced at random (`triangulation`).",
        "## Dimensions",
        tables.to_markdown(dimensions([*obstacle, *hertz])),
        "## Ties",
        f"Steps of CPG (δ = {TIGHT:g}) at which another snapshot is as far from the cone as the farthest one, to "
        f"{TIE:g} of the first distance; the smallest index decides.",
        tables.to_markdown(pd.DataFrame([ties(mesh) for mesh in [*obstacle, *hertz]])),
        *(f"## Conclusions for {kind}\n\n{tables.to_markdown(table)}" for kind, table in found),
        "## What depends on the mesh",
        "\n".join(lines),
        "`vibench run meshes` leaves the tables of all queries and histories under `runs/meshes/tables`. Full table of "
        "the cells: [cells.csv](cells.csv).",
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def dimensions(meshes: Sequence[Mesh]) -> pd.DataFrame:
    """N, R and the vectors added by PGA, with the constants and errors of the pair without enrichment and with it."""
    rows = []
    for mesh in meshes:
        for dual, tolerance in (("cpg", LOOSE), ("mcpg", LOOSE), ("cpg", TIGHT), ("mcpg", TIGHT)):
            plain, added = (mesh.cells.loc[(dual, primal, tolerance)] for primal in ("decorrelated", "offline-pga"))
            rows.append(
                {
                    "mesh": mesh.name, "dual": dual, "δ_dual": tolerance, "N": plain["N"], "R": plain["R"],
                    "added by PGA, δ = 0.5": added["enrichment"], "min β cone, none": plain["beta_cone_lower_min"],
                    "min β span, PGA": added["beta_span_min"], "error λ, none": plain["error_lambda_mean"],
                    "error λ, PGA": added["error_lambda_mean"],
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


def ties(mesh: Mesh) -> dict[str, object]:
    """How many steps of CPG are ties."""
    definition = json.loads(mesh.cells["definition"].iloc[0])["problem"]
    problem = registry.create("problem", definition["name"], json.loads(definition["options"]))
    solver = HighFidelitySolver(problem)
    snapshots = np.column_stack([solver.solve(mu).lam for mu in problem.training_set()])
    cone = greedy_cone(snapshots, problem.W, Stop(tolerance=TIGHT))
    tied, norms = 0, problem.W.norm(snapshots)
    for count in range(cone.size):
        generators = cone.generators[:, :count]
        distances = np.sort([project_on_cone(generators, theta, problem.W).distance for theta in snapshots.T])
        tied += bool(distances[-2] >= distances[-1] - TIE * norms.max())
    return {"mesh": mesh.name, "steps of CPG": cone.size, "ties": tied}


def judged(meshes: Sequence[Mesh]) -> pd.DataFrame:
    """Every conclusion on every mesh: its figure, and whether it holds."""
    rows = []
    for conclusion in conclusions():
        figures = {mesh.name: conclusion.figure(mesh) for mesh in meshes}
        holds = {name: conclusion.holds(figure) for name, figure in figures.items()}
        shown = {name: f"{'yes' if holds[name] else 'no'} ({figure:.3g})" for name, figure in figures.items()}
        same = "yes" if all(holds.values()) else "no" if any(holds.values()) else "holds on none"
        rows.append({"conclusion": conclusion.statement} | shown | {"on all meshes": same})
    return pd.DataFrame(rows)


if __name__ == "__main__":
    main()
