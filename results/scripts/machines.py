"""How far the conclusions of the studies hold on other machines, whose tables lie below `results/machines`.

python results/scripts/machines.py results results/machines
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from page import Page, origin, protocols, start

from vibench.report.differences import agreement
from vibench.results.break_even import HIGH_FIDELITY

BOTH = ["cell_a", "cell_b"]


def main(results: str, target: str) -> None:
    page = Page(
        target,
        "Other machines",
        "python results/scripts/machines.py results results/machines",
        "The tables of the other machine are those of the same commands there, with six digits; ours are on the pages "
        "of the studies. Intervals of protocol 1 are those of one run, later ones include what differs between runs.",
    )
    folders = sorted(table.parent for table in Path(target).glob("*/*/cells.csv"))
    pairs = {folder: (read(Path(results) / folder.name), read(folder)) for folder in folders}
    page.section("What was compared", "\n".join(run(target, *pair) for pair in pairs.items()))
    page.section(
        "Break-even and gains",
        pd.DataFrame([compared(folder, *pair) for folder, pair in pairs.items()]),
        "Both machines decide a row where neither calls it undecided; it is contradicted where one is cheaper on one "
        "machine and dearer on the other, or as fast on one with intervals of the gain that are apart. The number of "
        "queries at break-even and the gain are ratios of seconds, and may be compared; seconds may not. Gains are "
        "those here over those there: the median over the rows, and the smallest and the largest. Where the versions "
        "of the protocol differ, rows with the high-fidelity model are left out: its seconds are not the same.",
    )
    page.section(
        "Numbers without seconds",
        pd.DataFrame([numbers(folder, *pair) for folder, pair in pairs.items()]),
        "Largest difference of a column over the cells that are ok on both machines, relative to its largest value.",
    )
    page.write()


Tables = tuple[pd.DataFrame, pd.DataFrame]
"""Cells and break-evens of a study."""


def read(folder: Path) -> Tables:
    """The tables that are committed of a study."""
    cells, thresholds = (pd.read_csv(folder / f"{name}.csv") for name in ("cells", "thresholds"))
    return cells, thresholds


def run(target: str, folder: Path, both: tuple[Tables, Tables]) -> str:
    """Where a study was run, here and there, with links to the tables of there."""
    inside, (here, there) = folder.relative_to(target), (origin(cells) for cells, _ in both)
    return (
        f"- [{folder.name}](../{folder.name}/README.md): {here}; on `{folder.parent.name}`: {there} "
        f"([cells]({inside}/cells.csv), [break-even]({inside}/thresholds.csv))"
    )


def compared(folder: Path, here: Tables, there: Tables) -> dict[str, object]:
    """How often verdicts agree, and how gains differ."""
    ours, theirs = here[1], there[1]
    if protocols(here[0]) != protocols(there[0]):
        ours, theirs = (table[table["primal_a"] != HIGH_FIDELITY] for table in (ours, theirs))
    found = agreement(ours, theirs)
    row: dict[str, object] = {
        "study": folder.name,
        "machine": folder.parent.name,
        "rows": len(ours.merge(theirs, on=BOTH)),
        "decided by both": found.decided,
        "contradicted": found.opposite,
        "intervals overlap": f"{found.overlapping} of {found.both}",
    }
    for name, chosen in (("gain over the high-fidelity model", True), ("gain over models", False)):
        gains = [
            table[(table["primal_a"] == HIGH_FIDELITY) == chosen].set_index(BOTH)["gain"] for table in (ours, theirs)
        ]
        ratio = (gains[0] / gains[1]).dropna()
        row[name] = f"{ratio.median():.2f} ({ratio.min():.2f}–{ratio.max():.2f})" if len(ratio) else "–"
    return row


def numbers(folder: Path, here: Tables, there: Tables) -> dict[str, object]:
    """How far apart sizes, errors and constants of the cells are."""
    both = here[0].merge(there[0], on="cell", suffixes=("", "_there"))
    both = both[(both["status"] == "ok") & (both["status_there"] == "ok")]
    row: dict[str, object] = {"study": folder.name, "machine": folder.parent.name, "cells": len(both)}
    for column in ("N", "R", "enrichment", "beta_span_min", "error_u_mean", "error_lambda_mean"):
        ours, theirs = both[column], both[f"{column}_there"]
        row[column] = f"{(ours - theirs).abs().max() / ours.abs().max():.1e}"
    return row


if __name__ == "__main__":
    start(main)
