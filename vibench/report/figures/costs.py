"""Errors against dimension and time of a query, and total cost against the number of queries."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.report.common_queries import on_common_queries
from vibench.report.figures.data import Data, best_solver, by_dimensions, label
from vibench.report.figures.style import BLACK, POINTS, Sheet, legend_label, line, plot, positive, style_of
from vibench.results.break_even import HIGH_FIDELITY, Meaning

ERRORS = {"error_u_mean": "mean relative error of u", "error_lambda_mean": "mean relative error of λ"}

MOST_QUERIES = 1e6
"""Total cost is drawn up to this number of queries."""

ABREAST = 6
"""Panels in a row."""

MARKS = {Meaning.FROM: ">", Meaning.UNTIL: "<"}


def dimension(data: Data) -> Figure | None:
    """Errors against the dimension of the reduced problem, N + S + R; means over the queries that all cells solved."""
    cells = best_solver(data.cells)
    cells = cells[(cells["assembly"] == "full") | ~(cells["assembly"] == "full").any()]
    size = cells["N"] + cells["enrichment"].fillna(0) + cells["R"]
    return _scatter(data, cells, size, "dimension N + S + R", "errors against dimension")


def work_precision(data: Data) -> Figure | None:
    """Errors against the time of a query; no cell is both faster and more accurate than those on the line.

    Errors are means over the queries that all of these cells solved; a cell that solved fewer than half has no point.
    """
    cells = best_solver(data.cells)
    return _scatter(data, cells, 1e3 * cells["online_s"], "mean time of a query [ms]", "work and precision", front=True)


def _scatter(
    data: Data, cells: pd.DataFrame, x: pd.Series, xlabel: str, title: str, *, front: bool = False
) -> Figure | None:
    """One point per cell: colour and marker for primal strategy and assembly, filling for the dual strategy."""
    compared = on_common_queries(cells[x.notna()], data.queries)
    cells = compared.cells[compared.cells[list(ERRORS)].notna().any(axis=1)]
    if cells.empty:
        return None
    sheet = Sheet(1, 2, f"{data.problem}, {cells['solver'].iloc[0]}: {title}{compared.over}")
    kinds = list(dict.fromkeys(zip(cells["primal"], cells["assembly"], strict=True)))
    duals = list(cells["dual"].unique())
    for panel, (column, ylabel) in zip(sheet.panels, ERRORS.items(), strict=True):
        for (primal, assembly, dual), mine in cells.groupby(["primal", "assembly", "dual"]):
            point = _point(kinds.index((primal, assembly)), duals.index(dual))
            name = f"{label(primal, None, assembly)}, {dual}"
            panel.plot(x[mine.index], mine[column], label=legend_label(name), **point)
        if front:
            drawn = cells[cells[column].notna()]
            line_of = _front(x[drawn.index].to_numpy(float), drawn[column].to_numpy(float))
            panel.plot(*line_of, color="0.6", linewidth=0.8, drawstyle="steps-post", zorder=0)
        panel.set(xlabel=xlabel, ylabel=ylabel, xscale="log", yscale="log")
    return sheet.finish()


def outputs(data: Data) -> Figure | None:
    """Errors of every quantity of interest, over its largest value of the training set, against the time of a query."""
    cells = best_solver(data.cells).set_index("cell", drop=False)
    mine = data.outputs[data.outputs["cell"].isin(cells.index) & data.outputs["error_scaled_mean"].notna()]
    if mine.empty:
        return None
    names = list(mine["output"].unique())
    sheet = Sheet(1, len(names), f"{data.problem}, {cells['solver'].iloc[0]}: quantities of interest")
    kinds = list(dict.fromkeys(zip(cells["primal"], cells["assembly"], strict=True)))
    duals = list(cells["dual"].unique())
    for panel, name in zip(sheet.panels, names, strict=True):
        found = mine[mine["output"] == name]
        for (primal, assembly, dual), one in found.groupby(["primal", "assembly", "dual"]):
            point = _point(kinds.index((primal, assembly)), duals.index(dual))
            seconds = 1e3 * cells.loc[one["cell"], "online_s"].to_numpy(float)
            text = legend_label(f"{label(primal, None, assembly)}, {dual}")
            panel.plot(seconds, positive(one["error_scaled_mean"]), label=text, **point)
        panel.set(xlabel="mean time of a query [ms]", ylabel="mean error over the scale", title=str(name))
        panel.set(xscale="log", yscale="log")
    return sheet.finish()


def _point(k: int, dual: int) -> dict[str, Any]:
    style = line(k)
    faces = (style["color"], "white", "0.75")
    look = {"markersize": 5, "markerfacecolor": faces[dual % len(faces)], "markeredgewidth": 1.0 + dual // len(faces)}
    return style | POINTS | look


def _front(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The Pareto front of points to be small in x and y, from left to right."""
    order = np.lexsort((y, x))
    best = np.minimum.accumulate(y[order])
    kept = np.concatenate([np.ones(min(len(best), 1), dtype=bool), best[1:] < best[:-1]])
    return x[order][kept], y[order][kept]


def total_cost(data: Data) -> Figure | None:
    """Offline and online seconds against the number of queries; triangles mark where two models break even."""
    cells = best_solver(data.cells)
    if cells.empty:
        return None
    shown = by_dimensions(cells)
    columns = min(len(shown), ABREAST)
    sheet = Sheet(-(-len(shown) // columns), columns, f"{data.problem}, {cells['solver'].iloc[0]}: total cost")
    styles: dict[str, int] = {}
    for panel, (title, mine) in zip(sheet.panels, shown, strict=False):
        # The most vectors stand for every strategy and assembly: a line per tolerance would hide the crossings.
        added = mine.assign(added=mine["enrichment"].fillna(0)).sort_values("added", ascending=False, kind="stable")
        most = added.drop_duplicates(["primal", "primal_options", "assembly"]).sort_index()
        queries = np.geomspace(1.0, MOST_QUERIES, 61)
        model = most.iloc[0]
        plot(panel, queries, model["hf_setup_s"] + queries * model["hf_s"], BLACK, HIGH_FIDELITY)
        for cell in most.itertuples():
            name = label(cell.primal, cell.primal_tol, cell.assembly)
            plot(panel, queries, cell.offline_s + queries * cell.online_s, style_of(name, styles), name)
        _marks(panel, most, data.thresholds)
        panel.set(xlabel="number of queries", ylabel="offline + online [s]", title=title)
        panel.set(xlim=(1.0, MOST_QUERIES), xscale="log", yscale="log")
    for panel in sheet.panels[len(shown) :]:
        panel.set_axis_off()
    return sheet.finish()


def _marks(panel: Axes, cells: pd.DataFrame, thresholds: pd.DataFrame) -> None:
    """Break-even points between the lines of a panel, at their cost, with their intervals."""
    drawn = set(cells["cell"])
    for row in thresholds.itertuples():
        n, between = row.benefit_threshold, pd.isna(row.cell_a) or row.cell_a in drawn
        if row.cell_b in drawn and between and 1.0 <= n <= MOST_QUERIES:
            cost, name = row.offline_b_s + n * row.online_b_s, f"break-even: cheaper {row.meaning} here"
            panel.plot(n, cost, MARKS[row.meaning], c="black", ms=5, mfc="none", label=name, zorder=5)
            panel.plot([row.threshold_low, row.threshold_high], [cost, cost], c="black", lw=0.8, zorder=5)
