"""Discretisation errors of the radial obstacle problem against its closed form, and their rates, over four levels.

python results/exact_answers.py > results/exact-answers.md
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.results import tables
from vibench_problems.radial import Radial

RINGS = (8, 16, 32, 64)
PARAMETERS = [np.array((h, c)) for h in np.linspace(0.14, 0.2, 6) for c in np.linspace(0.0, 0.25, 6)]

INTRODUCTION = """# The radial obstacle problem against its closed form

Made by `python results/exact_answers.py > results/exact-answers.md`. Relative errors of u in V and of λ in L²,
means over 36 parameters; the rate is that from the level before. P1 displacements are of order 1. The multiplier
jumps at the edge of the contact, which P1 functions follow with order ½ only: on meshes made of rings the error of
λ is √h times a factor that depends on where between two rings the edge lies, which is why the rates of single
parameters scatter. The closed form is derived in `problems/vibench_problems/radial.py`.
"""


def main() -> None:
    rows, before = [], None
    for rings in RINGS:
        problem = Radial(3 * rings**2)
        solver, found = HighFidelitySolver(problem), []
        for mu in PARAMETERS:
            solution = solver.solve(mu)
            radius = problem.contact_radius(solution.lam) / problem.exact(mu).contact_radius - 1.0
            found.append((*problem.errors(mu, solution.u, solution.lam), abs(radius)))
        errors = np.mean(found, axis=0)
        rates = [""] * 2 if before is None else [f"{rate:.2f}" for rate in np.log2(before / errors)[:2]]
        before = errors
        rows.append(
            {
                "rings": rings,
                "nodes": problem.mesh.p.shape[1],
                "multipliers": problem.W.dim,
                "error u": errors[0],
                "rate u": rates[0],
                "error λ": errors[1],
                "rate λ": rates[1],
                "error of the contact radius": errors[2],
            }
        )
    print(INTRODUCTION)
    print(tables.to_markdown(pd.DataFrame(rows)))
    for name in ("u", "λ"):
        rate = np.polyfit(np.log(RINGS), np.log([row[f"error {name}"] for row in rows]), 1)[0]
        print(f"Fitted over the four levels: {name} {-rate:.2f}\n")


if __name__ == "__main__":
    main()
