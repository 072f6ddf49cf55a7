"""Vectors that fixed enrichments need for a share of β_on, and conditioning of cones, on the meshes of the paper.

python results/scripts/stability_per_vector.py results/stability-per-vector
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from page import Page, made_by, start

from vibench.arrays import Array
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.strategies import Offline, Stop
from vibench.linalg.inner_product import InnerProduct
from vibench.reduction.cones import project_on_cone
from vibench.reduction.nested import NestedStrategy, grow_through
from vibench.reduction.pod import pod
from vibench.reduction.supremizers import constraint_classes, isometric_supremizers, projected_supremizers
from vibench.stability.infsup import beta_span, multipliers
from vibench.study import registry
from vibench.study.kinds import PluginKind

DIMENSIONS = {"hertz": (46, 12), "obstacle": (45, 50)}
"""Prescribed N and R: for Hertz those of the paper, for the obstacle about those of δ_POD = 1e-4 and δ = 1e-2."""

SHARES = (0.3, 0.5, 0.7, 0.8, 0.9)

ENRICHMENTS = {"offline-pga": 0.3, "infsup-greedy": 0.95, "pod-supremizers": 0.1}
"""Tolerances tight enough for every share."""

ABOUT = """Mesh of the paper, N and R prescribed, cone of mcpg. The columns give the smallest number of vectors with
which β_S(mu) ≥ s·β_on(mu) at every training parameter, over span χ; β_on is the inf-sup constant with online
supremizers."""

CONES = (
    "Cones of R generators from the same snapshots: largest relative projection error, condition number of the Gram "
    "matrix in W, and the largest distance of a generator of cpg from the cone."
)


def counts(data: Offline, vectors: Array) -> dict[str, int | None]:
    """Smallest numbers of vectors that reach the shares; β_on and β_S do not come from the strategies."""
    classes = constraint_classes([data.problem.constraint(mu)[0] for mu in data.training])
    image = isometric_supremizers(data.problem.V, classes.representatives, data.span.shape[1])
    online = np.array([beta_span(image(B, data.span)) for B in classes.representatives])
    images = [projected_supremizers(np.hstack([data.basis, vectors]), B, data.span) for B in classes.representatives]
    first = data.basis.shape[1]
    reached = [
        min(beta_span(rows[: first + k]) / beta for rows, beta in zip(images, online, strict=True))
        for k in range(vectors.shape[1] + 1)
    ]
    return {f"β_S ≥ {s:g} β_on": next((k for k, share in enumerate(reached) if share >= s), None) for s in SHARES}


def conditions(name: str, size: int, lam: Array, W: InnerProduct) -> list[dict[str, object]]:
    """One row for every dual strategy."""
    given = registry.create("dual strategy", "cpg", {}).reduce(lam, W, Stop(size=size)).generators
    rows: list[dict[str, object]] = []
    for dual in registry.registered(PluginKind.DUAL):
        cone = registry.create("dual strategy", dual, {}).reduce(lam, W, Stop(size=size))
        gram = W.gram(cone.generators, cone.generators)
        rows.append(
            {
                "problem": name,
                "dual": dual,
                "R": cone.size,
                "error": float(cone.errors[-1]),
                "condition": float(np.linalg.cond(gram)),
                "lost of cpg": max(project_on_cone(cone.rays, nu, W).distance for nu in given.T),
                "fallbacks": len(cone.fallbacks),
            }
        )
    return rows


def main(target: str) -> None:
    shares, cones = [], []
    for name, (modes, size) in DIMENSIONS.items():
        problem = registry.create("problem", name, {"resolution": "paper"})
        training, solver = problem.training_set(), HighFidelitySolver(problem)
        solved = [solver.solve(mu) for mu in training]
        basis = pod(np.column_stack([s.u for s in solved]), problem.V, Stop(size=modes)).basis
        lam = np.column_stack([s.lam for s in solved])
        cone = registry.create("dual strategy", "mcpg", {}).reduce(lam, problem.W, Stop(size=size))
        data = Offline(problem, basis, cone, multipliers(cone.generators, problem.W).span, training)
        for primal, tolerance in ENRICHMENTS.items():
            strategy: NestedStrategy = registry.create("primal strategy", primal, {})
            vectors = grow_through(strategy, data, [tolerance]).vectors
            shares.append({"problem": name, "N": modes, "R": size, "primal": primal} | counts(data, vectors))
        cones += conditions(name, size, lam, problem.W)
    page = Page(
        target,
        "Vectors for a share of β_on, and conditioning of cones",
        made_by("stability_per_vector", "stability-per-vector"),
        ABOUT,
    )
    page.add(pd.DataFrame(shares), CONES, pd.DataFrame(cones))
    page.write()


if __name__ == "__main__":
    start(main)
