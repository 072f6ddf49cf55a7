"""Draw the pictures of the gallery: a full solution of every problem, in the middle of its parameters.

python docs/gallery.py
"""

from __future__ import annotations

from pathlib import Path

from vibench import HighFidelitySolver, create
from vibench.report.figures.solutions import draw_solutions
from vibench.report.figures.style import styled

OPTIONS = {
    "obstacle": {"resolution": "coarse"},
    "obstacle-ceiling": {"resolution": "coarse", "ceiling": 0.01},
    "hertz": {"resolution": "coarse"},
    "hertz3d": {"resolution": "coarse"},
    "radial-obstacle": {},
    "bearing": {},
    "american-put": {},
    "tresca": {"resolution": "coarse"},
}


def main() -> None:
    """Write a picture for every problem into the folder `gallery` beside this file."""
    folder = Path(__file__).with_name("gallery")
    for name, options in OPTIONS.items():
        problem = create("problem", "obstacle" if "ceiling" in options else name, options)
        box = problem.parameters
        mu = box.lower + 0.5 * (box.upper - box.lower)
        solution = HighFidelitySolver(problem).solve(mu)
        picture = problem.picture(mu, solution.u, solution.lam)
        named = zip(box.names, mu, box.units, strict=True)
        heading = ", ".join(f"{label} = {value:.3g} {unit}".strip() for label, value, unit in named)
        with styled():
            figure = draw_solutions(name, [(heading if len(heading) < 40 else "", picture)])
            figure.savefig(folder / f"{name}.png", dpi=90)
        print(f"{name}: {len(solution.u)} unknowns, {len(solution.lam)} constraints")


if __name__ == "__main__":
    main()
