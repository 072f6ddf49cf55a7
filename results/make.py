"""Put the tables and figures of a finished run under results/, with the paper's figures beside ours.

vibench run paper-obstacle && python results/make.py runs/paper-obstacle results/paper-obstacle
"""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from vibench.report import figures
from vibench.results import tables
from vibench.results.break_even import HIGH_FIDELITY, break_even
from vibench.results.schema import TABLES


@dataclass(frozen=True)
class Published:
    """One column of a table of the paper: online (on) and offline (off) enrichment for one pair of dimensions.

    Attributes
    ----------
    ask
        What selects our cells: tolerances, or prescribed sizes.
    size
        (N, R) of the paper.
    offline, online
        Seconds of the offline phase and of one query, on and off.
    threshold
        Benefit threshold.
    """

    ask: dict[str, float]
    size: tuple[int, int]
    offline: tuple[float, float]
    online: tuple[float, float]
    threshold: int


PAPER = {
    "paper-obstacle": (
        "Table 1 of Niakh, Drouet, Ehrlacher and Ern (2022), δ_PGA = 1e-3, beside ours",
        1e-3,
        (
            Published({"pod_tol": 1e-3, "dual_tol": 1e-2}, (19, 50), (1112.0, 2296.0), (14.0, 2.4), 102),
            Published({"pod_tol": 1e-4, "dual_tol": 1e-3}, (51, 70), (1193.0, 2395.0), (17.0, 2.5), 83),
            Published({"pod_tol": 1e-6, "dual_tol": 1e-2}, (89, 50), (1272.0, 1884.0), (14.0, 2.3), 52),
        ),
    ),
    "paper-hertz": (
        "Table 2 of Niakh, Drouet, Ehrlacher and Ern (2022), δ_PGA = 0.3, beside ours",
        0.3,
        (
            Published({"pod_size": 3, "dual_size": 12}, (3, 12), (8490.0, 18098.0), (75.0, 18.0), 169),
            Published({"pod_size": 46, "dual_size": 70}, (46, 70), (10889.0, 19750.0), (162.0, 20.0), 62),
            Published({"pod_size": 46, "dual_size": 12}, (46, 12), (10874.0, 18312.0), (78.0, 19.0), 126),
        ),
    ),
}
"""What the paper prints: title, δ_PGA of the offline enrichment, columns; seconds on its authors' machine."""

DUAL = "mcpg"
SOLVER = "piqp"
"""Cone and solver whose seconds stand beside the paper's; the solver that leaves the fewest queries unsolved."""


def main() -> None:
    if len(sys.argv) != 3:
        sys.exit("usage: python results/make.py RUN_FOLDER TARGET_FOLDER")
    path, target = tables.results_file(sys.argv[1]), Path(sys.argv[2])
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for table in TABLES:
        frame = tables.in_order(tables.read(path, table))
        frame.to_csv(target / f"{table}.csv", index=False, float_format="%.6g")
    figures.draw_all(path, target, ("png",))
    (target / "README.md").write_text(page(path, target), encoding="utf-8")


def page(path: Path, target: Path) -> str:
    """The README of the folder: how it was made, the comparison, the summary, what fell short, the figures."""
    name, cells = target.name, tables.in_order(tables.read(path, "cells"))
    versions = {name: text for row in cells["versions"] for name, text in json.loads(row).items()}
    named = ", ".join(f"{name} {text}" for name, text in versions.items())
    short = cells[cells["status"] != "ok"].groupby(["solver", "status"])
    fell = [
        f"- {solver}: {len(group)} cells {status}, {int((group['queries'] - group['queries_ok']).sum())} of "
        f"{int(group['queries'].sum())} of their queries"
        for (solver, status), group in short
    ]
    drawn = sorted(file.name for file in target.glob("*.png"))
    parts = [
        f"# {name}",
        f"Made by `vibench run {name} && python results/make.py runs/{name} results/{name}`, on one machine: "
        f"{cells['machine'].iloc[0]}; {named}. Seconds are CPU seconds on one thread.",
        *(beside_the_paper(cells, name) if name in PAPER else []),
        "## All cells",
        f"{len(cells)} cells, {int((cells['status'] == 'ok').sum())} with every query ok"
        + ("; the others:" if fell else "."),
        "\n".join(fell),
        tables.to_markdown(tables.summary(cells)),
        *benefits(path),
        "## Figures",
        "\n".join(f"![{Path(name).stem}]({name})" for name in drawn),
        "Full tables: " + ", ".join(f"[{table}.csv]({table}.csv)" for table in TABLES) + ".",
    ]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def benefits(path: Path) -> list[str]:
    """The section on benefit thresholds: from how many queries on an enrichment pays against another."""
    thresholds = tables.read(path, "thresholds")
    of_enrichments = thresholds[thresholds["primal_a"] != HIGH_FIDELITY]
    if of_enrichments.empty:
        return []
    return ["## Benefit thresholds of fixed enrichments", tables.to_markdown(tables.benefits(of_enrichments))]


def beside_the_paper(cells: pd.DataFrame, name: str) -> list[str]:
    """The section that compares with the paper."""
    return [
        f"## {PAPER[name][0]}",
        tables.to_markdown(comparison(cells, name)),
        f"Ours: {SOLVER}, assembly in full as in the paper; the threshold by the same formula from our seconds.",
    ]


def comparison(cells: pd.DataFrame, name: str) -> pd.DataFrame:
    """One row per pair of dimensions: dimensions, times and benefit threshold, the paper's and ours."""
    _, tight, columns = PAPER[name]
    mine = cells[(cells["solver"] == SOLVER) & (cells["dual"] == DUAL)]
    rows = []
    for column in columns:
        pair = mine[np.logical_and.reduce([mine[key] == value for key, value in column.ask.items()])]
        on = pair[pair["enrichment_kind"] == "per-parameter"].iloc[0]
        off = pair[pair["primal_tol"] == tight].iloc[0]
        ours = break_even(on["offline_s"], on["online_s"], off["offline_s"], off["online_s"])
        rows.append(
            {
                "asked for": ", ".join(f"{key} = {value:g}" for key, value in column.ask.items()),
                "(N, R)": f"({column.size[0]}, {column.size[1]})",
                "ours": f"({on['N']:.0f}, {on['R']:.0f})",
                "offline on / off [s]": f"{column.offline[0]:.0f} / {column.offline[1]:.0f}",
                "ours [s]": f"{on['offline_s']:.1f} / {off['offline_s']:.1f}",
                "query on / off [s]": f"{column.online[0]:g} / {column.online[1]:g}",
                "ours [ms]": f"{1e3 * on['online_s']:.1f} / {1e3 * off['online_s']:.1f}",
                "threshold": column.threshold,
                "ours, threshold": str(ours),
            }
        )
    return pd.DataFrame(rows)


if __name__ == "__main__":
    main()
