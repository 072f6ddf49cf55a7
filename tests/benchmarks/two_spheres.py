"""Two hemispheres against Hertz's theory: the case SSNV104 of code_aster on three meshes, and ever smaller contacts.

    python tests/benchmarks/two_spheres.py [RESOLUTION …]

by default coarse, medium and paper; smaller contacts are computed on the first of them alone.
"""

import sys

import numpy as np

from vibench import HighFidelitySolver
from vibench_problems.two_spheres import TwoSpheres


def compared(resolution: str, extent: float) -> str:
    """Unknowns, and force, peak and semi-axis over those of Hertz, in a line; by his theory the latter is `extent`."""
    problem = TwoSpheres(resolution, extent=extent)
    mu = np.array([1.0, 2.0 * extent**2, 0.3])
    lam = HighFidelitySolver(problem).solve(mu).lam
    found, theory = problem.measured(lam), problem.theory(mu)
    ratios = problem.force(lam) / theory.force, found.peak / theory.peak, found.a / theory.a
    sizes = f"{resolution:8} a/R {extent:5.2f}  n {problem.V.dim:6}  m {problem.W.dim:4}"
    shares = "  ".join(f"{name} {value:.4f}" for name, value in zip(("force", "peak", "a"), ratios, strict=True))
    return f"{sizes}  {shares}  peak {20_000.0 * found.peak:.0f} MPa at E = 20 GPa"


if __name__ == "__main__":
    resolutions = sys.argv[1:] or ["coarse", "medium", "paper"]
    for each in resolutions:
        print(compared(each, 0.2), flush=True)
    for extent in (0.1, 0.05, 0.02):
        print(compared(resolutions[0], extent), flush=True)
