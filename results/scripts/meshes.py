"""Which conclusions depend on the triangulation: the page of the study `meshes`.

vibench run meshes --no-figures && python results/scripts/meshes.py runs/meshes results/meshes
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from page import Page, made_by, origin, read, start

from vibench import Reduction, Stop, create, project_on_cone
from vibench.reduction import TIE

LOOSE, TIGHT = 1e-2, 1e-3
"""δ_dual."""


Entry = tuple[str, str, float, str]
"""A column of a cell: dual strategy, primal strategy, δ_dual, column."""


@dataclass(frozen=True)
class Mesh:
    """The cells of one mesh, by dual strategy, primal strategy and δ_dual."""

    name: str
    cells: pd.DataFrame

    def value(self, entry: Entry) -> float:
        """One column of one cell."""
        *cell, column = entry
        return float(self.cells.loc[tuple(cell), column])


@dataclass(frozen=True)
class Conclusion:
    """A statement on one mesh, and what confirms it: an entry, divided by another one if it is given."""

    statement: str
    holds: Callable[[float], bool]
    entry: Entry
    over: Entry | None = None

    def figure(self, mesh: Mesh) -> float:
        """The figure to judge the statement by."""
        return mesh.value(self.entry) / (mesh.value(self.over) if self.over else 1.0)


def conclusions() -> list[Conclusion]:
    """What the pages of this repository and the paper conclude."""
    of_cones = [
        Conclusion(
            f"mCPG needs fewer generators than CPG at δ = {tolerance:g} (ratio)",
            lambda ratio: ratio < 1.0,
            ("mcpg", "decorrelated", tolerance, "R"),
            ("cpg", "decorrelated", tolerance, "R"),
        )
        for tolerance in (LOOSE, TIGHT)
    ]
    beta = Conclusion(
        f"without enrichment β over the cone is smaller for mCPG than for CPG at δ = {TIGHT:g} (ratio)",
        lambda ratio: ratio < 1.0,
        ("mcpg", "decorrelated", TIGHT, "beta_cone_lower_min"),
        ("cpg", "decorrelated", TIGHT, "beta_cone_upper_min"),
    )
    of_enrichments = [
        conclusion
        for dual, tolerance in (("cpg", TIGHT), ("mcpg", LOOSE), ("mcpg", TIGHT))
        for conclusion in (
            Conclusion(
                f"{dual}, δ = {tolerance:g}: without enrichment β over the span is less than a tenth of that of V "
                "(share)",
                lambda share: share < 0.1,
                (dual, "decorrelated", tolerance, "share_validation"),
            ),
            Conclusion(
                f"{dual}, δ = {tolerance:g}: enrichment halves the error of λ at least (ratio online / none)",
                lambda ratio: ratio < 0.5,
                (dual, "online-supremizers", tolerance, "error_lambda_mean"),
                (dual, "decorrelated", tolerance, "error_lambda_mean"),
            ),
            Conclusion(
                f"{dual}, δ = {tolerance:g}: the offline enrichment has the error of λ of the online one within 10 % "
                "(ratio)",
                lambda ratio: ratio < 1.1,
                (dual, "offline-pga", tolerance, "error_lambda_mean"),
                (dual, "online-supremizers", tolerance, "error_lambda_mean"),
            ),
            Conclusion(
                f"{dual}, δ = {tolerance:g}: √(1 − σ²) bounds the share of β off the training set, too (share over "
                "bound)",
                lambda ratio: ratio >= 1.0 - 1e-6,
                (dual, "offline-pga", tolerance, "share_validation"),
                (dual, "offline-pga", tolerance, "share_guaranteed"),
            ),
        )
    ]
    return [*of_cones, beta, *of_enrichments]


def main(run: str, target: str) -> None:
    cells = read(run, "cells")
    meshes = [
        Mesh(str(name), rows.set_index(["dual", "primal", "dual_tol"])) for name, rows in cells.groupby("problem")
    ]
    obstacle, hertz = (
        sorted((mesh for mesh in meshes if mesh.name.startswith(kind)), key=lambda mesh: mesh.name != first)
        for kind, first in (("obstacle", "obstacle, symmetric"), ("hertz", "hertz, staggered"))
    )
    page = Page(
        target,
        "Which conclusions depend on the triangulation?",
        made_by("meshes", "meshes", "meshes", options=" --no-figures"),
        "The problems of the paper on meshes of one size that differ only in their triangulation. For the obstacle: "
        "ours, symmetric as the training grid is, and the same one with nodes displaced at random (`asymmetric`). For "
        "Hertz contact: layers of nodes shifted by half a spacing (ours), not shifted and cut by diagonals that all "
        "point one way, and displaced at random (`triangulation`). `vibench run meshes` leaves the tables of all "
        "queries and histories under `runs/meshes/tables`.",
        machine=origin(cells),
    )
    verdicts = {"obstacle": judged(obstacle), "hertz": judged(hertz)}
    changed = {name: int((table["on all meshes"] == "no").sum()) for name, table in verdicts.items()}
    count, tied = sum(map(len, verdicts.values())), pd.DataFrame([ties(mesh) for mesh in [*obstacle, *hertz]])
    most, sizes = tied.loc[tied["ties"].idxmax()], dimensions([*obstacle, *hertz])
    page.answer(
        f"Of {count} conclusions {' and '.join(f'{some} on {name}' for name, some in changed.items())} are not the "
        f"same on all meshes. On {most['mesh']} {most['ties']} of the {most['steps of CPG']} steps of CPG are ties, "
        "which the smallest index decides.",
        sizes.query("dual == 'mcpg'").drop(columns="dual"),
    )
    for name, table in verdicts.items():
        page.file(f"conclusions-{name}", "every conclusion on every mesh, and its figure", table)
    page.file("dimensions", "dimensions, constants and errors of both cones", sizes)
    page.file(
        "ties",
        f"steps of CPG (δ = {TIGHT:g}) at which another snapshot is as far from the cone as the farthest one, to "
        f"{TIE:g} of the first distance",
        tied,
    )
    page.file("cells", "every cell, with all columns", cells)
    page.write()


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
    problem = create("problem", definition["name"], json.loads(definition["options"]))
    reduction = Reduction(problem, create("dual strategy", "cpg"), None, Stop(size=1), Stop(tolerance=TIGHT))
    snapshots, cone = reduction.snapshots.lam, reduction.cone
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
    start(main)
