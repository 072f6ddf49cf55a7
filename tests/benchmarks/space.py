"""Seconds of queries of `hertz3d` on two meshes with equal N and R, in turns in one process.

Usage: python tests/benchmarks/space.py [FINER [COUNT]]

The coarser mesh is "medium", the finer one "paper" by default. Models are made of the same 24 training parameters, with
N = 14, R = 14 and as many supremizers, offline or online; COUNT parameters (200 by default) are asked of both in turns,
after some that are not timed. For every model and mesh the median CPU milliseconds of a reduced and of a certified
query, and the ratio; the largest memory of the process at the end.

Usage: python tests/benchmarks/space.py --unseen RESOLUTION [COUNT]

Bounds at online cost of four certified models of one mesh (decorrelated and offline PGA, both tolerances of the study
`three-dimensions`, mCPG, its own training set) at COUNT parameters (1000 by default) that none has seen: violations of
the bounds of u in the energy norm and of λ in the natural one, and median and largest effectivities.
"""

import resource
import sys
import time
from dataclasses import replace

import numpy as np

import vibench
from vibench import solve_qp
from vibench.model.bound_terms import CorrectionMode
from vibench.offline.assemblies import Assemblies
from vibench.offline.reduction import high_fidelity_sweep
from vibench.stages.assessment import is_violated

TRAINING, SIZE, UNTIMED = (2, 2, 2, 3), 14, 20

SOLVER, ACCURACY = "piqp", 1e-10


def reductions(resolution: str) -> dict[str, vibench.Reduction]:
    """Certified reductions on one mesh, by primal strategy, on the same snapshots."""
    problem = vibench.create("problem", "hertz3d", {"resolution": resolution, "factorisation": "pardiso"})
    start, dual = time.process_time(), vibench.create("dual strategy", "mcpg")
    solved = high_fidelity_sweep(problem, problem.parameters.grid(*TRAINING))
    print(f"{resolution}: {problem.V.dim} unknowns, {len(solved.mu)} solutions in {time.process_time() - start:.1f} s")
    made = {}
    for name in ("decorrelated", "online-supremizers"):
        primal = vibench.create("primal strategy", name)
        stops = vibench.Stop(size=SIZE), vibench.Stop(size=SIZE)
        made[name] = vibench.Reduction(problem, dual, primal, *stops, assembly="reduced", bounds=True)
        made[name] = made[name].given(snapshots=solved)
    first = next(iter(made.values()))
    shared = {"snapshots": solved, "certificate_base": first.certificate_base, "members": first.members}
    return {name: replace(reduction).given(**shared) for name, reduction in made.items()}


def timed_query(reduction: vibench.Reduction, mu: np.ndarray) -> tuple[float, float]:
    times = [time.process_time_ns()]
    reduced = reduction.assembled.assemble(mu)
    answer = solve_qp(reduced.program, SOLVER, ACCURACY, factor=reduced.factor)
    times.append(time.process_time_ns())
    alpha = np.maximum(answer.alpha, 0.0)
    reduction.certificate.certify(reduction.problem, mu, reduced, answer.x, alpha, CorrectionMode.NONE)
    times.append(time.process_time_ns())
    query, certificate = 1e-6 * np.diff(times)
    return float(query), float(certificate)


def unseen(resolution: str, count: str = "1000") -> int:
    problem = vibench.create("problem", "hertz3d", {"resolution": resolution, "factorisation": "pardiso"})
    dual, solved = vibench.create("dual strategy", "mcpg"), high_fidelity_sweep(problem, problem.training_set())
    models: dict[str, vibench.Model] = {}
    shared = {"snapshots": solved}
    for tolerance in (1e-2, 1e-3):
        for name, own in (("decorrelated", None), ("offline-pga", 0.5)):
            primal, stop = vibench.create("primal strategy", name), vibench.Stop(tolerance)
            steps = problem, dual, primal, stop, stop, own
            reduction = vibench.Reduction(*steps, assembly="reduced", bounds=True, solver=SOLVER, accuracy=ACCURACY)
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


def main(finer: str = "paper", count: str = "200") -> None:
    meshes = {resolution: reductions(resolution) for resolution in ("medium", finer)}
    mus = meshes["medium"]["decorrelated"].problem.parameters.sample(int(count) + UNTIMED, 2027)
    for name in ("decorrelated", "online-supremizers"):
        timed = np.array([[timed_query(made[name], mu) for made in meshes.values()] for mu in mus])[UNTIMED:]
        timed[:, :, 1] += timed[:, :, 0]
        coarse, fine = np.median(timed, axis=0)
        sizes = [(made[name].pod.basis.shape[1], made[name].cone.generators.shape[1]) for made in meshes.values()]
        print(f"{name}, (N, R) {sizes}: reduced {coarse[0]:.3f} and {fine[0]:.3f} ms, ratio {fine[0] / coarse[0]:.2f}; "
              f"certified {coarse[1]:.3f} and {fine[1]:.3f} ms, ratio {fine[1] / coarse[1]:.2f}")  # fmt: skip
    print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--unseen"]:
        sys.exit(unseen(*sys.argv[2:]))
    main(*sys.argv[1:])
