"""Chains of the high-fidelity model and of certified decisions, compared state by state.

    python results/scripts/calibration.py results/calibration

computes the chains of the high-fidelity model that the folder lacks (1 to 4 CPU minutes each), the same chains with
decisions of reduced models, and the table of both. Rows that the table has are kept: an interrupted script continues.
One BLAS thread: OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import json
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd
from page import Page, made_by, start

import vibench
from vibench.calibration.data import Data, Prior, Sensors, synthetic
from vibench.calibration.decisions import Decisions, Predict, quickest_sensors
from vibench.calibration.metropolis import Metropolis
from vibench.timing import Stopwatch

STEPS, BURN_IN, SEED, NOISES = 5000, 1000, 2022, (0.03, 0.01, 0.003)
PROBLEMS = {"obstacle": (1.05, 0.01, -0.02), "hertz": (1.03,)}
TABLE = "chains.csv"
SHOWN = ["claim", "states equal", "undecided [%]", "wrong without bounds", "query [ms]", "solution [ms]", "share"]
TOLERANCES = {
    "obstacle": ((1e-4, 1e-2), (1e-5, 3e-3), (1e-6, 1e-3)), "hertz": ((1e-3, 1e-2), (1e-5, 1e-3), (1e-5, 3e-4)),
}  # fmt: skip
ABOUT = f"""Metropolis chains of {STEPS} steps, the first {BURN_IN} of which adapt, on problems at the paper's size. The
data are synthetic, at (1.05, 0.01, −0.02) of the obstacle and at the radius 1.03 of Hertz. Three models decide, each
where those before it leave a decision open. Their tolerances of POD and cone are (1e-4, 1e-2), (1e-5, 3e-3) and
(1e-6, 1e-3) for the obstacle, (1e-3, 1e-2), (1e-5, 1e-3) and (1e-5, 3e-4) for Hertz. The training is that of all
three, each by itself, with the compilation of their programs. Seconds are CPU seconds on a machine with other load,
those of the high-fidelity chain at the mean of the questions. Proposals outside the box are no decisions."""


def chain_of(decisions: Decisions, problem: vibench.Problem) -> tuple[Metropolis, float]:
    """A chain of all steps, and its CPU seconds."""
    chain, began = Metropolis(decisions, Prior.of(problem.parameters), BURN_IN, SEED), process_time()
    while chain.steps < STEPS:
        chain.step()
    return chain, process_time() - began


def reference(file: Path, problem: vibench.Problem, data: Data) -> tuple[np.ndarray, float, int]:
    """States and seconds of the chain of the high-fidelity model, and its solutions; computed once."""
    if not file.exists():
        decisions = Decisions(problem, data, (), 0.0, 0)
        chain, seconds = chain_of(decisions, problem)
        about = json.dumps({"command": made_by("calibration", "calibration")})
        counts = {"seconds": seconds, "solutions": len(decisions.answers)}
        np.savez_compressed(file, states=chain.states, about=about, **counts)
    with np.load(file) as found:
        return found["states"], float(found["seconds"]), int(found["solutions"])


def sensors_of(
    problem: vibench.Problem, tolerances: tuple[tuple[float, float], ...], names: tuple[str, ...]
) -> tuple[list[Predict], str, float]:
    """Outputs of models with bounds, how they answer, and the CPU seconds of training and compiling."""
    # The compiler is another process, which counts, too.
    watch, found = Stopwatch(), []
    for pod, dual in tolerances:
        strategies = vibench.create("dual strategy", "mcpg"), vibench.create("primal strategy", "offline-pga")
        stops = vibench.Stop(tolerance=pod), vibench.Stop(tolerance=dual)
        phase = vibench.Reduction(problem, *strategies, *stops, tolerance=0.5, assembly="reduced", bounds=True)
        found.append(quickest_sensors(phase.model, names))
    return [predict for predict, _ in found], ", ".join(sorted({by for _, by in found})), watch.seconds().cpu


def compare(folder: Path) -> None:
    """Add a row for each problem and noise that the table lacks."""
    for name, truth in PROBLEMS.items():
        problem = vibench.create("problem", name, {"resolution": "paper"})
        predicts: list[Predict] = []
        by, training, exact = "", 0.0, Sensors(problem)(np.array(truth))
        for noise in NOISES:
            data = synthetic(problem, exact, noise, SEED)
            states, seconds, solutions = reference(folder / f"{name}-{100 * noise:g}.npz", problem, data)
            if (name, 100 * noise) in known(folder):
                continue
            if not predicts:
                predicts, by, training = sensors_of(problem, TOLERANCES[name], data.sensors)
            decisions = Decisions(problem, data, predicts, 0.01, 0)
            chain, _ = chain_of(decisions, problem)
            counts, solved = decisions.counts, [spent for _, spent in decisions.answers.values()]
            # Both at the pace of this run: the high-fidelity chain may have been walked in another hour.
            own, seconds = decisions.seconds, decisions.high_fidelity_seconds
            share = own / seconds
            # Training and this share of the high-fidelity chain are a tenth of it from so many steps on.
            tenth = training / (0.1 - share) / seconds * STEPS if share < 0.1 else np.inf
            # A proposal is a product of matrices, whose last digits depend on the processor.
            same = bool(np.allclose(states, chain.states, rtol=1e-12, atol=0.0))
            row = {
                "problem": name, "noise [%]": 100 * noise, "claim": decisions.claim, "answers": by,
                "states equal": same, "decisions": counts.decisions,
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
    heads = [f"{problem}, {noise:g} %" for problem, noise in zip(table["problem"], table["noise [%]"], strict=True)]
    shown = table[SHOWN].T.set_axis(heads, axis=1)
    page = Page(
        folder, "Do chains of certified decisions equal the exact ones?", made_by("calibration", "calibration"), ABOUT
    )
    at = table[table["noise [%]"] == 100 * NOISES[1]].set_index("problem")["share"]
    page.answer(
        f"{int(table['states equal'].sum())} of {len(table)} chains of {STEPS:,} steps equal the chain of the "
        "high-fidelity model, state by state. At 1 % noise they take "
        f"{' and '.join(f'{share:.2g} of its seconds on {problem}' for problem, share in at.items())}.",
        shown.rename_axis("problem, noise").reset_index(),
    )
    page.also(f"[{TABLE}]({TABLE})", "the same and more, a row for each chain")
    for file in sorted(folder.glob("*.npz")):
        page.also(f"[{file.name}]({file.name})", "states of the chain whose decisions the high-fidelity model takes")
    page.write()


def main(target: str) -> None:
    folder = Path(target)
    folder.mkdir(parents=True, exist_ok=True)
    compare(folder)


if __name__ == "__main__":
    start(main)
