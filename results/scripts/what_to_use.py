"""The page "What to use": six questions, answered from the tables that are committed below `results/`.

python results/scripts/what_to_use.py results docs/what-to-use.md
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from committed import ASSEMBLIES, MODEL, PROBLEMS, Results, enriched, number, of, span, surely_above_one, unavailable
from page import start

from vibench.results import formats


def question(heading: str, answer: str, fails: str, *more: str) -> str:
    """A section of the page: the answer, where it fails, and a table if it needs one."""
    return "\n\n".join([f"## {heading}", answer, f"*Where this fails:* {fails}", *more])


def break_even(offline: pd.Series, online: pd.Series) -> pd.Series:
    """From how many queries on more seconds offline are made up for by fewer in a query; empty where they are not."""
    return (offline / online).where(online > 0.0).clip(lower=0.0)


def enrich(results: Results) -> str:
    """Enrich or not, and which enrichment."""
    pairs = pd.concat(
        [results.table("benefit", "thresholds"), *(results.table(f"paper-{p}", "thresholds") for p in PROBLEMS)]
    )
    pairs = pairs[pairs["cell_a"].notna() & (pairs["assembly_a"] == pairs["assembly_b"])]
    compared = [
        f"{how} assembly {span(mine['gain'])} ({p}; the interval is above 1 in {surely_above_one(mine)}, below 1 in "
        f"{of(int((mine['gain_high'] < 1.0).sum()), len(mine))})"
        for (how, p), mine in pairs.groupby(["assembly_a", "problem"], sort=False)
        if how in ("full", "reduced")
    ]
    worse = {p: enriched(cells, "error_u_mean") for p, cells in results.full.items()}
    return question(
        "Enrich or not?",
        f"With mCPG, enrich offline: it divides the error of λ, in the norm of W, by {_factor(results, 'mcpg')}. "
        f"The seconds of a query with online supremizers are those of one with a fixed enrichment times: "
        f"{'; '.join(compared)} ([paper-obstacle](../results/paper-obstacle/README.md), "
        "[paper-hertz](../results/paper-hertz/README.md), [benefit](../results/benefit/README.md)).",
        "a ratio below 1 says that the enrichment with its many vectors is slower than the few supremizers of a query; "
        f"with CPG the factor is {_factor(results, 'cpg')}, so that there may be nothing to gain; the error of u "
        "becomes larger in "
        + " and ".join(f"{of(int((w < 1.0).sum()), len(w))} models ({p})" for p, w in worse.items())
        + "; a stability that PGA guarantees on the training set is missed elsewhere at times "
        "([comparison of strategies](field.md)).",
    )


def _factor(results: Results, dual: str) -> str:
    by = {p: enriched(cells[cells["dual"] == dual], "error_lambda_mean") for p, cells in results.full.items()}
    return " and ".join(f"{span(values)} ({p})" for p, values in by.items())


def cones(results: Results) -> pd.DataFrame:
    """Of every cone of the study `field` with online supremizers: ranges over the two tolerances, by problem."""
    rows = []
    for dual, mine in results.cones.groupby("dual", sort=False):
        row: dict[str, str] = {"cone": str(dual)}
        for problem in PROBLEMS:
            one = mine[mine["problem"] == problem]
            row |= {
                f"R, {problem}": span(one["R"], 3), f"error of λ, {problem}": span(one["error_lambda_mean"]),
                f"query [ms], {problem}": span(1e3 * one["online_s"]),
                f"offline [s], {problem}": span(one["offline_cone_s"]),
            }  # fmt: skip
        rows.append(row)
    return pd.DataFrame(rows)


def which_cone(results: Results) -> str:
    """Which dual strategy."""
    chosen = results.cones
    tight = chosen[chosen["pod_tol"] == chosen["pod_tol"].min()]
    best, few, cheap = (_least(tight, column) for column in ("error_lambda_mean", "R", "offline_cone_s"))
    pairs = chosen.set_index(["problem", "pod_tol", "dual"]).sort_index()
    mine = pairs.xs("mcpg", level="dual")
    others = {dual: pairs.xs(dual, level="dual") for dual in chosen["dual"].unique() if dual != "mcpg"}
    better = [
        d
        for d, o in others.items()
        if ((o["R"] < mine["R"]) & (o["error_lambda_mean"] < mine["error_lambda_mean"])).any()
    ]
    smallest = pairs.groupby(level=[0, 1])["R"].min()
    return question(
        "Which cone?",
        f"`mcpg` to begin with: {span(mine['R'] / smallest)} times the generators of the smallest cone, and offline "
        f"{span(mine['offline_cone_s'])} s ([field](../results/field/README.md), two problems, two tolerances).",
        (
            f"fewer generators and a smaller error on a problem, at one of the tolerances: {', '.join(better)}. "
            if better
            else ""
        )
        + f"At the tighter tolerances the smallest error of λ has {best}, the fewest generators {few}, the fastest "
        f"offline phase {cheap}.",
        "Ranges over the two tolerances, online supremizers, reduced assembly; offline seconds are those of the cone:",
        formats.to_markdown(cones(results)).strip(),
    )


def _least(cells: pd.DataFrame, column: str) -> str:
    rows = cells.loc[cells.groupby("problem")[column].idxmin()]
    return " and ".join(f"`{row['dual']}` ({number(row[column])}, {row['problem']})" for _, row in rows.iterrows())


def solvers(results: Results) -> pd.DataFrame:
    """Of every accuracy the solvers with every query ok, the fastest first: times the fastest one, cell by cell."""
    cells, rows = results.table("solvers"), []
    for accuracy, mine in cells.groupby("accuracy"):
        seconds = mine.assign(model=[" ".join(map(str, row)) for row in mine[MODEL].itertuples(index=False)])
        ratios = seconds["online_solve_s"] / seconds.groupby("model")["online_solve_s"].transform("min")
        for solver, group in seconds.assign(ratio=ratios.where(seconds["status"] == "ok")).groupby("solver"):
            fine = int((group["status"] == "ok").sum())
            rows.append(
                {
                    "accuracy": f"{accuracy:g}", "solver": str(solver), "cells ok": f"{fine} of {len(group)}",
                    "seconds, in those of the fastest": span(group["ratio"]) if fine else "–",
                    "mean": float(np.exp(np.log(group["ratio"]).mean())) if fine else np.nan, "all": fine == len(group),
                }
            )  # fmt: skip
    table = pd.DataFrame(rows)
    table["order"] = -table["accuracy"].astype(float)
    return table.sort_values(["order", "all", "mean"], ascending=[True, False, True], kind="stable").drop(
        columns="order"
    )


def which_solver(results: Results) -> str:
    """Which QP solver at which accuracy."""
    table = solvers(results)
    fine = table[table["all"]]
    first = fine.drop_duplicates("accuracy").groupby(["solver", "seconds, in those of the fastest"], sort=False)
    answers = [
        f"{solver} at {', '.join(rows['accuracy'])} ({seconds} times the seconds of the fastest solver of a model)"
        for (solver, seconds), rows in first
    ]
    failed = table[~table["all"]]
    return question(
        "Which solver, at which accuracy?",
        f"Of the solvers that solve every query, the fastest in the mean: {'; '.join(answers)} "
        "([solvers](../results/solvers/README.md)). " + _whole_queries(results, fine),
        f"these are small dense programs. {_default(table)} Not every query is solved by "
        + "; ".join(
            f"{', '.join(group['solver'])} at {accuracy}" for accuracy, group in failed.groupby("accuracy", sort=False)
        )
        + ".",
        "Seconds of the solver alone; the column mean is geometric, over the models in which all queries are ok:",
        formats.to_markdown(table.drop(columns="all")).strip(),
    )


def _whole_queries(results: Results, fine: pd.DataFrame) -> str:
    """In how many models the fastest solver is surely faster than others that solve every query at every accuracy.

    Whole queries are compared, by the intervals of their gains over the high-fidelity model.
    """
    accuracies = fine["accuracy"].nunique()
    first, *others = (solver for solver, rows in fine.groupby("solver", sort=False) if len(rows) == accuracies)
    cells = results.gains_of("solvers")
    gains = cells[cells["status"] == "ok"].set_index(["accuracy", *MODEL, "solver"])
    low, high = gains["gain_low"].unstack(), gains["gain_high"].unstack()
    above = [f"{solver} in {of(int((low[first] > high[solver]).sum()), len(low))}" for solver in others]
    how = " and ".join(cells["assembly"].unique())
    return (
        f"In whole queries, assembled in {how}, the interval of the gain of {first} over high-fidelity solutions lies "
        f"above that of {', '.join(above)} models."
    )


def _default(table: pd.DataFrame) -> str:
    """What the solver of most other pages takes."""
    mine = table[(table["solver"] == "piqp") & table["all"]]
    said = ", ".join(f"{row['seconds, in those of the fastest']} ({row['accuracy']})" for _, row in mine.iterrows())
    return f"Most other pages use piqp, which takes {said} times the seconds of the fastest."


def which_assembly(results: Results) -> str:
    """Full, reduced or compiled."""
    gains = results.gains
    by = {
        key: f"{span(mine['gain'])}, intervals within {span([mine['gain_low'].min(), mine['gain_high'].max()])}"
        for key, mine in gains.dropna(subset="gain").groupby(["assembly", "problem"])
    }
    said = "; ".join(
        f"{how} {' and '.join(f'{by[how, p]} ({p})' for p in PROBLEMS if (how, p) in by)}" for how in ASSEMBLIES
    )
    none = [
        f"of {problem} ({unavailable(mine)})"
        for problem, mine in gains[gains["assembly"] == "compiled"].groupby("problem", sort=False)
        if mine["gain"].isna().all()
    ]
    slow = gains[(gains["assembly"] == "full") & (gains["gain_high"] < 1.0)]
    models = gains.set_index([*MODEL, "assembly"])[["offline_s", "online_s"]]
    program, reduced = (models.xs(how, level="assembly").dropna() for how in ("compiled", "reduced"))
    reduced = reduced.reindex(program.index)
    later = break_even(program["offline_s"] - reduced["offline_s"], reduced["online_s"] - program["online_s"])
    return question(
        "Full, reduced or compiled?",
        f"Reduced, compiled where there is a program. Gains against high-fidelity solutions over the models of "
        f"[benefit](../results/benefit/README.md), errors unchanged: {said}.",
        f"in full assembly {of(len(slow), int((gains['assembly'] == 'full').sum()))} models are surely slower than "
        f"what they replace; a program takes {span(program['offline_s'])} s offline, the model in reduced assembly "
        f"{span(reduced['offline_s'])} s, so that the program is cheaper from {span(later)} queries on; problems with "
        "a member that can only be assembled as a whole are assembled in full"
        + ("; there is no C program " + "; ".join(none) if none else "")
        + ".",
    )


def which_training(results: Results) -> str:
    """Greedy or fixed training sets; offline seconds of two models scatter independently."""
    ways = ("greedy", "fixed")
    table = results.table("certified", "training")
    table = table.assign(
        seconds=table["greedy offline_s"] / table["fixed offline_s"],
        solutions=table["greedy snapshots"] / table["fixed snapshots"],
    )
    scatter = np.hypot(*(np.log(table[f"{one} offline_high_s"] / table[f"{one} offline_low_s"]) for one in ways)) / 2.0
    low, high = table["seconds"] * np.exp(-scatter), table["seconds"] * np.exp(scatter)
    equal = table.assign(low=low, high=high)[table["largest ratio of errors"] <= 1.0]
    said = "; ".join(
        f"{p}: {span(mine['seconds'])} times the offline seconds (intervals within "
        f"{span([mine['low'].min(), mine['high'].max()])}) with {span(mine['solutions'])} times the solutions"
        for p, mine in equal.groupby("problem")
    )
    return question(
        "Greedy or fixed training?",
        f"Fixed, unless a solution costs much more than here: at equal error, {said} "
        "([certified](../results/certified/README.md)).",
        "where a solution takes minutes, the number of solutions decides; in "
        f"{of(len(table) - len(equal), len(table))} comparisons no greedy model reaches all four errors of the "
        "fixed one.",
    )


def when_not(results: Results) -> str:
    """When not to reduce at all."""
    every = pd.concat([results.gains, *map(results.against, (f"paper-{p}" for p in PROBLEMS))])
    every["assembly"] = every["assembly"].fillna(every["assembly_b"])
    parts = []
    for problem, mine in every.groupby("problem", sort=False):
        for how, group in mine[mine["meaning"].notna()].groupby("assembly", sort=False):
            begins = group[group["meaning"] == "from"]["benefit_threshold"]
            never = int(group["meaning"].isin(["never", "until"]).sum())
            neither = int(group["meaning"].isin(["as fast", "undecided"]).sum())
            said = f"from {span(begins)} queries" if len(begins) else "at no number"
            parts.append(f"| {problem} | {how} | {len(group)} | {said} | {never} | {neither} |")
    least = every[every["meaning"] == "from"].groupby("problem")["threshold_low"].min()
    return question(
        "When not to reduce at all?",
        "For fewer queries than "
        + " and ".join(f"{number(value)} ({p})" for p, value in least.items())
        + ", the smallest lower end of the intervals of all break-evens with the high-fidelity model, no mixed model "
        "of these studies pays "
        "([benefit](../results/benefit/README.md), [paper-obstacle](../results/paper-obstacle/README.md), "
        "[paper-hertz](../results/paper-hertz/README.md)).",
        f"other formulations may pay earlier, from {_formulations(results)} queries on "
        "([formulations](../results/formulations/README.md)); seconds are those of small plane problems on one core; "
        "high-fidelity solutions start from the nearest contact set that is known. `vibench show RUN --table best "
        "--queries N` says it for yours.",
        "| problem | assembly | models | cheaper than high-fidelity solutions | never | as fast or undecided |\n"
        "| --- | --- | --- | --- | --- | --- |\n" + "\n".join(parts),
    )


def _formulations(results: Results) -> str:
    """From how many queries on the first model of another formulation is cheaper than high-fidelity solutions."""
    cells = results.table("formulations")
    cells = cells[(cells["status"] == "ok") & cells["problem"].isin(PROBLEMS) & (cells["formulation"] != "mixed")]
    queries = break_even(cells["offline_s"] - cells["hf_setup_s"], cells["hf_s"] - cells["online_s"])
    least = cells.assign(queries=queries).loc[queries.groupby(cells["problem"]).idxmin()]
    return " and ".join(
        f"{number(row['queries'])} ({row['problem']}, `{row['formulation']}`)" for _, row in least.iterrows()
    )


QUESTIONS = (enrich, which_cone, which_solver, which_assembly, which_training, when_not)


def what_to_use(results: Results) -> str:
    """The page "What to use"."""
    head = (
        "# What to use\n\nSix questions, answered from the tables of [all results](../results/README.md) by\n\n"
        "```\npython results/scripts/what_to_use.py results docs/what-to-use.md\n```\n\n"
        "Ranges are over all models of the studies that are linked; intervals are those of 95 % of [measured "
        "seconds](measurement.md#seconds). All of it is measured on two plane contact problems of 1,100 to 12,200 "
        "unknowns, on one machine: run your own problem before you rely on an answer."
    )
    return "\n\n".join([head, *(ask(results) for ask in QUESTIONS)]) + "\n"


def main(results: str, page: str) -> None:
    Path(page).write_text(what_to_use(Results(results)), encoding="utf-8")


if __name__ == "__main__":
    start(main)
