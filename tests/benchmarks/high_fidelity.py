"""Seconds of the high-fidelity model: set-up and marginal solution against a sweep that is timed as a whole.

    python tests/benchmarks/high_fidelity.py obstacle|hertz [--counts 30 60]

For every number of validation parameters: the set-up, the median marginal solution with its 95 % interval, and the sum
of set-up and marginal seconds over the total of sweeps with a solver of their own, each parameter solved once, before
and after each part of the measurement. CPU seconds on one thread. Exit code 1 if a sum differs from its sweep by more
than 5 %, or the intervals of two numbers of parameters have no point in common.
"""

import argparse
import os
import statistics
import sys

if __name__ == "__main__":  # before NumPy is imported
    for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR"):
        os.environ[f"{library}_NUM_THREADS"] = "1"

import pandas as pd

from vibench.arrays import Array
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.problem import Problem
from vibench.interfaces.validation import checked_assembly
from vibench.plugins.plugin import Plugin
from vibench.results import formats
from vibench.stages.base import build_problem
from vibench.stages.snapshots import SnapshotStage
from vibench.study.parameter_sets import CHUNKS, ParameterSet
from vibench.timing import median_interval, timed

SEED = 2022
TOLERATED = 0.05


def sweep(problem: Problem, mus: Array) -> float:
    """CPU seconds of assembling and solving at every parameter with a new solver, as a user would."""

    def work() -> None:
        solver = HighFidelitySolver(problem)
        for mu in mus:
            solver.remember(mu, solver.solve_assembled(mu, checked_assembly(problem, mu)))

    return timed(work)[1].cpu


def measure(name: str, count: int) -> dict[str, float]:
    """One row: every part of the validation set measured as in a run, its own sweep before and after it."""
    problem = build_problem(Plugin("problem", name, "{}", ""))
    seconds, setups, totals, sums = [], [], 0.0, 0.0
    for chunk in range(CHUNKS):
        stage = SnapshotStage(Plugin("problem", name, "{}", ""), ParameterSet("validation", count, SEED), chunk)
        mus = stage.part(stage.parameters(problem))[1]
        before = sweep(problem, mus)
        found = stage.run(None).value  # type: ignore[arg-type]  # reads no artefact
        totals += 0.5 * (before + sweep(problem, mus))
        sums += sum(s.cpu for s in found.setups) + sum(s.cpu for s in found.seconds)
        seconds += [s.cpu for s in found.seconds]
        setups += [s.cpu for s in found.setups]
    low, high = median_interval(seconds)
    return {
        "parameters": count,
        "set-up [s]": statistics.median(setups),
        "solution [ms]": 1e3 * statistics.median(seconds),
        "from [ms]": 1e3 * low,
        "to [ms]": 1e3 * high,
        "set-ups and solutions [s]": sums,
        "sweeps [s]": totals,
        "ratio": sums / totals,
    }


def main() -> int:
    """Measure and print; 1 if something disagrees."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("problem", choices=("obstacle", "hertz"))
    parser.add_argument("--counts", type=int, nargs="+", default=[30, 60])
    asked = parser.parse_args()
    found = pd.DataFrame([measure(asked.problem, count) for count in asked.counts])
    print(formats.to_markdown(found))
    overlap = found["from [ms]"].max() <= found["to [ms]"].min()
    return int(not overlap or bool((abs(found["ratio"] - 1.0) > TOLERATED).any()))


if __name__ == "__main__":
    sys.exit(main())
