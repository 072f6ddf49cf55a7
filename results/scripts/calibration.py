"""Chains of the high-fidelity model and of certified decisions, compared state by state.

    python results/scripts/calibration.py results/calibration

computes the chains of the high-fidelity model that the folder lacks (1 to 4 CPU minutes each), the same chains with
decisions of reduced models, and the table of both. Rows that the table has are kept: an interrupted script continues.
One BLAS thread: OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd

import vibench
from vibench.calibration.data import Data, Prior, synthetic
from vibench.calibration.decisions import BoundedSensors, Decisions, Sensors
from vibench.calibration.metropolis import Metropolis

STEPS, BURN_IN, SEED, NOISES = 5000, 1000, 2022, (0.03, 0.01, 0.003)
PROBLEMS = {"obstacle": (1.05, 0.01, -0.02), "hertz": (1.03,)}
TABLE = "chains.csv"
TOLERANCES = {"obstacle": (3e-5, 3e-4), "hertz": (1e-4, 1e-3)}


def data_of(problem: vibench.Problem, truth: tuple[float, ...], noise: float) -> Data:
    """Synthetic data of all linear outputs."""
    names = tuple(output.name for output in problem.outputs if output.linear)
    return synthetic(names, Sensors(problem, names).high_fidelity()(np.array(truth)), noise, SEED)


def chain_of(decisions: Decisions, problem: vibench.Problem) -> tuple[Metropolis, float]:
    """A chain of all steps, and its CPU seconds."""
    chain, began = Metropolis(decisions, Prior.of(problem.parameters), BURN_IN, SEED), process_time()
    while chain.steps < STEPS:
        chain.step()
    return chain, process_time() - began


def reference(file: Path, problem: vibench.Problem, data: Data) -> tuple[np.ndarray, float, int]:
    """States and seconds of the chain of the high-fidelity model, and its solutions; computed once."""
    if not file.exists():
        decisions = Decisions(problem, data, None, 0.0, 0)
        chain, seconds = chain_of(decisions, problem)
        about = json.dumps({"command": "python results/scripts/calibration.py results/calibration"})
        counts = {"seconds": seconds, "solutions": len(decisions.answers)}
        np.savez_compressed(file, states=chain.states, about=about, **counts)
    with np.load(file) as found:
        return found["states"], float(found["seconds"]), int(found["solutions"])


def model_of(problem: vibench.Problem, tolerances: tuple[float, float]) -> tuple[vibench.Model, float]:
    """A certified model, and the CPU seconds of its training."""
    began, (pod, dual) = process_time(), tolerances
    strategies = vibench.create("dual strategy", "mcpg"), vibench.create("primal strategy", "offline-pga")
    stops = vibench.Stop(tolerance=pod), vibench.Stop(tolerance=dual)
    phase = vibench.Reduction(problem, *strategies, *stops, tolerance=0.5, assembly="reduced", bounds=True)
    return phase.model, process_time() - began


def compare(folder: Path) -> None:
    """Add a row for each problem and noise that the table lacks."""
    for name, truth in PROBLEMS.items():
        problem = vibench.create("problem", name, {"resolution": "paper"})
        model, training = None, 0.0
        for noise in NOISES:
            data = data_of(problem, truth, noise)
            states, seconds, solutions = reference(folder / f"{name}-{100 * noise:g}.npz", problem, data)
            if "--reference" in sys.argv or (name, 100 * noise) in known(folder):
                continue
            if model is None:
                model, training = model_of(problem, TOLERANCES[name])
                predict = BoundedSensors(model, data.sensors)
            decisions = Decisions(problem, data, predict, 0.01, 0)
            chain, _ = chain_of(decisions, problem)
            counts, solved = decisions.counts, [spent for _, spent in decisions.answers.values()]
            # Both at the pace of this run: the high-fidelity chain may have been walked in another hour.
            own, seconds = decisions.seconds, float(np.mean(solved)) * solutions
            share = own / seconds
            # Training and this share of the high-fidelity chain are a tenth of it from so many steps on.
            tenth = training / (0.1 - share) / seconds * STEPS if share < 0.1 else np.inf
            row = {
                "problem": name, "noise [%]": 100 * noise, "claim": decisions.claim,
                "states equal": bool(np.array_equal(states, chain.states)), "decisions": counts.decisions,
                "undecided [%]": 100 * counts.undecided / counts.decisions, "questions": len(solved),
                "audits": counts.audits,
                "wrong without bounds": counts.wrong, "query [ms]": 1e3 * counts.model_seconds / (counts.decisions + 1),
                "solution [ms]": 1e3 * float(np.mean(solved)), "queries and questions [s]": own,
                "high-fidelity chain [s]": seconds, "solutions": solutions, "share": share, "training [s]": training,
                "a tenth from [steps]": tenth,
            }  # fmt: skip
            earlier = [pd.read_csv(folder / TABLE)] if (folder / TABLE).exists() else []
            table = pd.concat([*earlier, pd.DataFrame([row])])
            table.to_csv(folder / TABLE, index=False)
            write_page(folder, table)


def known(folder: Path) -> set[tuple[str, float]]:
    """Problem and noise of the rows that the table has."""
    if not (folder / TABLE).exists():
        return set()
    return set(pd.read_csv(folder / TABLE)[["problem", "noise [%]"]].itertuples(index=False, name=None))


def write_page(folder: Path, table: pd.DataFrame) -> None:
    """The page with the table, its columns as rows."""
    shown = table.map(lambda value: f"{value:.3g}" if isinstance(value, float) else str(value)).T
    files = sorted(file.name for file in folder.glob("*.npz"))
    lines = [
        "# Calibration: chains compared state by state", "",
        "    python results/scripts/calibration.py results/calibration", "",
        f"Metropolis chains of {STEPS} steps, the first {BURN_IN} of which adapt, on problems at the paper's size.",
        "The data are synthetic, at (1.05, 0.01, −0.02) of the obstacle and at the radius 1.03 of Hertz. Tolerances of",
        "POD and cone are 3e-5 and 3e-4 for the obstacle, whose bounds interpolation limits, 1e-4 and 1e-3 for Hertz.",
        "",
        "The states of the chains whose decisions the high-fidelity model takes are in",
        f"{', '.join(f'[{name}]({name})' for name in files)}. [The table](chains.csv) has a column for each row below.",
        "Seconds are CPU seconds on a machine with other load, those of the high-fidelity chain at the mean of the",
        "questions. Proposals outside the box are no decisions.", "",
        shown.iloc[1:].to_markdown(headers=["problem", *shown.iloc[0]]), "",
    ]  # fmt: skip
    (folder / "README.md").write_text("\n".join(lines), encoding="utf-8")


def main(folder: str) -> None:
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    compare(target)


if __name__ == "__main__":
    main(sys.argv[1])
