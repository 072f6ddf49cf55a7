"""CPU seconds of the constants and error bounds at one new parameter, in high-fidelity solutions at the same one.

    python tests/benchmarks/elastic_block.py block|obstacle|hertz [--cells 21] [--count 3]

The block is an elastic cube on a fixed floor, of trilinear hexahedra, pressed from above by a rigid paraboloid; A is
affine in Lamé's constants. With 21 cells along an edge it has about 30,000 unknowns. One solution is assembly,
factorisation and active sets at a parameter at which nothing is known; what does not depend on the parameter, such as
factors of X_V, is known before both. On one thread.
"""

import argparse
import os
import statistics

if __name__ == "__main__":  # before NumPy is imported
    for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR"):
        os.environ[f"{library}_NUM_THREADS"] = "1"

from functools import partial

import numpy as np
from skfem import Basis, ElementHex1, ElementVector, MeshHex
from skfem.models.elasticity import linear_elasticity

from vibench import AffineProblem, Array, InnerProduct, ParameterBox, Problem, checked_assembly, fem
from vibench.highfidelity.active_set import ActiveSetSolution, HighFidelitySolver
from vibench.model.error_bounds import ErrorBounds, bound_errors_at
from vibench.offline.assemblies import Assemblies
from vibench.plugins.plugin import Plugin
from vibench.stages.base import build_problem
from vibench.timing import timed


class Block(AffineProblem):
    """A unit cube on a fixed floor, pressed by a rigid paraboloid of radius 1; the depth and Lamé's constants vary."""

    parameters = ParameterBox(
        ("lame", "shear", "depth"), np.array([0.5, 0.5, 0.02]), np.array([2.0, 2.0, 0.06]), ("Pa", "Pa", "m")
    )

    def __init__(self, cells: int = 21) -> None:
        mesh = MeshHex.init_tensor(*[np.linspace(0.0, 1.0, cells + 1)] * 3)
        basis = Basis(mesh, ElementVector(ElementHex1()))
        free = basis.complement_dofs(basis.get_dofs(lambda x: x[2] == 0.0))
        contact = fem.normal_constraint(basis, mesh.facets_satisfying(lambda x: x[2] == 1.0), free=free)
        self.V, self.W = InnerProduct(fem.h1_gram(basis, free)), contact.W
        gap = 0.5 * np.sum((contact.points[:2] - 0.5) ** 2, axis=0)
        A = [
            ("lame", linear_elasticity(1.0, 0.0).assemble(basis)),
            ("shear", linear_elasticity(0.0, 1.0).assemble(basis)),
        ]
        g = [(1.0, contact.bound(gap)), ("-depth", contact.bound(np.ones_like(gap)))]
        self.declare(A=A, f=np.zeros(basis.N), B=contact.B, g=g, free=free)

    def training_set(self) -> Array:
        return self.parameters.grid(2, 2, 2)


def measure(problem: Problem, count: int) -> None:
    box, ratios = problem.parameters, []
    mus = box.lower + np.random.default_rng(2022).random((count + 1, len(box.lower))) * (box.upper - box.lower)
    solver, kept = HighFidelitySolver(problem), Assemblies(problem)
    solver.solve(mus[0])
    _judged(problem.V, kept, mus[0], *_approximation(solver.solve(mus[0])))  # what is known of the problem
    for mu in mus[1:]:
        solution, once = timed(partial(_solved, solver, problem, mu))
        (bounds, parts), judging = timed(partial(_judged, problem.V, kept, mu, *_approximation(solution)))
        ratios.append(judging.cpu / once.cpu)
        named = ", ".join(f"{name} {seconds:.3f}" for name, seconds in parts.items())
        print(f"solution {once.cpu:.3f} s, constants and bounds {judging.cpu:.3f} s ({named}): {ratios[-1]:.2f} times")
        assert np.isfinite(bounds.lam)
    print(f"n = {problem.V.dim}, m = {problem.W.dim}: {statistics.median(ratios):.2f} times, the median of {count}")


def _solved(solver: HighFidelitySolver, problem: Problem, mu: Array) -> ActiveSetSolution:
    return solver.solve_assembled(mu, checked_assembly(problem, mu))


def _approximation(solution: ActiveSetSolution) -> tuple[Array, Array]:
    return 0.99 * solution.u, 1.02 * solution.lam


def _judged(V: InnerProduct, kept: Assemblies, mu: Array, u: Array, lam: Array) -> tuple[ErrorBounds, dict[str, float]]:
    """The error bounds of u (n,) and λ (m,), and the CPU seconds of their parts."""
    energy, factorising = timed(lambda: kept.energy_at(mu))
    alpha, of_alpha = timed(lambda: kept.coercivity_at(mu))
    beta, of_beta = timed(lambda: kept.energy_inf_sup_at(mu))
    bounds, of_bounds = timed(lambda: bound_errors_at(V, kept.at(mu), energy, alpha, beta, u, lam))
    parts = {"A": factorising, "α": of_alpha, "β_A": of_beta, "bounds": of_bounds}
    return bounds, {name: seconds.cpu for name, seconds in parts.items()}


def main() -> None:

    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("problem", choices=["block", "obstacle", "hertz"])
    parser.add_argument("--cells", type=int, default=21)
    parser.add_argument("--count", type=int, default=3)
    given = parser.parse_args()
    is_block = given.problem == "block"
    measure(Block(given.cells) if is_block else build_problem(Plugin("problem", given.problem, "{}", "")), given.count)


if __name__ == "__main__":
    main()
