"""Formulations against plain versions of them, which `tests/helpers/plain_formulations.py` has from their papers.

    python tests/benchmarks/competitors.py [PROBLEM …] [--dual mcpg dictionary] [--pod 1e-3] [--cone 1e-2]
        [--formulations penalty …] [--count 64] [--repeats 3] [--resolution paper]

For every problem and formulation: median CPU seconds of a query of ours and of the plain version, taken in turns at the
same parameters on one thread, their ratio, the steps of ours, and the mean relative errors of u and λ of both. Offline
phases are those of the study `formulations`. Exit code 1 if a query of ours takes more than 1.2 times a plain one that
is as accurate: with a dictionary, whose generators depend on each other, the plain `proximal` does not converge.
"""

import argparse
import os
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # before NumPy is imported
    for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
    sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

import numpy as np
import pandas as pd
import plain_formulations as plain

from vibench import Array, FormulationAnswer, Problem, QuerySettings, Reduction, Snapshots, Stop, create
from vibench.interfaces.formulations import SolveQP
from vibench.offline.models import CellSolver
from vibench.offline.reduction import high_fidelity_sweep
from vibench.results import formats
from vibench.timing import timed

ACCURACY = 1e-8
SLOWER = 1.2


def plain_hyper_reduced(offline: Reduction, solve_qp: SolveQP, built: Mapping[str, Any]) -> plain.Query:
    chi, (rows, weights) = offline.cone.generators, built["rows"]
    tested = np.zeros_like(chi)
    tested[rows] = weights[:, None] * chi[rows]
    return plain.hyper_reduced(offline, solve_qp, built["vectors"], built.get("elements"), tested)


Plain = Callable[[Reduction, SolveQP, Mapping[str, Any]], plain.Query]
FORMULATIONS: dict[str, tuple[str, dict[str, Any], Plain]] = {
    "penalty": ("penalty", {}, lambda offline, _, __: plain.penalty(offline)),
    "proximal": ("proximal", {}, lambda offline, _, __: plain.proximal(offline, ACCURACY)),
    "sparse-dictionary": ("sparse-dictionary", {}, lambda offline, _, __: plain.sparse_dictionary(offline, ACCURACY)),
    "local": ("local", {}, lambda offline, solve_qp, _: plain.local(offline, solve_qp)),
    "regression": ("regression", {}, lambda offline, _, __: plain.gaussian_regression(offline)),
    "regression (radial)": ("regression", {"kind": "radial"}, lambda offline, _, __: plain.radial_regression(offline)),
    "hyper-reduced": ("hyper-reduced", {}, plain_hyper_reduced),
}


def offline_phase(problem: Problem, dual: str, pod: float, cone: float, snapshots: Snapshots) -> Reduction:
    strategies = create("dual strategy", dual), create("primal strategy", "offline-pga")
    stops = Stop(tolerance=pod), Stop(tolerance=cone)
    phase = Reduction(problem, *strategies, *stops, 0.5, assembly="reduced", accuracy=ACCURACY)
    return phase.given(snapshots=snapshots)


def row(name: str, offline: Reduction, mus: Array, exact: Snapshots, repeats: int) -> dict[str, Any]:
    """One row of the table: both versions in turns, of which the quickest of some repetitions counts."""
    plugin, options, plainly = FORMULATIONS[name]
    model = offline.with_formulation(create("formulation", plugin, options)).model
    solve_qp = CellSolver("piqp", ACCURACY)
    settings, query = QuerySettings(ACCURACY, solve_qp), plainly(offline, solve_qp, model.built)
    V, W, seconds, errors = offline.problem.V, offline.problem.W, np.zeros((2, len(mus))), np.zeros((4, len(mus)))
    steps = []
    for k, mu in enumerate(mus):
        turns = []
        for _ in range(repeats):
            answer, ours = timed(partial(model.online.solve, mu, settings))
            found, plain_seconds = timed(partial(query, mu))
            turns.append((ours.cpu, plain_seconds.cpu))
        seconds[:, k] = np.min(turns, axis=0)
        steps.append(answer.iterations or 0)
        if name == "local":
            theirs = found[2](found[0][:, None])[:, 0], found[3] @ found[1]
        else:
            theirs = model.online.reconstruct(mu, FormulationAnswer(*found[:2]))
        u, lam = exact.u[:, k], exact.lam[:, k]
        for which, pair in enumerate((model.online.reconstruct(mu, answer), theirs)):
            errors[which::2, k] = V.norm(pair[0] - u) / V.norm(u), W.norm(pair[1] - lam) / W.norm(lam)
    ours, plain_seconds = np.median(seconds, axis=1)
    measured = {"ours [ms]": 1e3 * ours, "plain [ms]": 1e3 * plain_seconds, "ratio": ours / plain_seconds}
    reached = zip(("error of u", "plain, of u", "error of λ", "plain, of λ"), errors.mean(axis=1), strict=True)
    return {"formulation": name, **measured, "steps": np.median(steps), **dict(reached)}


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("problems", nargs="*", default=["obstacle", "hertz", "bearing", "american-put"])
    parser.add_argument("--dual", nargs="+", default=["mcpg"])
    parser.add_argument("--pod", type=float, default=1e-3)
    parser.add_argument("--cone", type=float, default=1e-2)
    parser.add_argument("--formulations", nargs="+", default=list(FORMULATIONS), choices=FORMULATIONS)
    parser.add_argument("--count", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--resolution", default="paper")
    asked = parser.parse_args()
    slower = False
    for name in asked.problems:
        problem = create("problem", name, {"resolution": asked.resolution})
        mus = problem.validation_set(asked.count, 2022)
        snapshots, exact = high_fidelity_sweep(problem, problem.training_set()), high_fidelity_sweep(problem, mus)
        for dual in asked.dual:
            offline = offline_phase(problem, dual, asked.pod, asked.cone, snapshots)
            mixed, settings = offline.model.online, QuerySettings(ACCURACY, CellSolver("piqp", ACCURACY))
            query = np.median([timed(partial(mixed.solve, mu, settings))[1].cpu for mu in mus])
            sizes = f"{offline.assembled.basis.shape[1]} unknowns, {offline.cone.size} generators"
            print(f"{name} with {dual}: {sizes}, a query of mixed takes {1e3 * query:.3g} ms\n", flush=True)
            table = pd.DataFrame([row(each, offline, mus, exact, asked.repeats) for each in asked.formulations])
            print(formats.to_markdown(table), "\n", flush=True)
            accurate = table["plain, of u"] <= 2.0 * table["error of u"]
            slower = slower or bool((accurate & (table["ratio"] > SLOWER)).any())
    return int(slower)


if __name__ == "__main__":
    sys.exit(main())
