"""The answer sheet of a problem: a solution, its stability, what accuracy costs, and when a reduced model pays."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.interfaces.strategies import Kind
from vibench.report.figures import style
from vibench.report.figures.data import ProblemTables, label
from vibench.report.figures.solutions import draw_alone
from vibench.report.figures.spaces import draw_stability
from vibench.report.figures.style import CaptionedFigure, Layout, Looks, Series, Sheet, plot, scatter
from vibench.results.break_even import HIGH_FIDELITY, Meaning
from vibench.results.ranking import contenders, errors_of_solution
from vibench.results.schema import Row
from vibench.results.verdict import Verdict, verdicts
from vibench.study.cells import NO_SUCH_AXIS


def answer(data: ProblemTables) -> CaptionedFigure | None:
    """A solution, β over µ, errors against the time of a query, and total cost over the number of queries.

    The lower panels compare the best model of the verdict with those of the same solver.
    """
    verdict = next(verdicts(data.cells, data.thresholds), None)
    best = None if verdict is None else verdict.best
    shown = [one for one in data.pictures if one.picture is not None]
    if best is None and not shown:
        return None
    sheet = Sheet(2, 2, f"{data.problem}: does a reduced model pay?", Layout(1.9, 1.7, "every"))
    field, stability, errors, cost = sheet.panels
    beginning = (
        f"Four panels show whether a reduced model of {data.problem} pays: a solution, inf-sup constants, errors "
        "against the time of a query, and total cost against the number of queries."
    )
    lines = [draw_alone(field, shown[len(shown) // 2])] if shown else [_empty(field, "No solution is recorded.")]
    if verdict is None or best is None:
        nothing = "No model takes part in a comparison."
        lines += [_empty(panel, nothing) for panel in (stability, errors, cost)]
        return sheet.finish(" ".join([beginning, *lines]))
    rivals = _rivals(data, best)
    # The strategy of the best cell, and three with the smallest errors.
    smallest = rivals.groupby("primal", sort=False)["error"].min().drop(best["primal"], errors="ignore").nsmallest(3)
    names = sorted([str(best["primal"]), *map(str, smallest.index)])
    looks = Looks(map(Series, names))
    lines.append(draw_stability(stability, data, best, names, looks) or _empty(stability, "There are no constants."))
    sheet.label_ends(stability)
    _draw_errors(errors, rivals, names, looks, verdict)
    left_out = rivals["primal"].nunique() - len(names)
    lines.append(
        "Lower left, the larger of the mean errors of u and λ against the mean time of a query, a point for every "
        "model with every query ok; the black line is a full solution, the dotted one "
        f"{100 * verdict.error:g} %." + f" {left_out} other strategies are in the tables." * (left_out > 0)
    )
    _draw_costs(cost, _three(rivals, best), data.thresholds)
    sheet.label_ends(errors)
    sheet.label_ends(cost)
    lines.append(
        "Lower right, CPU seconds offline and online together against the number of queries, of the full model, the "
        "best one, and the fastest of the other kind, enriched or not; a triangle, with its 95 % interval, marks from "
        "where the best model is cheaper."
    )
    return sheet.finish(" ".join([beginning, *lines]))


def _empty(panel: Axes, text: str) -> str:
    """Leave a panel out, and say why, in its place and in the caption."""
    panel.set_axis_off()
    panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center")
    return text


def _rivals(data: ProblemTables, best: Row) -> pd.DataFrame:
    """The cells that are compared with the best one, itself included: those of its solver, and those without one."""
    cells = contenders(data.cells)
    alike = (cells["solver"] == best["solver"]) & (cells["accuracy"] == best["accuracy"])
    compared = cells[alike | (cells["solver"] == NO_SUCH_AXIS)]
    # Each gain is measured in the rounds of its cell, when the machine had one speed.
    seconds = float(best["hf_s"]) * compared["online_s"].astype(float) / compared["hf_s"].astype(float)
    return compared.assign(error=errors_of_solution(compared), ms=1e3 * seconds)


def _draw_errors(panel: Axes, cells: pd.DataFrame, names: list[str], looks: Looks, verdict: Verdict) -> None:
    for name in names:
        mine = cells[(cells["primal"] == name) & (cells["error"] > 0.0)].sort_values("error", ascending=False)
        # Its name stands beside the panel as high as the last of its points, the one with the smallest error.
        scatter(panel, mine["ms"], mine["error"], looks[Series(name)], name)
    full, limit = 1e3 * verdict.full_s, f"{100 * verdict.error:g} %"
    panel.axvline(full, color="black")
    panel.annotate("full solution", (full, 0.98), xycoords=("data", "axes fraction"), xytext=(-2, 0),
                   textcoords="offset points", rotation=90, ha="right", va="top", fontsize=7)  # fmt: skip
    panel.axhline(verdict.error, color="0.4", linewidth=0.8, linestyle=(0, (1, 2)))
    panel.annotate(limit, (0.0, verdict.error), xycoords=("axes fraction", "data"), xytext=(3, 2),
                   textcoords="offset points", fontsize=7)  # fmt: skip
    panel.set(xlabel="mean time of a query [ms]", ylabel="mean error of u and λ", xscale="log", yscale="log")
    panel.margins(0.12)


def _three(cells: pd.DataFrame, best: Row) -> pd.DataFrame:
    """The best cell, and the fastest of the other kind, enriched or not, among those at most twice as inaccurate."""
    own = cells[cells["cell"] == best["cell"]]
    enriched = cells["enrichment_kind"] != Kind.NONE
    other = cells[enriched != (best["enrichment_kind"] != Kind.NONE)]
    near = other[other["error"] <= 2.0 * max(float(own["error"].iloc[0]), 0.01)]
    return pd.concat([own, (near if len(near) else other).nsmallest(1, "online_s")])


def _draw_costs(panel: Axes, cells: pd.DataFrame, thresholds: pd.DataFrame) -> None:
    queries, looks = np.geomspace(1.0, 1e6, 61), Looks(Series(cell.primal, way=cell.way) for cell in cells.itertuples())
    one = cells.iloc[0]
    plot(panel, queries, one["hf_setup_s"] + queries * one["hf_s"], style.HIGH_FIDELITY_LOOK, HIGH_FIDELITY)
    for cell in cells.itertuples():
        total, look = cell.offline_s + queries * cell.online_s, looks[Series(cell.primal, way=cell.way)]
        plot(panel, queries, total, look, label(cell.primal, None, cell.way))
    against = thresholds[thresholds["cell_a"].isna() & (thresholds["cell_b"] == one["cell"])]
    for row in against[against["benefit_threshold"].between(1.0, queries[-1])].itertuples():
        at = row.offline_b_s + row.benefit_threshold * row.online_b_s
        shape = {Meaning.FROM: ">", Meaning.UNTIL: "<"}[Meaning(row.meaning)]
        panel.plot(row.benefit_threshold, at, shape, c="black", ms=5, mfc="white", zorder=5)
        panel.hlines(at, row.threshold_low, row.threshold_high, colors="black", lw=0.8, zorder=5)
        panel.annotate(f"{row.benefit_threshold:.0f} queries", (row.benefit_threshold, at), (4, -9),
                       textcoords="offset points", fontsize=7)  # fmt: skip
    panel.set(xlabel="number of queries", ylabel="offline + online [s]", xlim=(1.0, queries[-1]))
    panel.set(xscale="log", yscale="log")
