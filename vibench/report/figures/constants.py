"""Figures of inf-sup constants over the validation set (paper, Figures 8, 13 and 15)."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.interfaces.strategies import Kind
from vibench.report.figures.data import PRIMAL, Data, at_best_tolerance, by_strategy, dimensions, one_solver
from vibench.report.figures.style import BLACK, POINTS, Sheet, counted, line, plot, positive, style_of
from vibench.stability.infsup import VANISHES


def inf_sup(data: Data) -> Figure:
    """Inf-sup constants β of every primal strategy and of the high-fidelity pair over the validation set.

    First row: over the span; second row: over the cone, with the certified interval as a band. Fixed enrichments are
    shown at the tolerance of the smallest mean, and parameters are sorted by the constant of the first of these.
    """
    pairs = list(data.queries.groupby("pair", sort=False))
    sheet = Sheet(2, len(pairs), f"{data.problem}, {data.duals[0]}: inf-sup constants over the validation set")
    styles: dict[str, int] = {}
    for column, (_, of_pair) in enumerate(pairs):
        group = one_solver(of_pair)
        fixed = group[group["enrichment_kind"] == Kind.FIXED]
        smallest = -fixed.groupby(["primal", "primal_tol"], dropna=False)["beta_span"].mean()
        loosest = at_best_tolerance(fixed, smallest)
        sorting = loosest if len(loosest) else group
        first = sorting[sorting["cell"] == sorting["cell"].iloc[0]]
        order = first.sort_values("beta_span", kind="stable")["query"]
        kept = group[(group["enrichment_kind"] != Kind.FIXED) | group["cell"].isin(loosest["cell"])]
        axes = sheet.at(0, column), sheet.at(1, column)
        for number, (name, found) in enumerate(by_strategy(kept)):
            rows = found.set_index("query").reindex(order)
            _draw(axes, rows, "beta_", style_of(name, styles), name)
            if number == 0:
                _draw(axes, rows, "beta_hf_", BLACK, "high-fidelity")
        axes[0].set_title(dimensions(of_pair))
        for panel, generated in zip(axes, ("span", "cone"), strict=True):
            panel.set(ylabel=f"β over {generated}", xlabel="validation parameters, sorted", yscale="log")
            counted(panel)
    return sheet.finish()


def shares(data: Data) -> Figure | None:
    """Smallest shares of β over the span in that of the whole of V: over the validation against the training set.

    One point per fixed enrichment. Below the diagonal, validation parameters are less stable than the training set; the
    tick on the left of a point is √(1 − σ²), which bounds the share on the training set.
    """
    cells = data.cells[data.cells["share_training"].notna()].drop_duplicates([*PRIMAL, "dual", "pair"])
    if cells.empty:
        return None
    sheet = Sheet(1, len(cells["dual"].unique()), f"{data.problem}: shares of the inf-sup constant")
    styles: dict[str, int] = {}
    for panel, (dual, group) in zip(sheet.panels, cells.groupby("dual", sort=False), strict=True):
        panel.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=0.8, zorder=0)
        for primal, mine in group.groupby("primal", sort=False):
            k = style_of(str(primal), styles)
            plot(panel, mine["share_training"], mine["share_validation"], k, str(primal), **POINTS)
            panel.plot(mine["share_guaranteed"], mine["share_validation"], "|", color=line(k)["color"])
        panel.set(title=str(dual), xlabel="smallest share, training set", ylabel="smallest share, validation set")
    return sheet.finish()


def _draw(axes: tuple[Axes, Axes], rows: pd.DataFrame, prefix: str, k: int, name: str) -> None:
    """Constants over the span, and the interval over the cone as its upper end with a band."""
    top, below = axes
    x = np.arange(1, len(rows) + 1)
    span = rows[f"{prefix}span"].to_numpy(float)
    known = span[np.isfinite(span)]
    zero = known.size and known.max() < VANISHES
    plot(top, x, positive(span, VANISHES), k, f"{name} (0 over span)" if zero else name)
    lower, upper = rows[f"{prefix}cone_lower"].to_numpy(float), rows[f"{prefix}cone_upper"].to_numpy(float)
    plot(below, x, positive(upper, VANISHES), k)
    below.fill_between(x, lower, upper, color=line(k)["color"], alpha=0.2, linewidth=0.0)
