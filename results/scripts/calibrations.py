"""The page of the study `calibration`: what decisions of chains cost the models of its cells.

vibench run calibration --dual-tol 1e-3 --no-figures
python results/scripts/calibrations.py runs/calibration results/calibrations
"""

from __future__ import annotations

import pandas as pd
from page import SECONDS, Page, made_by, origin, read, start

NOISES = (0.03, 0.01, 0.003)
OPTIONS = " --dual-tol 1e-3 --no-figures"
ABOUT = """Metropolis chains of 400 steps by the model of each cell, at three levels of noise. *asked* is the share of
the decisions that bounds leave open; a model without bounds asks always. *wrong* counts decisions that the reduced
model alone takes otherwise than the high-fidelity model. *share* is the CPU time of queries and questions over that
of the high-fidelity chain. Sensors are all linear outputs. On bearing most decisions stay open: errors of its forces
are small, and their bounds, which come from the energy norm, are not. A chain costs about as much as the
high-fidelity one there, and the regression without bounds decides up to a fifth of the steps wrongly."""


def main(run: str, target: str) -> None:
    cells, chains = read(run, "cells"), read(run, "calibrations")
    page = Page(
        target, "Calibration: models compared by what they decide",
        made_by("calibrations", "calibrations", "calibration", options=OPTIONS), SECONDS, ABOUT,
        machine=origin(cells),
    )  # fmt: skip
    fine = int((cells["status"] == "ok").sum())
    page.add(f"{len(cells)} cells, {fine} with every query ok; {chains['noise'].notna().sum()} chains.")
    page.add(compared(cells, chains), f"All chains: {page.link('chains', chains)}.")
    page.write()


def compared(cells: pd.DataFrame, chains: pd.DataFrame) -> pd.DataFrame:
    """A row for each model, at three levels of noise side by side."""
    rows, by_cell = [], dict(list(chains.groupby("cell")))
    for cell in cells.itertuples():
        if (own := by_cell.get(cell.cell)) is None:
            continue
        at = own.dropna(subset="noise").set_index("noise").reindex(NOISES)
        share = at["calibration_s"] / at["hf_chain_s"]
        rows.append({
            "problem": cell.problem, "formulation": cell.formulation,
            "POD, cone": f"{cell.pod_tol:g}, {cell.dual_tol:g}", "(N, R)": f"({cell.N:.0f}, {cell.R:.0f})",
            "asked at 3, 1, 0.3 % [%]": _numbers(100.0 * at["asked"]),
            "wrong": _numbers(at["wrong"]), "share": _numbers(share), "claim at 1 %": at["claim"].get(0.01),
        })  # fmt: skip
    return pd.DataFrame(rows)


def _numbers(values: pd.Series) -> str:
    return ", ".join("–" if pd.isna(one) else f"{one:.3g}" for one in values)


if __name__ == "__main__":
    start(main)
