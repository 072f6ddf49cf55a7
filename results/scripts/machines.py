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

IDENTITY = [
    "problem", "training", "formulation", "dual", "primal", "pod_tol", "pod_size", "dual_tol", "dual_size",
    "primal_tol", "solver", "accuracy", "assembly", "correction",
]  # fmt: skip
"""What tells cells of a study apart; their keys depend on the version of vibench."""


def main(results: str, target: str) -> None:
    page = Page(
        target,
        "Do conclusions hold on other machines?",
        "python results/scripts/machines.py results results/machines",
        "The tables of the other machine are those of the same commands there, with six digits; ours are on the pages "
        "of the studies. Both machines decide a row where neither calls it undecided; it is contradicted where one is "
        "cheaper on one machine and dearer on the other, or as fast on one with intervals of the gain that are apart. "
        "Gains are those here over those there. Where the versions of the protocol differ, rows with the "
        "high-fidelity model are left out: its seconds are not the same.",
    )
    folders = sorted(table.parent for table in Path(target).glob("*/*/cells.csv"))
    pairs = {folder: (here := read(Path(results) / folder.name), as_here(read(folder), here[0])) for folder in folders}
    gains = pd.DataFrame([compared(folder, *pair) for folder, pair in pairs.items()])
    sizes = pd.DataFrame([numbers(folder, *pair) for folder, pair in pairs.items()])
    page.answer(
        f"{int(gains['contradicted'].sum())} of {int(gains['decided by both'].sum())} verdicts that both machines "
        f"decide are contradicted. N, R and the number of vectors differ in {int(sizes['other sizes'].sum())} of "
        f"{int(sizes['cells'].sum())} cells.",
        gains,
    )
    page.file("numbers", "largest difference of a column, over its largest value, of cells that are ok on both", sizes)
    for folder, pair in pairs.items():
        inside, (here, there) = folder.relative_to(target), (origin(cells) for cells, _ in pair)
        page.also(
            f"[{folder.name}](../{folder.name}/README.md)",
            f"here {here.partition(',')[0]}, there `{folder.parent.name}`, {there.rpartition('vibench ')[2]} "
            f"([cells]({inside}/cells.csv), [break-even]({inside}/thresholds.csv))",
        )
    page.write()


Tables = tuple[pd.DataFrame, pd.DataFrame]
"""Cells and break-evens of a study."""


def read(folder: Path) -> Tables:
    """The tables that are committed of a study."""
    cells, thresholds = (pd.read_csv(folder / f"{name}.csv") for name in ("cells", "thresholds"))
    return cells, thresholds


def as_here(there: Tables, cells: pd.DataFrame) -> Tables:
    """Tables of another machine with the keys that their cells have among the `cells` of ours."""
    both = there[0][[*IDENTITY, "cell"]].merge(cells[[*IDENTITY, "cell"]], on=IDENTITY, suffixes=("", "_here"))
    ours = both.set_index("cell")["cell_here"]
    assert len(ours) == len(there[0])
    keys = {name: there[1][name].map(ours).where(there[1][name].notna()) for name in BOTH}
    return there[0].assign(cell=there[0]["cell"].map(ours)), there[1].assign(**keys)


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
    sizes = ["N", "R", "enrichment"]
    apart = [both[name] != both[f"{name}_there"] for name in sizes]
    row["other sizes"] = int(pd.concat(apart, axis=1).any(axis=1).sum())
    for column in (*sizes, "beta_span_min", "error_u_mean", "error_lambda_mean"):
        ours, theirs = both[column], both[f"{column}_there"]
        row[column] = f"{(ours - theirs).abs().max() / ours.abs().max():.1e}"
    return row


if __name__ == "__main__":
    start(main)
