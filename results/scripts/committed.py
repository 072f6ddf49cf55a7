"""The tables that are committed below `results/`, and numbers in sentences: what pages of conclusions are made from."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

PROBLEMS = ("obstacle", "hertz")
CONE = ["dual", "pod_tol", "pod_size", "dual_tol", "dual_size"]
MODEL = ["problem", *CONE, "primal", "primal_tol"]
CONTROL = "pod-dual (negative control)"
GAINS = ["gain", "gain_low", "gain_high", "benefit_threshold", "threshold_low", "threshold_high", "meaning"]
ASSEMBLIES = ("full", "reduced", "certified", "compiled")


class Results:
    """The tables below `results/`, read once; of the study `solvers` alone all solvers, elsewhere PIQP or none."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._read: dict[tuple[str, str], pd.DataFrame] = {}

    def table(self, study: str, name: str = "cells") -> pd.DataFrame:
        """A table of a page, "cells" or another CSV file beside it."""
        if (study, name) not in self._read:
            frame = pd.read_csv(self.folder / study / f"{name}.csv")
            # Formulations without a solver have rows of their own, and compete.
            everything = "solver" not in frame or study == "solvers"
            self._read[study, name] = frame if everything else frame[frame["solver"].isin(["piqp", "–"])]
        return self._read[study, name]

    @cached_property
    def papers(self) -> dict[str, pd.DataFrame]:
        """The cells of the study of the paper, by problem."""
        return {problem: self.table(f"paper-{problem}") for problem in PROBLEMS}

    @cached_property
    def full(self) -> dict[str, pd.DataFrame]:
        """The cells of that study and of `benefit` in full assembly, by problem, with the study."""
        benefit = self.table("benefit").assign(study="benefit")
        every = pd.concat([benefit, *(cells.assign(study="paper") for cells in self.papers.values())])
        full = every[every["assembly"] == "full"]
        return {problem: full[full["problem"] == problem] for problem in PROBLEMS}

    @cached_property
    def gains(self) -> pd.DataFrame:
        """The models of `benefit` with their gains."""
        return self.gains_of("benefit")

    def gains_of(self, study: str) -> pd.DataFrame:
        """The models of a study against the high-fidelity model: errors, gains, break-evens, with intervals."""
        against = self.against(study)[["cell_b", *GAINS]]
        return self.table(study).merge(against, left_on="cell", right_on="cell_b", how="left")

    @cached_property
    def cones(self) -> pd.DataFrame:
        """The cells of `field` with cones in W⁺, online supremizers and reduced assembly."""
        cells = self.table("field")
        kept = (cells["primal"] == "online-supremizers") & (cells["assembly"] == "reduced")
        return cells[kept & (cells["dual"] != CONTROL)]

    def against(self, study: str) -> pd.DataFrame:
        """The break-evens of a study with the high-fidelity model."""
        pairs = self.table(study, "thresholds")
        return pairs[pairs["cell_a"].isna()]


def number(value: float, digits: int = 2) -> str:
    """A number in as many digits, without an exponent where it is between 1e-3 and 1e5."""
    rounded = float(f"{value:.{digits}g}")
    return (
        f"{rounded:g}"
        if rounded == 0.0 or not 1e-3 <= abs(rounded) < 1e5
        else f"{rounded:.10f}".rstrip("0").rstrip(".")
    )


def span(values: Iterable[float], digits: int = 2) -> str:
    """The smallest and the largest of some numbers."""
    low, high = (number(float(end(list(values))), digits) for end in (np.nanmin, np.nanmax))
    return low if low == high else f"{low} to {high}"


def of(part: int, whole: int) -> str:
    """How many of how many."""
    return f"all {whole}" if part == whole else f"none of {whole}" if part == 0 else f"{part} of {whole}"


def surely_above_one(pairs: pd.DataFrame) -> str:
    """In how many of some comparisons the 95 % interval of the gain is above 1."""
    return of(int((pairs["gain_low"] > 1.0).sum()), len(pairs))


def interval(middle: float, low: float, high: float) -> str:
    """A number with its 95 % interval."""
    if np.isnan(middle):
        return "–"
    return f"{number(middle)} ({number(low)}–{number(high)})"


def when(row: pd.Series) -> str:
    """From how many queries on a model is cheaper in total than high-fidelity solutions."""
    if row["meaning"] in ("from", "until"):
        return f"{row['meaning']} {interval(row['benefit_threshold'], row['threshold_low'], row['threshold_high'])}"
    return str(row["meaning"])


def enriched(cells: pd.DataFrame, error: str) -> pd.Series:
    """The mean error without enrichment over that with one, for every enriched model of a study."""
    table = cells.set_index(["study", *CONE])
    is_plain = table["primal"] == "decorrelated"
    others = table[~is_plain]
    return table.loc[is_plain, error].reindex(others.index) / others[error]


def unavailable(cells: pd.DataFrame) -> str:
    """Why some cells have no program: the reason of the first one, without the stage that gave it."""
    return str(cells["reason"].iloc[0]).partition(": the model ")[2] or str(cells["reason"].iloc[0])
