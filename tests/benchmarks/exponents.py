"""What parts of the work on `hertz3d` cost on four meshes, and their exponents in the unknowns.

Usage: python tests/benchmarks/exponents.py [RESOLUTION...]

For every resolution, "coarse", "medium", "paper" and "fine" by default, CPU seconds of one thread of

    problem       the mesh, the terms of A, B and g, and a factor of X_V
    set-up        A factorised with its Schur complement on the contact unknowns; with as many of these as at "fine" the
                  complement is that of the zone in contact, and waits for a solution
    solution      assembly, set-up and active sets at another parameter
    A             factors of A there, for constants and bounds
    α, γ, β_A     the constants there, proved
    bounds        the error bounds of one pair there, from these constants
    base          what all certificates have in common, once per problem

then how many solutions the constants and bounds are, and the largest memory of the process so far. At the end,
exponents from every mesh to the next. PARDISO factorises.
"""

from __future__ import annotations

import os
import resource
import sys

if __name__ == "__main__":  # before NumPy is imported
    for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR"):
        os.environ[f"{library}_NUM_THREADS"] = "1"

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TypeVar

import numpy as np

import vibench
from vibench.highfidelity.active_set import ActiveSetSolution, HighFidelitySolver
from vibench.interfaces.validation import checked_assembly
from vibench.model.affine import INTERPOLATION_RTOL, affine_decomposition
from vibench.model.certificates.base import certificate_base
from vibench.model.error_bounds import bound_errors_at
from vibench.offline.assemblies import Assemblies
from vibench.timing import timed

T = TypeVar("T")

RESOLUTIONS = ("coarse", "medium", "paper", "fine")

FIRST, SECOND = np.array([1.0, 1.0, 0.00125, 0.3]), np.array([1.3, 0.8, 0.0014, 0.25])
"""Two parameters of `hertz3d`; A is another at the second."""

JUDGING = ("A", "α", "γ", "β_A", "bounds")


class Parts:
    """CPU seconds of parts of the work on one mesh by name, printed as they are known."""

    def __init__(self, mesh: str) -> None:
        self.mesh, self.seconds = mesh, dict[str, float]()

    def add(self, name: str, action: Callable[[], T]) -> T:
        """What an action returns."""
        result, spent = timed(action)
        self.seconds[name] = spent.cpu
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"{self.mesh}, {name}: {spent.cpu:.3f} s, at most {memory:.1f} GiB so far", flush=True)
        return result


def measure(resolution: str) -> tuple[int, dict[str, float]]:
    """The unknowns of a mesh, and CPU seconds by part."""
    parts, options = Parts(resolution), {"resolution": resolution, "factorisation": "pardiso"}
    problem = parts.add("problem", lambda: vibench.create("problem", "hertz3d", options))
    _judge(parts, problem, _solve(parts, problem))
    training = problem.training_set()
    members = affine_decomposition(problem, training, INTERPOLATION_RTOL)
    parts.add("base", lambda: certificate_base(problem, members, training))
    return problem.V.dim, parts.seconds


def _solve(parts: Parts, problem: vibench.Problem) -> ActiveSetSolution:
    solver = HighFidelitySolver(problem)
    parts.add("set-up", lambda: solver.condensed(checked_assembly(problem, FIRST)))
    return parts.add("solution", lambda: solver.solve_assembled(SECOND, checked_assembly(problem, SECOND)))


def _judge(parts: Parts, problem: vibench.Problem, solution: ActiveSetSolution) -> None:
    kept = Assemblies(problem)
    energy = parts.add("A", lambda: kept.energy_at(SECOND))
    alpha = parts.add("α", lambda: kept.coercivity_at(SECOND))
    gamma = parts.add("γ", lambda: kept.continuity_at(SECOND))
    beta = parts.add("β_A", lambda: kept.energy_inf_sup_at(SECOND))
    u, lam = 0.99 * solution.u, 1.02 * solution.lam  # a pair that is not the solution
    bounds = parts.add("bounds", lambda: bound_errors_at(kept.at(SECOND), energy, alpha, beta, u, lam))
    assert np.isfinite(bounds.lam)
    constants = {"α": alpha, "γ": gamma, "β_A": beta}
    named = ", ".join(
        f"{name} {one.value:.4g}{'' if one.proved else ' (not proved)'}" for name, one in constants.items()
    )
    times = sum(parts.seconds[name] for name in JUDGING) / parts.seconds["solution"]
    without = times - parts.seconds["γ"] / parts.seconds["solution"]
    print(f"{parts.mesh}: {named}; constants and bounds take {times:.2f} times a solution, {without:.2f} times "
          "without γ, which no bound needs", flush=True)  # fmt: skip


def main(resolutions: Sequence[str]) -> None:
    """Measure, and print exponents from every mesh to the next."""
    found = [measure(resolution) for resolution in resolutions]
    for (n, before), (finer, after) in pairwise(found):
        exponents = {name: np.log(after[name] / before[name]) / np.log(finer / n) for name in after}
        print(f"{n} → {finer} unknowns: " + ", ".join(f"{name} {value:.2f}" for name, value in exponents.items()))


if __name__ == "__main__":
    main(sys.argv[1:] or RESOLUTIONS)
