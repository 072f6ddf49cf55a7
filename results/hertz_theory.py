"""Half-width and peak pressure of the Hertz problem against the theory of line contact, under refinement.

python results/hertz_theory.py > results/hertz-theory.md
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.results import tables
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import measured, theory

RADII = (0.7, 1.0, 1.3)
MESHES = ((70, 1.1), (140, 1.05), (280, 1.05))
CASES = [(multipliers, growth, approach) for approach in (0.01, 0.09) for multipliers, growth in MESHES]
"""Multipliers, growth of the layers, approach d [m]."""


INTRODUCTION = """# Hertz contact against the theory of line contact

Made by `python results/hertz_theory.py > results/hertz-theory.md`. With E* = E/(2(1−ν²)), 1/R* = 1 + 1/µ and P the
computed load of the whole bodies, the theory of small a/R says a = √(4PR*/(πE*)), p₀ = 2P/(πa). Ours: a straight line
through p² over x² on the active macro-edges, the last one left out.
"""


def main() -> None:
    rows = []
    for multipliers, growth, approach in CASES:
        problem = Hertz(round(multipliers * 2 * 6130 / 560), growth=growth, approach=approach)
        solver = HighFidelitySolver(problem)
        for mu in RADII:
            found = solver.solve(np.array([mu]))
            ours, exact = measured(problem, np.array([mu]), found.lam), theory(problem, np.array([mu]), found.u)
            width, peak = ours.differences(exact)
            rows.append(
                {
                    "d [m]": approach,
                    "multipliers": problem.W.dim,
                    "nodes": problem.nodes,
                    "µ [m]": mu,
                    "active": int(np.count_nonzero(found.lam)),
                    "a [m]": ours.half_width,
                    "theory": exact.half_width,
                    "difference": f"{100 * width:+.2f} %",
                    "p₀ [Pa]": ours.peak,
                    "its theory": exact.peak,
                    "its difference": f"{100 * peak:+.2f} %",
                }
            )
    print(INTRODUCTION)
    print(tables.to_markdown(pd.DataFrame(rows)))


if __name__ == "__main__":
    main()
