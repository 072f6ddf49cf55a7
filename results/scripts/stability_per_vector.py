"""Vectors that fixed enrichments need for a share of β_on, and conditioning of cones, on the meshes of the paper.

python results/scripts/stability_per_vector.py results/stability-per-vector
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from page import Page, made_by, start

from vibench import Reduction, Stop, create, project_on_cone
from vibench.arrays import Array
from vibench.plugins import registry
from vibench.plugins.kinds import PluginKind
from vibench.reduction.supremizers import constraint_classes, projected_supremizers
from vibench.stability.infsup import beta_span

DIMENSIONS = {"hertz": (46, 12), "obstacle": (45, 50)}
"""Prescribed N and R: for Hertz those of the paper, for the obstacle about those of δ_POD = 1e-4 and δ = 1e-2."""

SHARES = (0.3, 0.5, 0.7, 0.8, 0.9)

ENRICHMENTS = {"offline-pga": 0.3, "infsup-greedy": 0.95, "pod-supremizers": 0.1}
"""Tolerances tight enough for every share."""

ABOUT = """Mesh of the paper, N and R prescribed, cone of mcpg. The columns give the smallest number of vectors with
which β_S(mu) ≥ s·β_on(mu) at every training parameter, over span χ; β_on is the inf-sup constant with online
supremizers."""

CONES = (
    "cones of R generators from the same snapshots: largest relative projection error, condition number of the Gram "
    "matrix in W, and the largest distance of a generator of cpg from the cone"
)


def counts(reduction: Reduction) -> dict[str, int | None]:
    """Smallest numbers of vectors that reach the shares; β_on and β_S do not come from the strategies."""
    problem, span, basis = reduction.problem, reduction.multipliers.span, reduction.pod.basis
    matrices = constraint_classes([problem.constraint(mu)[0] for mu in reduction.parameters]).representatives
    online = [beta_span(problem.V.whiten_functional(np.asarray(B.T @ span))) for B in matrices]
    vectors: Array = reduction.enrichment.vectors
    images = [projected_supremizers(np.hstack([basis, vectors]), B, span) for B in matrices]
    shares = [
        min(beta_span(rows[: basis.shape[1] + k]) / beta for rows, beta in zip(images, online, strict=True))
        for k in range(vectors.shape[1] + 1)
    ]
    return {f"β_S ≥ {s:g} β_on": next((k for k, share in enumerate(shares) if share >= s), None) for s in SHARES}


def condition(reduction: Reduction, given: Array) -> dict[str, object]:
    """Size and conditioning of a cone, and the largest distance of the columns of `given` (m×R) from it."""
    cone, W = reduction.cone, reduction.problem.W
    return {
        "R": cone.size,
        "error": float(cone.errors[-1]),
        "condition": float(np.linalg.cond(W.gram(cone.generators, cone.generators))),
        "lost of cpg": max(project_on_cone(cone.rays, nu, W).distance for nu in given.T),
        "fallbacks": len(cone.fallbacks),
    }


def main(target: str) -> None:
    shares, cones = [], []
    for name, (modes, size) in DIMENSIONS.items():
        problem = create("problem", name, {"resolution": "paper"})
        plain = Reduction(problem, create("dual strategy", "cpg"), None, Stop(size=modes), Stop(size=size))
        snapshots = plain.snapshots
        for primal, tolerance in ENRICHMENTS.items():
            strategies = {"dual": create("dual strategy", "mcpg"), "primal": create("primal strategy", primal)}
            reduction = replace(plain, **strategies, tolerance=tolerance).given(snapshots=snapshots)
            shares.append({"problem": name, "N": modes, "R": size, "primal": primal} | counts(reduction))
        for dual in registry.registered(PluginKind.DUAL):
            reduction = replace(plain, dual=create("dual strategy", dual)).given(snapshots=snapshots)
            cones.append({"problem": name, "dual": dual} | condition(reduction, plain.cone.generators))
    table = pd.DataFrame(shares)
    fewest = table.loc[table.groupby("problem")[f"β_S ≥ {SHARES[-1]:g} β_on"].idxmin()]
    page = Page(
        target,
        "How many vectors buy how much stability?",
        made_by("stability_per_vector", "stability-per-vector"),
        ABOUT,
    )
    page.answer(
        f"For {SHARES[-1]:g} of β_on at every training parameter "
        + " and ".join(f"`{one['primal']}` needs {one[f'β_S ≥ {SHARES[-1]:g} β_on']} vectors on {one['problem']}"
                       for _, one in fewest.iterrows())
        + ", the fewest of three enrichments. Half of it takes at most "
        f"{table[f'β_S ≥ {SHARES[1]:g} β_on'].max()}.",
        table,
    )  # fmt: skip
    page.file("cones", CONES, pd.DataFrame(cones))
    page.write()


if __name__ == "__main__":
    start(main)
