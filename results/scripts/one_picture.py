"""The picture of README: CPU seconds over the number of queries of the full model and of three reduced ones.

python results/scripts/one_picture.py results one-picture.png
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from page import start


def lines(folder: Path, problem: str) -> list[tuple[str, float, float]]:
    """Name, offline seconds and seconds of a query of the full model and of three models with their errors of λ."""
    benefit = pd.read_csv(folder / "benefit" / "cells.csv")
    formulations = pd.read_csv(folder / "formulations" / "cells.csv")
    mine = benefit[(benefit["problem"] == problem) & (benefit["assembly"] == "reduced") & (benefit["dual_tol"] == 1e-2)]
    own = formulations[(formulations["problem"] == problem) & (formulations["training"] == "own")]
    radial = own[(own["formulation"] == "regression (radial)") & (own["dual"] == "mcpg") & (own["dual_tol"] == 1e-2)]
    chosen = {
        "no enrichment": mine[mine["primal"] == "decorrelated"],
        "enriched offline": mine[(mine["primal"] == "offline-pga") & (mine["primal_tol"] == 0.5)],
        "regression": radial,
    }
    plain = chosen["no enrichment"].iloc[0]
    found = [("full model", float(plain["hf_setup_s"]), float(plain["hf_s"]))]
    for name, cells in chosen.items():
        cell = cells.iloc[0]
        error = f"{name}, λ wrong by {100.0 * cell['error_lambda_mean']:.2g} %"
        # Seconds of another machine count in full solutions.
        unit = plain["hf_s"] / cell["hf_s"]
        found.append((error, float(cell["offline_s"] * unit), float(cell["online_s"] * unit)))
    return found


def main(results: str, picture: str) -> None:
    number = np.logspace(0, 5, 200)
    titles = {"obstacle": "membrane over an obstacle, 3,391 unknowns", "hertz": "two elastic discs, 12,171 unknowns"}
    colours = ("black", "#d95f02", "#1b6ca8", "#4d8f3c")
    figure, panels = plt.subplots(1, 2, figsize=(11, 3.6), sharey=True, layout="constrained")
    for panel, (problem, title) in zip(panels, titles.items(), strict=True):
        ends = []
        for (name, offline, online), colour in zip(lines(Path(results), problem), colours, strict=True):
            total = offline + number * online
            panel.loglog(number, total, color=colour, lw=2, ls=":" if name == "full model" else "-")
            ends.append((float(total[-1]), name, colour))
        # Labels at the ends of the curves, a factor of two apart at least.
        place = 0.0
        for end, name, colour in sorted(ends):
            place = max(end, 2.0 * place)
            panel.text(1.3e5, place, name, va="center", color=colour, fontsize=9)
        panel.set(title=title, xlabel="number of queries", xlim=(1.0, 1e5))
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("CPU seconds, offline and all queries")
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    start(main)
