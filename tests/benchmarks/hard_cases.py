"""Hard cases: solutions against ones of 100 digits, and certified models against high-fidelity solutions.

Usage: python tests/benchmarks/hard_cases.py [COUNT [QUERIES [everywhere | PACK...]]]

The first table has beams of 40 to 640 elements, trusses of 40 to 320 bays, and double obstacles with dependent rows and
equalities: how many of QUERIES (20 by default) are ok, and the largest errors of three of them. The second one has
certified models of the smaller ones at COUNT (1000 by default) random parameters: bounds of u in the energy norm and
in V, of λ in the natural norm and in W, at online cost and at that of the mesh, of the pair and of the corrected one.
With model packs, as that of examples/freefem/signorini.edp, it has these and nothing else; with `everywhere` problems
whose constraint touches all or most unknowns.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vibench import AffineProblem, Array, HighFidelitySolver, NumericalError, Problem, create
from vibench.model.error_bounds import bound_errors_at, corrected_pair
from vibench.offline.assemblies import assemblies
from vibench.stability.coercivity import coercivity_and_continuity, energy_inf_sup
from vibench.stages.assessment import is_violated

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))
from decimals import relative_errors
from hard_problems import Beam, DoubleObstacle, Truss
from other_problems import Covered, ThermalBlock, Torsion
from samples import pga_reduction

LARGE: list[AffineProblem] = [
    *(Beam(elements) for elements in (40, 80, 160, 320, 640)),
    *(Truss(bays) for bays in (40, 80, 160, 320)),
    *(DoubleObstacle(nodes) for nodes in (50, 100, 200, 400)),
]
SMALL: list[AffineProblem] = [Beam(40), Truss(40), DoubleObstacle(50), Beam(80), Truss(80), DoubleObstacle(100)]


SEED = 2031


def name(problem: Problem) -> str:
    return f"{type(problem).__name__:14} {problem.V.dim:5} {problem.W.dim:5}"


def solved(problem: Problem, count: int) -> str:
    """How many of the queries are ok, and the largest errors of u and λ in the energy norms."""
    solver, ok, errors, started = HighFidelitySolver(problem), 0, [(0.0, 0.0)], time.process_time()
    mus = problem.parameters.sample(count, SEED)
    for mu in mus:
        try:
            solver.solve(mu)
            ok += 1
        except NumericalError as error:
            print(error)
    seconds = (time.process_time() - started) / count
    for mu in mus[:3]:  # those with a solution of 100 digits
        found = solver.solve(mu)
        errors.append(relative_errors(problem.assemble(mu), found.u, found.lam))
    worst = np.max(errors, axis=0)
    return f"{name(problem)} {ok:4}/{count:<4} {worst[0]:8.1e} {worst[1]:8.1e} {seconds:8.3f}"


def compared(problem: Problem, mus: Array) -> Iterator[tuple[str, float, float, float]]:
    """Kind of a bound, bound, error, and the size that round-off is relative to, of a certified model at `mus`."""
    reduction = pga_reduction(problem, 1e-2, assembly="reduced", bounds=True)
    model, solver, kept, constants = reduction.model, HighFidelitySolver(problem), assemblies(problem), None
    for mu in mus:
        exact, found, corrected = solver.solve(mu), model.solve(mu), model.solve(mu, corrected=True)
        yield "ok", float(found.status == "ok"), 1.0, 1.0
        vi, energy = kept.at(mu), kept.energy_at(mu)
        if constants is None or "A" not in problem.constant:
            constants = coercivity_and_continuity(vi.A, problem.V)[0], energy_inf_sup(vi.A, vi.B, problem.W)
        pair = corrected_pair(vi, energy, found.u, found.lam)
        both = ("online", found), ("online, corrected", corrected)
        online = [(which, one.u, one.lam, one.bound) for which, one in both]
        at_mesh = [("mesh", found.u, found.lam)] + [("mesh, corrected", pair.u, pair.lam) for pair in [pair] if pair]
        bounds = [*online, *((*of, bound_errors_at(problem.V, vi, energy, *constants, *of[1:])) for of in at_mesh)]
        sizes = energy.norm(exact.u), energy.dual_norm(vi.B.T @ exact.lam)
        for which, u, lam, bound in bounds:
            force = energy.dual_norm(vi.B.T @ (exact.lam - lam))
            yield f"{which}: u", bound.u_energy, energy.norm(exact.u - u), sizes[0]
            yield f"{which}: λ", bound.lambda_natural, force, sizes[1]
            yield f"{which}: λ in W", bound.lam, *(float(problem.W.norm(of)) for of in (exact.lam - lam, exact.lam))
            if which.startswith("mesh"):
                yield f"{which}: u in V", bound.u, *(float(problem.V.norm(of)) for of in (exact.u - u, exact.u))


def certified(problem: Problem, count: int) -> Iterator[str]:
    """Rows of the second table: queries, those without a bound, violations, and effectivities."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    for which, *numbers in compared(problem, problem.parameters.sample(count, SEED)):
        found.setdefault(which, []).append((numbers[0], numbers[1], numbers[2]))
    ok = np.array(found.pop("ok"))[:, 0]
    yield f"{name(problem)}: {int(ok.sum())} of {count} queries ok"
    for which, rows in found.items():
        bound, error, size = np.array(rows).T
        has = np.isfinite(bound)
        violated = has & is_violated(error, bound, size)
        measurable = has & (error > 1e-8 * size)
        of = bound[measurable] / error[measurable]
        spread = " ".join(f"{value:9.3g}" for value in np.percentile(of, [0, 50, 100])) if len(of) else "none"
        yield f"    {which:26} {np.count_nonzero(~has):6} {np.count_nonzero(violated):6}   {spread}"


def main(count: int = 1000, queries: int = 20, *packs: str) -> None:
    if not packs:
        print("problem            n     m   ok        error u  error λ  CPU s per query")
        for problem in LARGE:
            print(solved(problem, queries), flush=True)
    print("\nproblem, bound: without, violated, effectivity min, median, max")
    if packs == ("everywhere",):
        built_in = [create("problem", name, {"resolution": "coarse"}) for name in ("bearing", "american-put")]
        problems = [ThermalBlock(), *built_in, Torsion(), Covered()]
    else:
        problems = [create("problem", "pack", {"path": path}) for path in packs] or SMALL
    for problem in problems:
        print(*certified(problem, count), sep="\n", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]), *sys.argv[3:])
