"""Half-width and peak pressure of the Hertz problem against the theory of line contact, under refinement.

python results/scripts/hertz_theory.py results/hertz-theory
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from page import Page, made_by, start

from vibench.highfidelity.active_set import HighFidelitySolver
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import measured, theory

RADII = (0.7, 1.0, 1.3)
MESHES = ((70, 1.265), (140, 1.265), (280, 1.265), (70, 1.1), (140, 1.05), (280, 1.05))
CASES = [(multipliers, growth, approach) for approach in (0.01, 0.09) for multipliers, growth in MESHES]
"""Multipliers, growth of the layers, approach d [m]."""

ABOUT = """With E* = E/(2(1−ν²)), 1/R* = 1 + 1/µ and the computed load P of the whole bodies, Hertz theory for small a/R
gives a = √(4PR*/(πE*)) and p₀ = 2P/(πa). The computed half-width a and peak pressure p₀ come from a linear fit of p²
over x² on the active macro-edges without the last one. The studies use growth 1.265, the largest here, with 280
multipliers: comparison with the rows of a smaller growth shows which part of the difference from the theory is due to
the coarse mesh away from the contact."""


def main(target: str) -> None:
    rows = []
    for multipliers, growth, approach in CASES:
        problem = Hertz(round(multipliers * 2 * 6130 / 560), growth=growth, approach=approach)
        solver = HighFidelitySolver(problem)
        for mu in np.array(RADII)[:, None]:
            solution = solver.solve(mu)
            computed, exact = measured(problem, mu, solution.lam), theory(problem, mu, solution.u)
            width, peak = computed.differences(exact)
            rows.append(
                {
                    "d [m]": approach, "multipliers": problem.W.dim, "growth": f"{growth:g}", "nodes": problem.nodes,
                    "µ [m]": mu[0], "active": int(np.count_nonzero(solution.lam)), "a [m]": computed.half_width,
                    "theory a": exact.half_width, "difference a [%]": 100 * width, "p₀ [Pa]": computed.peak,
                    "theory p₀": exact.peak, "difference p₀ [%]": 100 * peak,
                }
            )  # fmt: skip
    page = Page(target, "Does Hertz contact agree with its theory?", made_by("hertz_theory", "hertz-theory"), ABOUT)
    table = pd.DataFrame(rows)
    finest = table[table["multipliers"] == table["multipliers"].max()]
    page.answer(
        "On the finest meshes the half-width differs from the theory by at most "
        f"{finest['difference a [%]'].abs().max():.1f} %, and the peak pressure by at most "
        f"{finest['difference p₀ [%]'].abs().max():.1f} %.",
        finest.drop(columns=["multipliers", "nodes", "active"]),
    )
    page.file("rows", "all meshes", table)
    page.write()


if __name__ == "__main__":
    start(main)
