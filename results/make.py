"""Put the tables and figures of a finished run under results/, with the paper's figures beside ours.

vibench run paper-obstacle && python results/make.py runs/paper-obstacle results/paper-obstacle
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pandas as pd

from vibench import figures, tables
from vibench.schema import TABLES
from vibench.thresholds import benefit_threshold

PUBLISHED = {
    "paper-obstacle": {
        "title": "Table 1 of Niakh, Drouet, Ehrlacher and Ern (2022), δ_PGA = 1e-3, beside ours",
        "dual": "mcpg",
        "tight": 1e-3,
        # (δ_POD, δ_mCPG): (N, R), offline seconds (on, off), seconds of one query (on, off), benefit threshold
        "rows": {
            (1e-3, 1e-2): ((19, 50), (1112.0, 2296.0), (14.0, 2.4), 102),
            (1e-4, 1e-3): ((51, 70), (1193.0, 2395.0), (17.0, 2.5), 83),
            (1e-6, 1e-2): ((89, 50), (1272.0, 1884.0), (14.0, 2.3), 52),
        },
    }
}
"""What the paper prints; seconds on its authors' machine."""

SOLVER = "piqp"
"""The solver whose seconds stand beside the paper's: the only one of the study that solved every query."""


def main() -> None:
    if len(sys.argv) != 3:
        sys.exit("usage: python results/make.py RUN_FOLDER TARGET_FOLDER")
    path, target = tables.results_file(sys.argv[1]), Path(sys.argv[2])
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for table in TABLES:
        frame = tables.in_order(tables.read(path, table))
        frame.to_csv(target / f"{table}.csv", index=False, float_format="%.6g")
    figures.draw_all(path, target)
    (target / "README.md").write_text(page(path, target.name), encoding="utf-8")


def page(path: Path, name: str) -> str:
    """The README of the folder: how it was made, the comparison, the summary, what fell short, the figures."""
    cells = tables.in_order(tables.read(path, "cells"))
    versions = {name: text for row in cells["versions"] for name, text in json.loads(row).items()}
    named = ", ".join(f"{name} {text}" for name, text in versions.items())
    short = cells[cells["status"] != "ok"].groupby(["solver", "status"])
    fell = [
        f"- {solver}: {len(group)} cells {status}, {int((group['queries'] - group['queries_ok']).sum())} of "
        f"{int(group['queries'].sum())} of their queries"
        for (solver, status), group in short
    ]
    parts = [
        f"# {name}",
        f"Made by `vibench run {name} && python results/make.py runs/{name} results/{name}`, on one machine: "
        f"{cells['machine'].iloc[0]}; {named}. Seconds are CPU seconds on one thread.",
        f"## {PUBLISHED[name]['title']}",
        tables.to_markdown(comparison(cells, name)),
        f"Ours: {SOLVER}, assembly in full as in the paper; the threshold by the same formula from our seconds.",
        "## All cells",
        f"{len(cells)} cells, {int((cells['status'] == 'ok').sum())} with every query ok; the others:",
        "\n".join(fell),
        tables.to_markdown(tables.summary(cells)),
        "## Figures",
        "\n".join(f"![{file.stem}]({file.name})" for file in sorted((path.parent / "figures").glob("*.png"))),
        "Full tables: " + ", ".join(f"[{table}.csv]({table}.csv)" for table in TABLES) + ".",
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def comparison(cells: pd.DataFrame, name: str) -> pd.DataFrame:
    """One row per pair of tolerances: dimensions, times and benefit threshold, the paper's and ours."""
    published = PUBLISHED[name]
    mine = cells[(cells["solver"] == SOLVER) & (cells["dual"] == published["dual"])]
    rows = []
    for (pod, dual), (size, offline, online, threshold) in published["rows"].items():
        pair = mine[(mine["pod_tol"] == pod) & (mine["dual_tol"] == dual)]
        on = pair[pair["enrichment_kind"] == "per-parameter"].iloc[0]
        off = pair[pair["primal_tol"] == published["tight"]].iloc[0]
        ours = benefit_threshold(on["offline_s"], on["online_s"], off["offline_s"], off["online_s"])
        rows.append(
            {
                "δ_POD, δ_mCPG": f"{pod:g}, {dual:g}",
                "(N, R) paper": f"({size[0]}, {size[1]})",
                "ours": f"({on['N']:.0f}, {on['R']:.0f})",
                "offline on / off [s] paper": f"{offline[0]:.0f} / {offline[1]:.0f}",
                "ours [s]": f"{on['offline_s']:.1f} / {off['offline_s']:.1f}",
                "a query on / off [s] paper": f"{online[0]:g} / {online[1]:g}",
                "ours [ms]": f"{1e3 * on['online_s']:.1f} / {1e3 * off['online_s']:.1f}",
                "benefit threshold paper": threshold,
                "ours, threshold": str(ours),
            }
        )
    return pd.DataFrame(rows)


if __name__ == "__main__":
    main()
