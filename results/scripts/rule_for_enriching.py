"""Whether the rule for enriching, N < R, holds on problems that it was not drawn from, and what enriching costs.

python results/scripts/rule_for_enriching.py results results/enriching

The rule comes from the two problems of the paper, whose tables are in the first folder. The pack is written by FreeFEM
(Debian: freefem++).
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
from page import SECONDS, Page, origin, read, start

import vibench

ROOT = Path(__file__).parents[2]
PACK, WIDTHS = Path("runs", "enriching-pack"), "40"
PROBLEMS = [
    {"name": "bearing"}, {"name": "american-put", "options": {"resolution": "medium"}},
    {"name": "pack", "label": "FreeFEM block", "options": {"path": str(PACK.absolute())}},
]  # fmt: skip
GRID = {"pod": [1e-1, 1e-2, 1e-3, 1e-4], "dual": [1e-1, 3e-2, 1e-2], "primal": {"offline-pga": [0.5]}}
BARE, DRAWN_FROM = "decorrelated", ("paper-obstacle", "paper-hertz")
CONE = ["problem", "dual", "pod_tol", "pod_size", "dual_tol", "dual_size"]
ANSWER = """On one of three: the block. On the bearing and the put models without enrichment have useless multipliers,
some of them with N ≥ R, too: enrich unless a run shows that it does not help."""
READ = """Factors by which enriching divides the error of λ: median, range, number of models. Then, of the enriched
models, the share for which some model without enrichment, with a query that is as fast, or an offline phase as short,
has an error of λ as small."""
ABOUT = """The first two problems are those of the paper, from which the rule was drawn (full assembly, its tolerances);
on the other three it is tested. A model is enriched by offline PGA."""


def main(results: str, target: str) -> None:
    if not PACK.exists():
        shutil.copytree(ROOT / "examples" / "freefem" / "signorini", PACK)
        program = ROOT / "examples" / "freefem" / "signorini.edp"
        subprocess.run(["FreeFem++", "-nw", program, PACK, WIDTHS], check=True, stdout=subprocess.DEVNULL)
    study = vibench.Study(
        name="enriching", seed=2022, validation=64, accuracy=1e-8, solvers=["piqp"], dual=["cpg", "mcpg"],
        primal=[BARE, "offline-pga"], assembly=["reduced"], problem=PROBLEMS, tolerances=[GRID],
    )  # fmt: skip
    run = vibench.run(study, progress=False)
    own = read(run.path, "cells")
    earlier = [pd.read_csv(Path(results) / name / "cells.csv") for name in DRAWN_FROM]
    page = Page(
        target, "Does the rule for enriching hold elsewhere?",
        "python results/scripts/rule_for_enriching.py results results/enriching", SECONDS, ABOUT, machine=origin(own),
    )  # fmt: skip
    every = [cells[cells["solver"] == "piqp"] for cells in (*earlier, own)]
    table = pd.DataFrame(row for cells in every for row in rows_of(cells))
    # The answer says so.
    assert list(table.loc[table.pop("largest") < 5.0, "problem"]) == ["obstacle", "hertz", "FreeFEM block"]
    page.answer(ANSWER, table, READ)
    page.file("cells", "every cell of the three further problems, with all columns", own)
    page.write()


def rows_of(cells: pd.DataFrame) -> Iterator[dict[str, str]]:
    """A row for each problem of some cells: what enriching divides the error of λ by, and whom it serves."""
    fine = cells[(cells["status"] == "ok") & (cells["assembly"] == cells["assembly"].iloc[0])]
    for problem, mine in fine.groupby("problem", sort=False):
        plain, enriched = (mine[(mine["primal"] == BARE) == bare].set_index(CONE) for bare in (True, False))
        enriched = enriched[enriched["primal"].str.startswith("offline-pga")]
        same = plain.reindex(enriched.index)
        factor, few = same["error_lambda_mean"] / enriched["error_lambda_mean"], same["N"] < same["R"]
        yield {
            "problem": f"{problem}", "N < R": spread(factor[few]), "N ≥ R": spread(factor[~few]),
            "query": beaten(plain, enriched, "online_s"), "offline": beaten(plain, enriched, "offline_s"),
            "largest": factor[~few].max(),
        }  # fmt: skip


def spread(factors: pd.Series) -> str:
    """Median, range and number of some factors."""
    known = factors.dropna()
    if known.empty:
        return "no model"
    return f"{known.median():.2g} ({known.min():.2g} to {known.max():.2g}; {len(known)} models)"


def beaten(plain: pd.DataFrame, enriched: pd.DataFrame, seconds: str) -> str:
    """The share of the enriched models to which a plain one is equal, in an error of λ and in seconds."""
    counts = [
        ((plain["error_lambda_mean"] <= one["error_lambda_mean"]) & (plain[seconds] <= one[seconds])).any()
        for _, one in enriched.iterrows()
    ]
    return f"{sum(counts)} of {len(counts)}"


if __name__ == "__main__":
    start(main)
