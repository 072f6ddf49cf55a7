"""Results of the studies `certified` and `training`: effectivities, costs, corrected solutions, greedy training.

vibench run certified --no-figures && vibench run training --no-figures
python results/scripts/certified.py runs/certified runs/training results/certified

Everything comes from the results files.
"""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure
from page import CERTIFIED, SECONDS, Page, made_by, origin, read, start

from vibench.model.bound_terms import CorrectionMode
from vibench.report.figures.style import Sheet, look_of, scatter, styled
from vibench.results import ranking
from vibench.study.parameter_sets import OWN
from vibench_problems.paper.published import PROBLEMS

MODEL = ["problem", "training", "dual", "primal", "primal_tol", "pod_tol", "dual_tol"]

INTERVAL = ["offline_low_s", "offline_high_s"]
"""Of offline seconds; in linked tables alone, where there is room for it."""

MEASURED = ["error_u_mean", "error_u_max", "error_lambda_mean", "error_lambda_max"]


NORMS = {
    "u in V": ("error_u_absolute", {"HSW": "hsw_u", "(ii)": "u"}),
    "u in the energy norm": ("error_u_energy_absolute", {"(ii)": "u_energy", "(ii) online": "online_u_energy"}),
    "λ in W": ("error_lambda_absolute", {"HSW": "hsw_lambda", "(ii)": "lambda", "(ii) online": "online_lambda"}),
    "λ in the natural norm": (
        "error_lambda_natural_absolute",
        {"(ii)": "lambda_natural", "(ii) online": "online_lambda_natural"},
    ),
}
"""Errors and their bounds, by what is measured and in which norm."""

DRAWN = ("u in the energy norm", "λ in the natural norm")
"""Norms of the picture."""


def effectivities(cells: pd.DataFrame, queries: pd.DataFrame, of: str) -> pd.DataFrame:
    """Effectivities over the ok queries of every certified model, "median" or "max", and the number of violations."""
    rows = []
    for cell in cells[(cells["assembly"] == CERTIFIED) & (cells["correction"] == CorrectionMode.NONE)].to_dict(
        "records"
    ):
        mine = queries[(queries["cell"] == cell["cell"]) & (queries["status"] == "ok")]
        row = {name: cell[name] for name in [*MODEL, "certificate"]} | {"queries": len(mine)}
        for norm, (_, bounds) in NORMS.items():
            row |= {f"{norm}, {name}": mine[f"effectivity_{bound}"].agg(of) for name, bound in bounds.items()}
        rows.append(row | {"violations": int(mine["bound_online_violated"].fillna(0).sum())})
    return pd.DataFrame(rows)


def costs(cells: pd.DataFrame) -> pd.DataFrame:
    """Seconds of a query with and without its certificate, and of what is prepared offline."""
    plain = cells[cells["correction"] == CorrectionMode.NONE]
    without, with_one = (plain[plain["assembly"] == assembly].set_index(MODEL) for assembly in ("reduced", CERTIFIED))
    compared = pd.DataFrame(
        {
            "query without [ms]": 1e3 * without["online_s"],
            "query with [ms]": 1e3 * with_one["online_s"],
            "certificate [ms]": 1e3 * with_one["online_certify_s"],
            "certificate / query without": with_one["online_certify_s"] / without["online_s"],
            "offline without [s]": without["offline_s"],
            "offline with [s]": with_one["offline_s"],
            "certificates offline [s]": with_one["offline_certificate_s"],
        }
    )
    return compared.reset_index()


def corrections(cells: pd.DataFrame, queries: pd.DataFrame) -> pd.DataFrame:
    """Errors and seconds of every model, uncorrected, corrected at online cost, and corrected at high-fidelity cost.

    Ratios are of errors of λ in W without correction and with it: medians over the queries.
    """
    ways = {
        "": ("reduced", CorrectionMode.NONE),
        " online": (CERTIFIED, CorrectionMode.FEASIBLE),
        " in full": ("reduced", CorrectionMode.FEASIBLE),
    }
    found = {name: cells[(cells["assembly"] == way[0]) & (cells["correction"] == way[1])] for name, way in ways.items()}
    table = found[""][MODEL].set_index(MODEL)
    for name, mine in found.items():
        of_model = mine.set_index(MODEL)
        table[f"error u{name}"], table[f"error λ{name}"] = of_model["error_u_mean"], of_model["error_lambda_mean"]
        table[f"query{name} [ms]"] = 1e3 * of_model["online_s"]
    for name in (" online", " in full"):
        pairs = found[""].merge(found[name], on=MODEL, suffixes=("_without", "_with"))
        for pair in pairs.to_dict("records"):
            errors = [queries[queries["cell"] == pair[f"cell_{k}"]].set_index("query") for k in ("without", "with")]
            ratio = errors[0]["error_lambda"] / errors[1]["error_lambda"]
            where = tuple(pair[key] for key in MODEL)
            table.loc[where, f"λ without / with{name}"] = ratio.median()
            table.loc[where, f"ω > ρ{name}"] = (errors[1]["correction_share"] > 1.0).mean()
    return table.reset_index()


def cheapest(cells: pd.DataFrame) -> pd.DataFrame:
    """The fastest model at every level of the mean error of λ."""
    fastest = ranking.fastest(cells, ranking.errors_of_solution(cells, "lambda"))
    fastest["query [ms]"] = 1e3 * fastest["online_s"]
    names = [*MODEL, "assembly", "correction", "N", "R", "error_u_mean", "error_lambda_mean", "query [ms]"]
    return fastest[["problem", "error_below", *names[1:]]]


def trainings(cells: pd.DataFrame) -> pd.DataFrame:
    """Greedy and fixed training sets: high-fidelity solutions, dimensions, errors and offline seconds."""
    columns = {
        "snapshots": "high-fidelity solutions", "N": "N", "R": "R", "error_u_mean": "error u",
        "error_u_max": "largest error u", "error_lambda_mean": "error λ", "error_lambda_max": "largest error λ",
        "offline_s": "offline [s]", "query [ms]": "query [ms]",
    }  # fmt: skip
    return cells[[*MODEL, *columns]].rename(columns=columns)


def equal_errors(cells: pd.DataFrame) -> pd.DataFrame:
    """Every mCPG model of a fixed set beside the smallest greedy one whose four errors are at most its own.

    Where there is none, the greedy one is that with the smallest of the largest ratios, which is above one.
    """
    models, rows = cells[cells["status"] == "ok"], []
    compared = ["dual", "snapshots", "N", "R", "offline_s", "query [ms]", *INTERVAL]
    for fixed in models[(models["training"] == OWN) & (models["dual"] == "mcpg")].to_dict("records"):
        others = models[(models["problem"] == fixed["problem"]) & (models["primal"] == fixed["primal"])]
        others = others[others["training"] != OWN]
        ratios = others[MEASURED].div([fixed[name] for name in MEASURED]).max(axis=1).rename("largest ratio of errors")
        ranked = others.join(ratios).assign(size=others["N"] + others["R"], above=ratios.clip(lower=1.0))
        greedy = ranked.sort_values(["above", "size"]).iloc[0]
        published = {pair.tolerances for pair in PROBLEMS[fixed["problem"]].pairs}
        row = {name: fixed[name] for name in ("problem", "primal", "pod_tol", "dual_tol")}
        row |= {"paper": "yes" if (fixed["pod_tol"], fixed["dual_tol"]) in published else "no"}
        row |= {f"fixed {name}": fixed[name] for name in compared[1:]}
        rows.append(row | {f"greedy {name}": greedy[name] for name in compared} | {ratios.name: greedy[ratios.name]})
    return pd.DataFrame(rows)


def figure(cells: pd.DataFrame, queries: pd.DataFrame) -> Figure:
    """Bounds against errors of all certified queries, a row of panels for every norm; equal on the grey line."""
    certified = cells[(cells["assembly"] == CERTIFIED) & (cells["correction"] == CorrectionMode.NONE)]
    problems = list(certified["problem"].unique())
    sheet = Sheet(len(DRAWN), len(problems), "bounds against errors, all queries of certified models")
    for column, problem in enumerate(problems):
        mine = queries[queries["cell"].isin(certified.loc[certified["problem"] == problem, "cell"])]
        for row, norm in enumerate(DRAWN):
            error, bounds = NORMS[norm]
            panel, errors = sheet.panel(row, column), mine[error]
            for name, bound in bounds.items():
                scatter(panel, errors, mine[f"bound_{bound}"], look_of(name), name, markersize=3)
            ends = [errors[errors > 0.0].min(), errors.max()]
            panel.plot(ends, ends, color="0.6", linewidth=0.8, zorder=0)
            panel.set(xscale="log", yscale="log", xlabel=f"error of {norm}", ylabel="bound", title=problem)
    count = f"{len(queries[queries['cell'].isin(certified['cell'])])} queries of {len(certified)} certified models"
    return sheet.finish(
        f"Bounds (ii) against the errors that they bound, in the {count}, at high-fidelity and at online cost. On "
        "the grey line bound and error are equal: no point may lie below it."
    )


def main(certified: str, training: str, target: str) -> None:
    cells, queries, trained = read(certified, "cells"), read(certified, "queries"), read(training, "cells")
    trained["query [ms]"] = 1e3 * trained["online_s"]
    page = Page(
        target,
        "What do bounds cost, and how sharp are they?",
        made_by("certified", "certified", "certified", "training", options=" --no-figures"),
        SECONDS,
        machine=origin(cells, trained),
    )
    medians, largest, costly = (
        effectivities(cells, queries, "median"), effectivities(cells, queries, "max"), costs(cells),
    )  # fmt: skip
    equal = equal_errors(trained)
    ratios = equal["greedy offline_s"] / equal["fixed offline_s"]
    ratios = ratios[equal["largest ratio of errors"] <= 1.0].groupby(equal["problem"])
    of_u, of_lam = (medians[f"{norm}, (ii) online"] for norm in ("u in the energy norm", "λ in the natural norm"))
    share = (costly["certificate / query without"].groupby(costly["problem"])).median()
    page.answer(
        f"None of the {int(medians['queries'].sum()):,} pairs of bounds at online cost is violated; their median is "
        f"{of_u.median():.2g} times the error of u and {of_lam.median():.2g} times the error of λ. A certificate takes "
        f"{' and '.join(f'{each:.2g} times the seconds of a query on {name}' for name, each in share.items())}. "
        "Greedy training of equal errors takes the offline seconds of a fixed set "
        f"{' and '.join(f'{each:.2g} times on {name}' for name, each in ratios.median().items())}.",
    )
    assert not medians["violations"].any()
    with styled():
        page.draw("bounds", figure(cells, queries))
    page.file("medians", "median effectivities by model and norm; HSW: Haasdonk, Salomon and Wohlmuth", medians)
    page.file("effectivities", "the largest ones", largest)
    page.file("costs", "seconds of a query with its certificate and without, and of what is prepared offline", costly)
    page.file(
        "corrections",
        "errors and seconds uncorrected, corrected at online cost and at high-fidelity cost; medians of the ratios of "
        "errors of λ in W, and the share of queries with ω > ρ",
        corrections(cells, queries),
    )
    page.file("fastest", "the fastest model at every level of the mean error of λ", cheapest(cells))
    page.file(
        "trainings", "greedy and fixed training sets over the validation set, reduced assembly", trainings(trained)
    )
    page.file(
        "training",
        "every mCPG model of a fixed set beside the smallest greedy one whose four errors are at most its own, or that "
        "comes closest; `paper` says whether the paper uses these tolerances",
        equal,
    )
    page.also(
        "[unseen.csv](unseen.csv)",
        "effectivities, violations and corrections at random parameters, as many as its column `parameters` says, by "
        "`python tests/benchmarks/certified.py runs/certified COUNT PROBLEM --table FILE`",
    )
    failed = pd.concat(frame[frame["status"] != "ok"] for frame in (cells, trained))
    page.file("not-ok", "cells that are not ok, and why", failed[["cell", *MODEL, "status", "reason"]])
    page.write()


if __name__ == "__main__":
    start(main)
