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
ASSEMBLIES = ("full", "reduced", "certified", "compiled")


class Results:
    """The tables below `results/`, read once; of the study `solvers` alone all solvers, elsewhere PIQP."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def table(self, study: str, name: str = "cells") -> pd.DataFrame:
        """A table of a page, "cells" or another CSV file beside it."""
        frame = pd.read_csv(self.folder / study / f"{name}.csv")
        return frame if "solver" not in frame or study == "solvers" else frame[frame["solver"] == "piqp"]

    @cached_property
    def papers(self) -> dict[str, pd.DataFrame]:
        """The cells of the study of the paper, by problem."""
        return {problem: self.table(f"paper-{problem}") for problem in PROBLEMS}

    @cached_property
    def gains(self) -> pd.DataFrame:
        """The models of `benefit` against the high-fidelity model: errors, gains, break-evens, with intervals."""
        against = self.table("benefit", "thresholds")
        against = against[against["cell_a"].isna()].drop(
            columns=["problem", "solver", "accuracy", "pod_tol", "pod_size"]
        )
        named = against.drop(columns=[name for name in against if name in ("training", "correction", *CONE)])
        return self.table("benefit").merge(named, left_on="cell", right_on="cell_b", how="left", suffixes=("", "_pair"))


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
    """The mean error without enrichment over that with one, for every enriched model in full assembly."""
    table = cells[cells["assembly"] == "full"]
    plain = table[table["primal"] == "decorrelated"].set_index(CONE)[error]
    others = table[table["primal"] != "decorrelated"].set_index(CONE)
    return plain.reindex(others.index) / others[error]


def unavailable(cells: pd.DataFrame) -> str:
    """Why some cells have no program: the reason of the first one, without the stage that gave it."""
    return str(cells["reason"].iloc[0]).partition(": the model ")[2] or str(cells["reason"].iloc[0])
