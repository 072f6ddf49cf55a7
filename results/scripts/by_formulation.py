"""Results of the study `formulations`: who is how accurate at which query time, and what is left with less training.

vibench run formulations --no-figures && vibench run formulations-compiled --no-figures
python results/scripts/by_formulation.py runs/formulations runs/formulations-compiled results/formulations

Everything comes from the results file: all formulations are judged by the errors, the residuals and the bounds of the
high-fidelity problem.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from page import SECONDS, Page, made_by, origin, read, start

from vibench.report.figures.style import Looks, Series, Sheet, scatter, styled
from vibench.results import formats

ROUND_OFF = 1e-10
"""An error above its bound by more than this share of the solution violates it; less is round-off."""

BOUNDED = {
    "u (A)": ("error_u_energy_absolute", "bound_u_energy", "error_u_energy"),
    "u (V)": ("error_u_absolute", "bound_u", "error_u"),
    "λ (natural)": ("error_lambda_natural_absolute", "bound_lambda_natural", "error_lambda_natural"),
    "λ (W)": ("error_lambda_absolute", "bound_lambda", "error_lambda"),
}
"""Absolute errors, their bounds, and relative errors, by norm."""

BUDGETS = (1.0, 2.0, 5.0, 10.0)
"""Multiples of the fastest query of a problem at which the smallest errors are compared."""

STUDIES = "formulations", "formulations-compiled"

KEY = ["problem", "formulation", "dual", "pod_tol"]


def answered(cells: pd.DataFrame) -> pd.DataFrame:
    """Cells with every query ok, whose seconds were measured."""
    return cells[(cells["queries_ok"] == cells["queries"]) & cells["online_s"].notna()]


def winners(cells: pd.DataFrame, error: str) -> pd.DataFrame:
    """The smallest error of every problem within some multiples of its fastest query, and whose it is."""
    rows = []
    for problem, all_of in answered(cells).groupby("problem", sort=False):
        fastest = all_of["online_s"].min()
        for budget in BUDGETS:
            within = all_of[all_of["online_s"] <= budget * fastest]
            best = within.loc[within[error].idxmin()]
            rows.append(
                {
                    "problem": problem,
                    "query ≤ [ms]": 1e3 * budget * fastest,
                    "smallest error": best[error],
                    "formulation": best["formulation"],
                    "dual": best["dual"] or "–",
                    "query [ms]": 1e3 * best["online_s"],
                    "offline [s]": best["offline_s"],
                }
            )
    return pd.DataFrame(rows)


def robustness(cells: pd.DataFrame) -> pd.DataFrame:
    """Factors by which mean errors grow with half of the training set, and outside of the trained part of the box.

    Geometric means over dual strategies and tolerances of cells that answered all queries with both training sets.
    """
    all_ok = cells[cells["queries_ok"] == cells["queries"]]
    errors = all_ok.set_index([*KEY, "training"])[["error_u_mean", "error_lambda_mean"]].unstack("training")
    rows = {}
    for quantity, name in (("error_u_mean", "u"), ("error_lambda_mean", "λ")):
        for training in ("half", "inner"):
            if training in errors[quantity]:
                grown = np.log(errors[quantity][training] / errors[quantity]["own"])
                rows[f"{name}, {training}"] = np.exp(grown.groupby(["problem", "formulation"], sort=False).mean())
    return pd.DataFrame(rows).dropna(how="all").reset_index()  # problems with their own training set alone


def violated(queries: pd.DataFrame) -> pd.DataFrame:
    """Numbers of errors that were compared with their bounds, and of those above them, by formulation and norm."""
    fine, rows = queries[queries["status"] == "ok"], {}
    for norm, (error, bound, relative) in BOUNDED.items():
        both = fine[fine[error].notna() & fine[bound].notna()]
        size = (both[error] / both[relative]).replace([np.inf, -np.inf], np.nan).fillna(0.0)
        above = both[error] > both[bound] + (ROUND_OFF + both["reference_bound"].fillna(0.0)) * size
        counts = above.groupby(both["formulation"], sort=False).agg(["sum", "count"])
        rows[norm] = counts["sum"].astype(str) + " of " + counts["count"].astype(str)
    return pd.DataFrame(rows).reset_index()


def uncertainty(queries: pd.DataFrame) -> pd.DataFrame:
    """What formulations say of their own error beside the error and the proved bound of u in V: medians of ratios."""
    stated = queries[queries["error_u_predicted"].notna() & (queries["status"] == "ok")]
    ratios = pd.DataFrame(
        {
            "problem": stated["problem"],
            "training": stated["training"],
            "formulation": stated["formulation"],
            "stated / error": stated["error_u_predicted"] / stated["error_u_absolute"],
            "bound / error": stated["bound_u"] / stated["error_u_absolute"],
            "below": stated["error_u_predicted"] < stated["error_u_absolute"],
        }
    )
    grouped = ratios.groupby(["problem", "training", "formulation"], sort=False)
    medians = grouped[["stated / error", "bound / error"]].median()
    return medians.assign(**{"share of errors above what is stated": grouped["below"].mean()}).reset_index()


def pairs(thresholds: pd.DataFrame) -> pd.DataFrame:
    """The break-evens of formulations with `mixed`, of the problems' own training sets."""
    return thresholds[formats.between_formulations(thresholds) & (thresholds["training"] == "own")]


def break_evens(compared: pd.DataFrame) -> pd.DataFrame:
    """When each formulation is cheaper in total than `mixed`, a column for every cone and tolerance."""
    rows = list[dict[str, object]]()
    for (problem, formulation), mine in compared.groupby(["problem", "formulation_b"], sort=True):
        row: dict[str, object] = {"problem": problem, "formulation": formulation}
        for one in mine.sort_values(["dual", "pod_tol"], ascending=[False, False]).itertuples():
            within = formats.interval(one.threshold_low, one.threshold_high) if one.meaning in ("from", "until") else ""
            number = formats.break_even(one.meaning, one.benefit_threshold)
            row[f"{one.dual}, {one.pod_tol:g}"] = f"{number} ({within})" if within else number
        rows.append(row)
    return pd.DataFrame(rows)


def figure(cells: pd.DataFrame) -> Figure:
    """Errors of λ over the time of a query, a look for each formulation."""
    problems, title = list(dict.fromkeys(cells["problem"])), "Error of λ against online time"
    sheet = Sheet(-(-len(problems) // 2), 2, title)
    looks = Looks(Series(name) for name in cells["formulation"])
    for panel, problem in zip(sheet.panels, problems, strict=True):
        for name, mine in answered(cells[cells["problem"] == problem]).groupby("formulation", sort=False):
            scatter(panel, 1e3 * mine["online_s"], mine["error_lambda_mean"], looks[Series(name)], name)
        panel.set(title=problem, xlabel="query [ms]", ylabel="mean relative error of λ", xscale="log", yscale="log")
    return sheet.finish(
        f"{title}: a point for every cell with all queries ok and the problem's own training set, a marker for every "
        "formulation."
    )


def compiled(cells: pd.DataFrame) -> pd.DataFrame:
    """Errors and seconds of the exported C program beside those of the same model in Python."""
    of = {assembly: mine.set_index(["problem", "pod_tol"]) for assembly, mine in cells.groupby("assembly")}
    ours, exported = of["reduced"], of["compiled"].reindex(of["reduced"].index)
    return pd.DataFrame(
        {
            **{name: ours[name] for name in ("N", "enrichment", "R")},
            "error λ": ours["error_lambda_mean"],
            "error λ, compiled": exported["error_lambda_mean"],
            "query [ms]": 1e3 * ours["online_s"],
            "query, compiled [ms]": 1e3 * exported["online_s"],
            "query / compiled": ours["online_s"] / exported["online_s"],
            "reason": exported["reason"].fillna(""),
        }
    ).reset_index()


def main(run: str, run_compiled: str, target: str) -> None:
    cells, queries, exported = read(run, "cells"), read(run, "queries"), read(run_compiled, "cells")
    own = cells[cells["training"] == "own"]
    command = made_by("by_formulation", "formulations", *STUDIES, options=" --no-figures")
    page = Page(
        target,
        "Which formulation?",
        command,
        SECONDS,
        f"{len(cells)} cells, {len(answered(cells))} with every query ok, at {int(own['queries'].max())} parameters. "
        "All rows are judged by the errors, the residuals and the bounds of the high-fidelity problem. Errors are "
        "relative means.",
        machine=origin(cells, exported),
    )
    levels = winners(own, "error_lambda_mean")
    first, last = (levels.groupby("problem", sort=False).nth(k)["formulation"] for k in (0, -1))
    assert first.str.startswith("regression").all()
    above = violated(queries)
    counts = [text.split(" of ") for name in BOUNDED for text in above[name]]
    page.answer(
        "On every problem `regression (radial)` is the fastest, at a larger error and without proof. Within "
        f"{BUDGETS[-1]:g} times its seconds the smallest error of λ is that of "
        f"{', '.join(f'`{name}`' for name in dict.fromkeys(last))}.",
        levels[levels.groupby("problem").cumcount().isin((0, len(BUDGETS) - 1))],
    )
    with styled():
        page.draw("formulations-time", figure(own))
    compared = pairs(read(run, "thresholds"))
    page.file("levels", "the smallest error of λ within multiples of the fastest query", levels)
    page.file("levels-u", "the same of u", winners(own, "error_u_mean"))
    page.file(
        "break-even",
        "from, or until, how many queries a formulation is cheaper in total than `mixed` with the same cone and "
        "tolerances, whatever their errors, with its 95 % interval",
        break_evens(compared),
    )
    page.file("compiled", "cells of `mixed` with `mcpg` as programs in C, from a run of their own", compiled(exported))
    page.file(
        "training",
        "factors of mean errors against those with the own training set: with half of it (`half`), and with the inner "
        "70 per cent of the box alone (`inner`)",
        robustness(cells),
    )
    page.file(
        "bounds",
        f"errors above their bounds, by norm, in all {sum(int(one) for one, _ in counts)} of "
        f"{sum(int(of) for _, of in counts):,}",
        above,
    )
    page.file(
        "uncertainty",
        "what `regression` states of its error, and the bound, which is of the sum with λ and large where λ is wrong",
        uncertainty(queries),
    )
    page.file("cells", "every cell, with all columns", cells.drop(columns=["definition", "versions"]))
    page.file("thresholds", "break-even with `mixed`, in numbers", compared)
    page.write()


if __name__ == "__main__":
    start(main)
