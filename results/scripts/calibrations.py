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
of the high-fidelity chain. Sensors are all linear outputs. Bounds come from the energy norm: on the bearing they are
large beside the errors of its forces."""


def main(run: str, target: str) -> None:
    cells, chains = read(run, "cells"), read(run, "calibrations")
    page = Page(
        target, "Which models serve a calibration?",
        made_by("calibrations", "calibrations", "calibration", options=OPTIONS), SECONDS, ABOUT,
        f"{len(cells)} cells, {int((cells['status'] == 'ok').sum())} with every query ok; "
        f"{chains['noise'].notna().sum()} chains.",
        machine=origin(cells),
    )  # fmt: skip
    own = chains.merge(cells[["cell", "problem", "formulation"]], on="cell", suffixes=("", "_of_cell"))
    own = own[own["noise"] == NOISES[1]].assign(share=own["calibration_s"] / own["hf_chain_s"])
    bounded = own[own["formulation"] == "mixed"].groupby("problem")["share"].min()
    wrong = own.loc[own["formulation"] == "regression"].groupby("problem")["wrong"].max()
    assert bounded["bearing"] > 1.0
    page.answer(
        "At 1 % noise the best model with bounds takes "
        f"{' and '.join(f'{bounded[name]:.2g} of the exact chain on {name}' for name in ('obstacle', 'hertz'))}. "
        f"On the bearing it saves nothing. Regression has no bounds: alone it decides up to {wrong.max():.0f} of 400 "
        "steps wrongly.",
        compared(cells, chains),
    )
    page.file("chains", "all chains", chains)
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
