"""How far break-evens of several cold runs of one study on one machine agree.

    python tests/benchmarks/repeatability.py RUN… [--loaded RUN]

Prints how many rows of each run are undecided, how often intervals of one break-even overlap and contradict each other
over all pairs of runs, by how much gains differ between the runs that had a core of their own, those that are not named
by `--loaded`, and the scatter of the gains over all runs beyond what their blocks show.
"""

import argparse
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

from vibench import open_run
from vibench.report.differences import Agreement, agreement
from vibench.results.break_even import HIGH_FIDELITY, Meaning
from vibench.results.paired_timing import PairedTiming


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--loaded", action="append", default=[], type=Path)
    asked = parser.parse_args()
    runs = {path: open_run(path) for path in (*asked.runs, *asked.loaded)}
    every = {path: run.thresholds for path, run in runs.items()}
    quiet = [every[path] for path in asked.runs]
    for path, rows in every.items():
        meanings = rows["meaning"].value_counts().to_dict()
        undecided = meanings.get(Meaning.UNDECIDED, 0) / len(rows)
        print(f"{path.name}: {len(rows)} rows, {undecided:.1%} undecided: {meanings}")
    total = Agreement(*map(sum, zip(*(agreement(*two) for two in combinations(every.values(), 2)), strict=True)))
    print(
        f"{total.overlapping} of {total.both} pairs of intervals overlap, {total.opposite} of {total.decided} pairs of "
        "decided rows are opposite"
    )
    timings = [PairedTiming(run.table("timings").to_dict("records")) for run in runs.values()]
    for models, others in (("the high-fidelity model", False), ("other models", True)):
        print(f"gains against {models}: {spread(quiet, others=others)}")
        print(f"  standard deviation beyond their blocks: {beyond_blocks(timings, quiet[0], others=others):.1%}")


def spread(runs: list[pd.DataFrame], *, others: bool) -> str:
    """How much larger the largest gain of a row is than the smallest one over all runs: quantiles over the rows."""
    chosen = (rows[(rows["primal_a"] == HIGH_FIDELITY) != others] for rows in runs)
    columns = [rows.set_index(["cell_a", "cell_b"])["gain"] for rows in chosen]
    gains = pd.concat(columns, axis=1, join="inner").to_numpy(dtype=float)
    factors = np.max(gains, axis=1) / np.min(gains, axis=1) - 1.0
    half, most, largest = np.quantile(factors, (0.5, 0.95, 1.0))
    within = np.mean(factors <= 0.15)
    return f"{half:.1%}, {most:.1%}, {largest:.1%} (median, 95 %, largest of {len(gains)}); {within:.0%} within 15 %"


def beyond_blocks(runs: list[PairedTiming], rows: pd.DataFrame, *, others: bool) -> float:
    """Standard deviation of the logarithm of a gain over the runs, without the variance that blocks account for."""
    excess = list[float]()
    for a, b in rows[(rows["primal_a"] == HIGH_FIDELITY) != others][["cell_a", "cell_b"]].itertuples(index=False):
        estimates = [run.ratio_within(a if others else None, b) for run in runs]
        if None not in estimates:
            means, errors = np.array([(one.mean, one.error) for one in estimates if one is not None]).T
            excess.append(float(np.var(means, ddof=1) - np.mean(errors**2)))
    return float(np.sqrt(max(0.0, np.mean(excess))))


if __name__ == "__main__":
    main()
