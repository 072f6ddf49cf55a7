"""Figures of inf-sup constants over the validation set (paper, Figures 8, 13 and 15)."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.interfaces.strategies import Kind
from vibench.report.figures.data import Data, label, one_solver, pair_title, pairs
from vibench.report.figures.style import BLACK, Sheet, counted, line, logarithmic, plot, positive
from vibench.stability.infsup import VANISHES


def inf_sup(data: Data) -> Figure:
    """β of every primal strategy and of the high-fidelity pair over the validation set.

    Over the span in the first row, over the cone in the second, where the interval is a band; parameters are sorted by
    the constant of the loosest fixed enrichment.
    """
    asked = pairs(data.queries)
    sheet = Sheet(2, len(asked), f"{data.problem}, {data.duals[0]}: inf-sup constants over the validation set")
    names: dict[str, int] = {}
    for column, (pair, of_pair) in enumerate(asked):
        group = one_solver(of_pair)
        loosest = _loosest(group)
        order = _order(loosest if len(loosest) else group)
        kept = group[(group["enrichment_kind"] != Kind.FIXED) | group["cell"].isin(loosest["cell"])]
        axes = sheet.at(0, column), sheet.at(1, column)
        for number, ((primal, tolerance), found) in enumerate(kept.groupby(["primal", "primal_tol"], dropna=False)):
            name = label(primal, tolerance)
            k = names.setdefault(name, _style(len(names)))
            rows = found.set_index("query").reindex(order)
            _draw(axes, rows, "beta_", k, name)
            if number == 0:
                _draw(axes, rows, "beta_hf_", BLACK, "high-fidelity")
        axes[0].set(ylabel="β over span", xlabel="validation parameters, sorted", title=pair_title(pair, data.cells))
        axes[1].set(ylabel="β over cone", xlabel="validation parameters, sorted")
        for panel in axes:
            logarithmic(panel)
            counted(panel)
    return sheet.finish()


def _style(k: int) -> int:
    """Style of the k-th strategy: all but the one of the high-fidelity pair."""
    return k if k < BLACK else k + 1


def _loosest(group: pd.DataFrame) -> pd.DataFrame:
    """Of every fixed enrichment the tolerance that leaves the smallest constants."""
    fixed = group[group["enrichment_kind"] == Kind.FIXED]
    reached = fixed.groupby(["primal", "primal_tol"], dropna=False)["beta_span"].mean().reset_index()
    kept = reached.sort_values("beta_span").drop_duplicates("primal")
    if kept.empty:
        return fixed
    wanted = set(zip(kept["primal"], kept["primal_tol"].fillna(-1.0), strict=True))
    rows = [key in wanted for key in zip(fixed["primal"], fixed["primal_tol"].fillna(-1.0), strict=True)]
    return fixed[rows]


def _order(found: pd.DataFrame) -> pd.Series:
    first = found[found["cell"] == found["cell"].iloc[0]]
    return first.sort_values("beta_span", kind="stable")["query"]


def _draw(axes: tuple[Axes, Axes], rows: pd.DataFrame, prefix: str, k: int, name: str) -> None:
    """One strategy's span constants, and its cone interval as a line with a band."""
    top, below = axes
    x = np.arange(1, len(rows) + 1)
    span = rows[f"{prefix}span"].to_numpy(float)
    known = span[np.isfinite(span)]
    zero = len(known) > 0 and bool(np.all(known < VANISHES))
    plot(top, x, positive(span, VANISHES), k, f"{name} (0 over span)" if zero else name)
    lower, upper = rows[f"{prefix}cone_lower"].to_numpy(float), rows[f"{prefix}cone_upper"].to_numpy(float)
    plot(below, x, positive(upper, VANISHES), k)
    below.fill_between(x, lower, upper, color=line(k)["color"], alpha=0.2, linewidth=0.0)
