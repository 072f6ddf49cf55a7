"""Discretisation errors of the radial obstacle problem against its closed form, and their rates, on four meshes.

python results/scripts/exact_answers.py results/exact-answers
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from page import Page, made_by, start

from vibench.highfidelity.active_set import HighFidelitySolver
from vibench_problems.radial import Radial

RINGS = (8, 16, 32, 64)
PARAMETERS = [np.array((h, c)) for h in np.linspace(0.14, 0.2, 6) for c in np.linspace(0.0, 0.25, 6)]

ABOUT = """Relative errors of u in V and of λ in L², means over 36 parameters; each rate compares a level with the
previous one. P1 displacements converge with order 1. The multiplier jumps at the edge of the contact zone, and P1
functions approximate a jump with order ½ only. On meshes made of rings the error of λ is √h times a factor that depends
on the position of the edge between two rings; the rates of single parameters therefore scatter. The closed form is
derived in `problems/vibench_problems/radial.py`."""


def main(target: str) -> None:
    rows: list[dict[str, Any]] = []
    previous = None
    for rings in RINGS:
        problem = Radial(3 * rings**2)
        solver, errors_by_parameter = HighFidelitySolver(problem), []
        for mu in PARAMETERS:
            solution = solver.solve(mu)
            radius = problem.contact_radius(solution.lam) / problem.exact(mu).contact_radius - 1.0
            errors_by_parameter.append((*problem.errors(mu, solution.u, solution.lam), abs(radius)))
        errors = np.mean(errors_by_parameter, axis=0)
        rates = [""] * 2 if previous is None else [f"{rate:.2f}" for rate in np.log2(previous / errors)[:2]]
        previous = errors
        rows.append(
            {
                "rings": rings, "nodes": problem.mesh.p.shape[1], "multipliers": problem.W.dim, "error u": errors[0],
                "rate u": rates[0], "error λ": errors[1], "rate λ": rates[1], "error of the contact radius": errors[2],
            }
        )  # fmt: skip
    page = Page(
        target,
        "How accurate are full solutions of the obstacle problem?",
        made_by("exact_answers", "exact-answers"),
        ABOUT,
    )
    fitted = [-np.polyfit(np.log(RINGS), np.log([row[f"error {name}"] for row in rows]), 1)[0] for name in ("u", "λ")]
    page.answer(
        f"Against the closed form u converges with order {fitted[0]:.2f} and λ with order {fitted[1]:.2f}, fitted over "
        "four meshes. By theory these are 1 and ½.",
        pd.DataFrame(rows),
    )
    page.write()


if __name__ == "__main__":
    start(main)
