"""What strategies cost and what they give for it: errors against dimension and seconds, total cost and thresholds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.report.figures.data import Data, best_solver, label, pair_title, pairs
from vibench.report.figures.style import BLACK, COLOURS, MARKERS, Sheet, logarithmic, plot
from vibench.results.break_even import HIGH_FIDELITY, Meaning

ERRORS = (("error_u_mean", "mean relative error of u"), ("error_lambda_mean", "mean relative error of λ"))

MOST_QUERIES = 1e6
"""Total cost is drawn up to this number of queries."""

ABREAST = 6
"""Panels in a row."""


def dimension(data: Data) -> Figure | None:
    """Errors against the dimension of the reduced problem, N + S + R."""
    cells = best_solver(data.cells)
    cells = cells[(cells["assembly"] == "full") | ~(cells["assembly"] == "full").any()]
    size = cells["N"] + cells["enrichment"].fillna(0) + cells["R"]
    return _scatter(data, cells, size, "dimension N + S + R", "errors against dimension")


def work_precision(data: Data) -> Figure | None:
    """Errors against the seconds of a query: below and to the left is better; no strategy beats those on the line."""
    cells = best_solver(data.cells)
    return _scatter(data, cells, 1e3 * cells["online_s"], "mean time of a query [ms]", "work and precision", best=True)


def _scatter(
    data: Data, cells: pd.DataFrame, x: pd.Series, xlabel: str, said: str, *, best: bool = False
) -> Figure | None:
    """One point per cell: colour and marker say which primal strategy and which assembly, the face which cone."""
    known = cells[ERRORS[0][0]].notna() & x.notna()
    cells, x = cells[known], x[known]
    if cells.empty:
        return None
    sheet = Sheet(1, 2, f"{data.problem}, {cells['solver'].iloc[0]}: {said}")
    kinds = list(dict.fromkeys(zip(cells["primal"], cells["assembly"], strict=True)))
    duals = list(dict.fromkeys(cells["dual"]))
    for panel, (column, ylabel) in zip(sheet.panels, ERRORS, strict=True):
        for k, (primal, assembly) in enumerate(kinds):
            for number, dual in enumerate(duals):
                mine = (cells["primal"] == primal) & (cells["assembly"] == assembly) & (cells["dual"] == dual)
                if mine.any():
                    name = f"{label(primal, None, assembly)}, {dual}"
                    panel.plot(x[mine], cells[column][mine], label=name, **_point(k, number))
        if best:
            front = _front(x.to_numpy(float), cells[column].to_numpy(float))
            panel.plot(*front, color="0.6", linewidth=0.8, drawstyle="steps-post", zorder=0)
        panel.set(xlabel=xlabel, ylabel=ylabel)
        logarithmic(panel, "xy")
    return sheet.finish()


def _point(k: int, dual: int) -> dict[str, Any]:
    faces = (COLOURS[k % len(COLOURS)], "white", "0.75")
    return {
        "linestyle": "none",
        "color": COLOURS[k % len(COLOURS)],
        "marker": MARKERS[(k + k // len(COLOURS)) % len(MARKERS)],
        "markersize": 5,
        "markerfacecolor": faces[dual % len(faces)],
        "markeredgewidth": 1.0 + dual // len(faces),
    }


def _front(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points that no other beats in both, from left to right."""
    order = np.lexsort((y, x))
    best = np.minimum.accumulate(y[order])
    kept = np.concatenate([[True], best[1:] < best[:-1]])
    return x[order][kept], y[order][kept]


def total_cost(data: Data) -> Figure | None:
    """Seconds in all against the number of queries; marks where a way of reducing begins, or ends, to pay."""
    cells = best_solver(data.cells)
    if cells.empty:
        return None
    thresholds = data.thresholds[data.thresholds["solver"] == cells["solver"].iloc[0]]
    shown = [(dual, pair, mine) for dual, group in cells.groupby("dual", sort=False) for pair, mine in pairs(group)]
    columns = min(len(shown), ABREAST)
    rows = -(-len(shown) // columns)
    sheet = Sheet(rows, columns, f"{data.problem}, {cells['solver'].iloc[0]}: total cost")
    names: dict[str, int] = {}
    for panel, (dual, pair, mine) in zip(sheet.panels, shown, strict=False):
        _lines(panel, mine, names)
        _marks(panel, mine, thresholds[thresholds["dual"] == dual])
        title = f"{dual}, {pair_title(pair, mine)}"
        panel.set(xlabel="number of queries", ylabel="offline + online [s]", title=title)
        panel.set_xlim(1.0, MOST_QUERIES)
        logarithmic(panel, "xy")
    for panel in sheet.panels[len(shown) :]:
        panel.set_axis_off()
    return sheet.finish()


def _lines(panel: Axes, cells: pd.DataFrame, names: dict[str, int]) -> None:
    queries = np.geomspace(1.0, MOST_QUERIES, 61)
    for number, cell in enumerate(_tightest(cells).itertuples()):
        if number == 0:
            plot(panel, queries, queries * cell.hf_s, BLACK, HIGH_FIDELITY)
        name = label(cell.primal, cell.primal_tol, cell.assembly)
        k = names.setdefault(name, len(names) + (len(names) >= BLACK))
        plot(panel, queries, cell.offline_s + queries * cell.online_s, k, name)


def _tightest(cells: pd.DataFrame) -> pd.DataFrame:
    """Of every strategy and assembly the cell with the most vectors."""
    order = cells.assign(added=cells["enrichment"].fillna(0)).sort_values("added", ascending=False, kind="stable")
    return order.drop_duplicates(["primal", "primal_options", "assembly"]).sort_index()


def _marks(panel: Axes, cells: pd.DataFrame, thresholds: pd.DataFrame) -> None:
    """Where two of the lines cross: thresholds between them, at their cost."""
    known = {(cell.primal, _number(cell.primal_tol), cell.assembly): cell for cell in _tightest(cells).itertuples()}
    for row in thresholds.itertuples():
        b = known.get((row.primal_b, _number(row.primal_tol_b), row.assembly_b))
        a = known.get((row.primal_a, _number(row.primal_tol_a), row.assembly_a))
        between = row.primal_a == HIGH_FIDELITY or (a is not None and a.offline_s == row.offline_a_s)
        if b is None or b.offline_s != row.offline_b_s or not between or pd.isna(row.benefit_threshold):
            continue
        n = row.benefit_threshold
        if not 1.0 <= n <= MOST_QUERIES:
            continue
        label_once = "benefit threshold: from here" if row.meaning == Meaning.FROM else "benefit threshold: until here"
        marker = ">" if row.meaning == Meaning.FROM else "<"
        panel.plot(
            [n], [row.offline_b_s + n * row.online_b_s], marker, color="black", markersize=5,
            markerfacecolor="none", label=label_once, zorder=5,
        )  # fmt: skip


def _number(tolerance: float | None) -> float:
    return -1.0 if tolerance is None or pd.isna(tolerance) else float(tolerance)
