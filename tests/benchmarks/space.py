"""Bounds at online cost of four certified models of `hertz3d` on one mesh, at parameters that none has seen.

Usage: python tests/benchmarks/space.py RESOLUTION [COUNT]

The models are decorrelated and of offline PGA, with both tolerances of the study `three-dimensions`, mCPG and its own
training set. For COUNT parameters (1000 by default): violations of the bounds of u in the energy norm and of λ in the
natural one, and median and largest effectivities.
"""

import sys

import numpy as np

import vibench
from vibench.offline.assemblies import Assemblies
from vibench.offline.reduction import high_fidelity_sweep
from vibench.stages.assessment import is_violated


def main(resolution: str, count: str = "1000") -> int:
    problem = vibench.create("problem", "hertz3d", {"resolution": resolution, "factorisation": "pardiso"})
    dual, solved = vibench.create("dual strategy", "mcpg"), high_fidelity_sweep(problem, problem.training_set())
    models: dict[str, vibench.Model] = {}
    shared = {"snapshots": solved}
    for tolerance in (1e-2, 1e-3):
        for name, own in (("decorrelated", None), ("offline-pga", 0.5)):
            primal, stop = vibench.create("primal strategy", name), vibench.Stop(tolerance)
            steps = problem, dual, primal, stop, stop, own
            reduction = vibench.Reduction(*steps, assembly="reduced", bounds=True, solver="piqp", accuracy=1e-10)
            reduction = reduction.given(**shared)
            shared |= {"members": reduction.members, "certificate_base": reduction.certificate_base}
            models[f"{name}, {tolerance:g}"] = reduction.model
    solver, kept, every = vibench.HighFidelitySolver(problem), Assemblies(problem), []
    violations = dict.fromkeys(models, 0)
    for mu in problem.parameters.sample(int(count), 2027):
        exact, vi, energy, row = solver.solve(mu), kept.at(mu), kept.energy_at(mu), []
        on, size = energy.contact_form(vi), energy.norm(exact.u)
        for name, model in models.items():
            found = model.solve(mu)
            errors = energy.norm(exact.u - found.u), on.force_representer(exact.lam - found.lam).norm
            bounds = found.bound.u_energy, found.bound.lambda_natural
            violations[name] += any(is_violated(e, b, size) for e, b in zip(errors, bounds, strict=True))
            row.append([b / e for e, b in zip(errors, bounds, strict=True)])
        every.append(row)
    medians, largest = np.median(every, axis=0), np.max(every, axis=0)
    for k, name in enumerate(models):
        print(
            f"{resolution}, {name}: {count} parameters, {violations[name]} violations; effectivity of u "
            f"{medians[k, 0]:.2f} (at most {largest[k, 0]:.3g}), of λ {medians[k, 1]:.2f} (at most {largest[k, 1]:.3g})"
        )
    return sum(violations.values())


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
