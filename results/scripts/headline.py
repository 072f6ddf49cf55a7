"""The tables of the README: reduced models of the obstacle at two tolerances, and queries against the best alternative.

python results/scripts/headline.py runs/paper-obstacle runs/benefit
"""

from __future__ import annotations

from typing import Any

import pandas as pd
from page import start

from vibench.report.figures.data import label
from vibench.results import formats, tables

LOOSE, TIGHT = 1e-3, 1e-6
"""δ_POD of the two pairs that are shown."""


def main(paper_obstacle: str, benefit: str) -> None:
    for run, table in ((paper_obstacle, models), (benefit, gains)):
        print(formats.to_markdown(table(tables.read(tables.results_file(run), "cells"))))


def models(cells: pd.DataFrame) -> pd.DataFrame:
    """The high-fidelity model, and those of mCPG with PIQP at the loosest and the tightest tolerance of the POD."""
    chosen = cells[(cells["solver"] == "piqp") & (cells["dual"] == "mcpg") & (cells["dual_tol"] == 1e-2)]
    chosen = tables.in_order(chosen[chosen["pod_tol"].isin([LOOSE, TIGHT])]).sort_values("N", kind="stable")
    first = chosen.iloc[0]
    rows: list[dict[str, Any]] = [
        {"model": "high-fidelity", "offline [s]": first["hf_setup_s"], "query [ms]": 1e3 * first["hf_s"]}
    ]
    for cell in chosen.to_dict("records"):
        if cell["primal"] == "offline-pga" and cell["primal_tol"] != 1e-3:
            continue
        rows.append(
            {
                "model": label(cell["primal"], cell["primal_tol"]), "N": cell["N"], "R": cell["R"],
                "added": cell["enrichment"], "min β over the span": cell["beta_span_min"],
                "min β over the cone": cell["beta_cone_lower_min"], "error of u": cell["error_u_mean"],
                "error of λ": cell["error_lambda_mean"], "offline [s]": cell["offline_s"],
                "query [ms]": 1e3 * cell["online_s"],
            }
        )  # fmt: skip
    return pd.DataFrame(rows)[[*rows[1]]].astype({"N": "Int64", "R": "Int64", "added": "Int64"})


def gains(cells: pd.DataFrame) -> pd.DataFrame:
    """The fastest query of each problem with full and with reduced assembly, against a high-fidelity solution."""
    rows = []
    for problem, mine in cells[cells["enrichment_kind"] == "fixed"].groupby("problem"):
        fastest = {how: group.loc[group["online_s"].idxmin()] for how, group in mine.groupby("assembly")}
        model = 1e3 * float(mine["hf_s"].iloc[0])
        for how, cell in fastest.items():
            query = 1e3 * float(cell["online_s"])
            rows.append(
                {
                    "problem": problem, "assembly": how, "enrichment": label(cell["primal"], cell["primal_tol"]),
                    "query [ms]": query, "high-fidelity solution [ms]": model, "gain": model / query,
                    "offline [s]": cell["offline_s"], "set-up of the high-fidelity solver [s]": cell["hf_setup_s"],
                }
            )  # fmt: skip
    return pd.DataFrame(rows)


if __name__ == "__main__":
    start(main)
