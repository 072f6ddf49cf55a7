"""Certificates at online cost: violations at random parameters, effectivities, and seconds beside those of a query.

Usage: python tests/benchmarks/certified.py RUN [COUNT]

For every certified cell of a run: bounds of COUNT random parameters (10000 by default) that the model has not seen,
compared with high-fidelity solutions.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import vibench
from vibench.execution.recorded_cell import recorded_cells
from vibench.model.certificates.base import Guarantee
from vibench.stages.assemblies import assemblies

VIOLATION = 1e-10
"""An error above its bound by more than this share of the solution violates it."""

SEED = 2027


def main(run: str, count: int) -> int:
    """Print one line per cell; the number of cells with a violation."""
    failed = 0
    for recorded in recorded_cells(run):
        certificate = recorded.certificate
        if certificate is None:
            continue
        model = vibench.open_run(run).model(recorded.row["cell"])
        problem, violations, without = model.problem, 0, 0
        effectivities, seconds = [], []
        for mu in problem.parameters.sample(count, SEED):
            start = time.process_time_ns()
            reduced = model.reduced.assemble(mu)
            middle = time.process_time_ns()
            solution = model.solve(mu)
            if solution.bound is None or solution.x is None or solution.alpha is None:
                without += 1
                continue
            solved = 1e-9 * (middle - start) + solution.solution.cpu
            start = time.process_time_ns()
            bound = certificate.evaluate(problem, mu, reduced, solution.x, solution.alpha)
            seconds.append((solved, 1e-9 * (time.process_time_ns() - start)))
            if bound.guarantee is Guarantee.NONE:
                without += 1
                continue
            exact, vi = model.high_fidelity(mu), problem.assemble(mu)
            energy = assemblies(problem).energy_at(mu)
            errors = energy.norm(exact.u - solution.u), energy.dual_norm(vi.B.T @ (exact.lam - solution.lam))
            sizes = energy.norm(exact.u), energy.dual_norm(vi.B.T @ exact.lam)
            bounds = bound.u_energy, bound.lambda_natural
            pairs = zip(errors, bounds, sizes, strict=True)
            violations += any(not error <= limit + VIOLATION * size for error, limit, size in pairs)
            effectivities.append((bounds[0] / errors[0], bounds[1] / errors[1]))
        failed += violations > 0
        (of_u, of_lam), (query, certify) = np.median(effectivities, axis=0), 1e3 * np.median(seconds, axis=0)
        least = np.min(effectivities, axis=0)
        print(
            f"{recorded.row['problem']} {recorded.row['cell']} {certificate.base.guarantee.value}: {count} parameters, "
            f"{violations} violations, {without} without a bound; effectivity of u {of_u:.2f} (least {least[0]:.4f}), "
            f"of λ {of_lam:.2f} (least {least[1]:.4f}); query {query:.2f} ms, certificate {certify:.2f} ms",
            flush=True,
        )
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 10_000))
