"""Results of the study `field`: the Pareto front of error against time, cones, enrichments.

vibench run field --no-figures && python results/scripts/field.py runs/field results/field

Everything comes from the results file: β_S and β_on at the training parameters from the histories, the rest from the
cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from page import SECONDS, Page, made_by, origin, read, start

from vibench.report.figures.data import label
from vibench.report.figures.style import Looks, Series, Sheet, look_of, plot, styled

SHARES = (0.3, 0.5, 0.7, 0.9)
REFERENCE = "mcpg"
CONTROL = "pod-dual (negative control)"
"""Its generators are not in W⁺: it is drawn and left out of the fronts."""

PAIR = ["problem", "pod_tol", "dual_tol"]
CELL = [*PAIR, "dual", "primal", "primal_tol"]


@dataclass(frozen=True)
class Field:
    """Tables of a run.

    Attributes
    ----------
    cells
        One row per cell.
    steps
        One row per enrichment and number of vectors: the smallest share β_S / β_on over the training set.
    """

    cells: pd.DataFrame
    steps: pd.DataFrame

    @classmethod
    def of(cls, run: str) -> Field:
        """Read the tables of a run."""
        histories = read(run, "histories")
        steps = histories[histories["quantity"] == "share_min"].rename(columns={"value": "share"})
        return cls(read(run, "cells"), steps.sort_values(["artefact", "step"]))

    def longest(self) -> Iterator[tuple[tuple[Any, ...], pd.DataFrame]]:
        """Key and steps of the largest enrichment of every primal strategy, in the order of the cells.

        The key is problem, both tolerances, dual and primal strategy.
        """
        strategies = [*PAIR, "dual", "primal"]
        grouped = dict(list(self.steps.groupby(strategies)))
        for key in self.cells[strategies].drop_duplicates().itertuples(index=False, name=None):
            if key in grouped:
                last = grouped[key].groupby("artefact")["step"].max().idxmax()
                yield key, grouped[key][grouped[key]["artefact"] == last]

    @property
    def tight(self) -> pd.DataFrame:
        """Cells at the tighter of the two accuracies."""
        return self.cells[self.cells["pod_tol"] == self.cells["pod_tol"].min()]


def vectors(field: Field) -> pd.DataFrame:
    """Numbers of vectors with which every fixed enrichment reaches the shares of β_on."""
    rows: dict[tuple[Any, ...], dict[str, str]] = {}
    for key, steps in field.longest():
        share = steps["share"].to_numpy()
        reached = [next((str(k) for k, value in enumerate(share) if value >= s), "–") for s in SHARES]
        rows.setdefault(key[:4], {})[key[4]] = " / ".join(reached)
    counts = pd.DataFrame.from_dict(rows, orient="index")
    counts.index = pd.MultiIndex.from_tuples(counts.index, names=[*PAIR, "dual"])
    return counts.reset_index()


def cones(field: Field) -> pd.DataFrame:
    """Size, conditioning, seconds of every cone, and errors with online supremizers."""
    chosen = field.cells[(field.cells["primal"] == "online-supremizers") & (field.cells["assembly"] == "full")]
    return pd.DataFrame(
        {
            **{name: chosen[name] for name in [*PAIR, "dual", "R", "rank"]},
            "condition of G": chosen["gram_condition"],
            "cone [s]": chosen["offline_cone_s"],
            "error u": chosen["error_u_mean"],
            "error λ": chosen["error_lambda_mean"],
            "fallbacks": chosen["fallbacks"].fillna(""),
        }
    )


def primals(field: Field) -> pd.DataFrame:
    """Final share of β_on, errors and seconds of every enrichment, with the cone of mcpg."""
    chosen = field.tight[field.tight["dual"] == REFERENCE]
    full, reduced = (chosen[chosen["assembly"] == assembly].set_index(CELL) for assembly in ("full", "reduced"))
    ends = field.steps.groupby(CELL, dropna=False)["share"].last()
    rows = []
    for key, cell in full.iterrows():
        share = 1.0 if cell["enrichment_kind"] == "per-parameter" else ends.get(key)
        rows.append(
            dict(zip(CELL, key, strict=True))
            | {
                "N": cell["N"],
                "added": cell["enrichment"],
                "share of β_on": share,
                "error u": cell["error_u_mean"],
                "error λ": cell["error_lambda_mean"],
                "enrichment [s]": cell["offline_enrichment_s"],
                "reduction [s]": reduced.loc[[key]]["offline_assembly_s"].iloc[0],
                "query, full [ms]": 1e3 * cell["online_s"],
                "query, reduced [ms]": 1e3 * reduced.loc[[key]]["online_s"].iloc[0],
            }
        )
    return pd.DataFrame(rows).drop(columns=["pod_tol", "dual_tol", "dual"])


def front(cells: pd.DataFrame, cost: pd.Series, error: str) -> pd.DataFrame:
    """Pareto front of cost and error: cells with every query ok, cheapest first, without the negative control."""
    fine = (cells["status"] == "ok") & (cells["dual"] != CONTROL)
    ordered = cells.assign(cost=cost)[fine].sort_values(["cost", error])
    best = ordered[error].cummin().shift(fill_value=np.inf)
    return ordered[ordered[error] < best]


def fronts(field: Field) -> pd.DataFrame:
    """Pareto fronts of the error of λ against the milliseconds of a reduced query."""
    rows = []
    reduced = field.cells[field.cells["assembly"] == "reduced"]
    for problem, cells in reduced.groupby("problem", sort=False):
        for _, cell in front(cells, 1e3 * cells["online_s"], "error_lambda_mean").iterrows():
            strategies = {"dual": cell["dual"], "primal": label(cell["primal"], cell["primal_tol"])}
            errors = {"error u": cell["error_u_mean"], "error λ": cell["error_lambda_mean"]}
            rows.append({"problem": problem, "query [ms]": cell["cost"]} | strategies | errors)
    return pd.DataFrame(rows)


def failures(field: Field) -> pd.DataFrame:
    """Every cell that is not ok."""
    short = field.cells[field.cells["status"] != "ok"]
    return short[[*CELL, "assembly", "status", "queries_ok", "reason"]]


def draw_shares(field: Field) -> Figure:
    """Share of β_on over vectors, one line per primal strategy, with the cone of mcpg."""
    chosen = [(key, steps) for key, steps in field.longest() if key[3] == REFERENCE]
    pairs = list(dict.fromkeys(key[:3] for key, _ in chosen))
    sheet = Sheet(2, -(-len(pairs) // 2), "Smallest share of β_S(µ) in β_on(µ) over the training set, cone of mcpg")
    looks = Looks(Series(key[4]) for key, _ in chosen)
    for panel, pair in zip(sheet.panels, pairs, strict=True):
        for key, steps in chosen:
            if key[:3] == pair:
                plot(panel, steps["step"], steps["share"], looks[Series(key[4])], key[4])
        panel.set(
            title=f"{pair[0]}, δ_POD = {pair[1]:g}, δ = {pair[2]:g}", xlabel="vectors added", ylabel="share of β_on"
        )
    return sheet.finish(
        "Smallest share of β over the span in that of online supremizers over the training set, over the number of "
        f"vectors, with the cone of {REFERENCE}; a panel for every problem and pair of tolerances, a line for every "
        "enrichment."
    )


def scatter(field: Field, cost: Callable[[pd.DataFrame], pd.Series], xlabel: str, title: str) -> Figure:
    """Errors of λ over a cost: one colour per cone, one marker per enrichment, the Pareto front as a line."""
    cells = field.cells[(field.cells["assembly"] == "reduced") & field.cells["error_lambda_mean"].notna()]
    duals, primals = list(dict.fromkeys(cells["dual"])), list(dict.fromkeys(cells["primal"]))
    names, markers = list(dict.fromkeys(cells["problem"])), "os^vDPX*dph"
    sheet = Sheet(1, len(names), title)
    for panel, problem in zip(sheet.panels, names, strict=True):
        mine = cells[cells["problem"] == problem]
        for dual in duals:
            panel.plot([], [], color=look_of(dual.partition(" ")[0]).colour, linewidth=3, label=dual)
        for k, primal in enumerate(primals):
            panel.plot([], [], color="0.3", linestyle="none", marker=markers[k % len(markers)], label=primal)
        for (dual, primal), group in mine.groupby(["dual", "primal"], sort=False):
            panel.plot(
                cost(group),
                group["error_lambda_mean"],
                linestyle="none",
                color=look_of(dual.partition(" ")[0]).colour,
                marker=markers[primals.index(primal) % len(markers)],
                markersize=4,
            )
        best = front(mine, cost(mine), "error_lambda_mean")
        panel.plot(
            best["cost"], best["error_lambda_mean"], color="0.6", linewidth=0.8, drawstyle="steps-post", zorder=0
        )
        panel.set(title=problem, xlabel=xlabel, ylabel="mean relative error of λ")
        panel.set(xscale="log", yscale="log")
    return sheet.finish(
        f"{title}: one point per cell with reduced assembly; colours are cones, markers are enrichments, and the grey "
        f"line is the Pareto front, in which {CONTROL} takes no part."
    )


TABLES: dict[str, tuple[str, Callable[[Field], pd.DataFrame]]] = {
    "cones": (
        "sizes, conditioning of the Gram matrix G of the generators in W, and errors with online supremizers, which "
        "reach the inf-sup constants of the whole of V",
        cones,
    ),
    "enrichments": (
        f"cone of {REFERENCE}, tighter tolerances; the share is the smallest of β_S(µ) / β_on(µ), both over the span, "
        "on the training set, and 1 where supremizers are added at every parameter",
        primals,
    ),
    "vectors": (
        "smallest numbers of vectors with which β_S(µ) at every training parameter reaches the shares "
        f"{', '.join(map(str, SHARES))} of β_on(µ); a dash where no tolerance of the study reaches the share",
        vectors,
    ),
    "not-ok": ("cells that are not ok, and why", failures),
}


def main(run: str, target: str) -> None:
    field = Field.of(run)
    page = Page(
        target,
        "Which cone, and which enrichment?",
        made_by("field", "field", "field", options=" --no-figures"),
        SECONDS,
        f"{len(field.cells)} cells, {int((field.cells['status'] == 'ok').sum())} with every query ok. `vibench run "
        "field` leaves the tables of all queries and histories under `runs/field/tables`.",
        machine=origin(field.cells),
    )
    best = fronts(field)
    first, second, *_ = best["dual"].value_counts().index
    page.answer(
        f"{len(best)} models are beaten by no other one in both the error of λ and the seconds of a query. Most of "
        f"them have the cones `{first}` and `{second}`; {int((best['primal'] != 'decorrelated').sum())} are enriched.",
    )
    title = "Error of λ against online time"
    with styled():
        page.draw("field-time", scatter(field, lambda cells: 1e3 * cells["online_s"], "query, reduced [ms]", title))
        page.draw("field-shares", draw_shares(field))
    page.file("fronts", f"these models; {CONTROL} is left out", best)
    for name, (about, table) in TABLES.items():
        page.file(name, about, table(field))
    page.file("cells", "every cell, with all columns", field.cells.drop(columns=["definition", "versions"]))
    page.write()


if __name__ == "__main__":
    start(main)
