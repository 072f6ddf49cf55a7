"""What a start from the solution before saves QP solvers: the page of the studies `sequences` and `sequences-warm`.

vibench run sequences && vibench run sequences-warm && python results/scripts/sequences.py COLD WARM results/sequences
"""

from __future__ import annotations

import pandas as pd
from page import SECONDS, Page, made_by, origin, read, start

from vibench.qp.solve import takes_start

STUDIES = "sequences", "sequences-warm"
KEY = ["problem", "solver"]


def main(cold: str, warm: str, target: str) -> None:
    runs = [read(run, "queries") for run in (cold, warm)]
    cells = [read(run, "cells") for run in (cold, warm)]
    command = made_by("sequences", "sequences", *STUDIES, options=" --no-figures")
    about = (
        "Every program of a path is solved cold, and from the solution of the one before where the solver can. Seconds "
        "are those of the solver in the rounds, iterations medians without the first program. The ratio is one of "
        "seconds in those of the high-fidelity solutions of the same rounds, since the machine may be faster in one of "
        "the two runs. Where a solver cannot start, the ratio is what two runs differ by."
    )
    page = Page(target, "Do warm starts pay along paths?", command, about, SECONDS, machine=origin(*cells))
    table = compared(*(summary(run).join(timed(of)) for run, of in zip(runs, cells, strict=True)))
    starts = table[table["start"] == "yes"].groupby("solver")["cold/warm"]
    others = (table.loc[table["start"] == "no", "cold/warm"] - 1.0).abs().max()
    page.answer(
        "A start from the solution before divides the seconds by "
        f"{', '.join(f'{ratio.median():.2g} (`{solver}`)' for solver, ratio in starts)}. Solvers that cannot start "
        f"differ by at most {100 * others:.0f} % between the two runs.",
        table.loc[table["start"] == "yes", ["problem", "solver", "cold [ms]", "warm [ms]", "cold/warm",
                                            "iterations, cold", "iterations, warm"]],
    )  # fmt: skip
    page.file("sequences", "all solvers and problems", table)
    page.write()


def summary(queries: pd.DataFrame) -> pd.DataFrame:
    """Medians of the queries but the first one, and the share that is ok, by problem and solver."""
    later = queries.loc[queries["query"] > 0, [*KEY, "status", "iterations"]].assign(
        ok=lambda rows: rows["status"] == "ok"
    )
    return later.groupby(KEY).agg(iterations=("iterations", "median"), ok=("ok", "mean"))


def timed(cells: pd.DataFrame) -> pd.DataFrame:
    """Seconds of the solver in the rounds, and in those of a high-fidelity solution of the same rounds."""
    rows = cells.set_index(KEY)
    return pd.DataFrame({"ms": rows["online_solve_s"], "share": rows["online_solve_s"] / rows["hf_s"]})


def compared(cold: pd.DataFrame, warm: pd.DataFrame) -> pd.DataFrame:
    """One row per problem and solver: both runs side by side."""
    both = cold.add_suffix("_cold").join(warm.add_suffix("_warm")).reset_index()
    return pd.DataFrame(
        {
            "problem": both["problem"],
            "solver": both["solver"],
            "start": ["yes" if takes_start(solver) else "no" for solver in both["solver"]],
            "cold [ms]": 1e3 * both["ms_cold"],
            "warm [ms]": 1e3 * both["ms_warm"],
            "cold/warm": both["share_cold"] / both["share_warm"],
            "iterations, cold": both["iterations_cold"],
            "iterations, warm": both["iterations_warm"],
            "ok, cold": both["ok_cold"],
            "ok, warm": both["ok_warm"],
        }
    )


if __name__ == "__main__":
    start(main)
