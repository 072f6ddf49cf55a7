"""Figures of the offline phase: mesh, projection errors, enrichment (paper, Figures 3, 5 to 7, 11, 12 and 14)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.arrays import Array
from vibench.interfaces.strategies import Kind
from vibench.report.figures.data import Data, at_best_tolerance, by_strategy, dimensions, label, longest, one_solver
from vibench.report.figures.style import POINTS, Sheet, counted, plot, positive, style_of

ROUND_OFF = 1e-12
"""The tail of a POD below this is round-off."""

SINE_FLOOR = 1e-14
"""Sines below this are round-off."""

DIAGNOSED = ("training", "validation")
GROWTH = {"sigma": "largest σ, training set", "beta_span_min": "min β over span, training set"}


def diagnostics(data: Data) -> Figure | None:
    """Quantities that the problem reports at every parameter, such as the largest aspect ratio (paper, Figure 3)."""
    found = data.histories[data.histories["stage"].isin(DIAGNOSED)]
    if found.empty:
        return None
    quantities = found["quantity"].unique()
    sheet = Sheet(1, len(quantities), f"{data.problem}: diagnostics over the parameters")
    for panel, quantity in zip(sheet.panels, quantities, strict=True):
        first = 0
        for k, stage in enumerate(DIAGNOSED):
            mine = found[(found["stage"] == stage) & (found["quantity"] == quantity)]
            values = mine.drop_duplicates("step").sort_values("step")["value"].to_numpy()
            plot(panel, first + np.arange(len(values)), values, k, f"{stage} parameters", **POINTS)
            first += len(values)
        panel.set(xlabel="parameter, training then validation", ylabel=quantity.replace("_", " "))
    return sheet.finish()


def projection_errors(data: Data) -> Figure:
    """Relative projection errors of the POD and of the cones against their size (paper, Figures 5 and 11)."""
    sheet = Sheet(1, 2, f"{data.problem}: projection errors over the training set")
    left, right = sheet.panels
    errors = data.histories[data.histories["quantity"] == "error"]
    for _, found in longest(errors[errors["stage"] == "pod"]):
        shown = found[found["value"] > ROUND_OFF]
        plot(left, shown["step"], shown["value"], 0, "POD")
    left.set(xlabel="number of modes N", ylabel="relative error of the POD", title="primal", yscale="log")
    counted(left)
    right.set(title="dual")
    _cones(right, errors[errors["stage"] == "cone"], "number of generators R", "largest relative error of the cone")
    return sheet.finish()


def orthogonality(data: Data) -> Figure | None:
    """Relative distance of every generator from the cone of the preceding ones (paper, Figures 6 and 12)."""
    found = data.histories[(data.histories["stage"] == "cone") & (data.histories["quantity"] == "e_orth")]
    if found.empty:
        return None
    sheet = Sheet(1, 1, f"{data.problem}: angles between generators")
    _cones(sheet.panels[0], found, "number of preceding generators r", "e_orth(r)")
    return sheet.finish()


def cone_errors(title: str, errors: Mapping[str, Array]) -> Figure:
    """Relative errors of cones, by dual strategy, against their numbers of generators 0 … R."""
    sheet = Sheet(1, 1, f"{title}: projection errors of the multipliers")
    for k, (dual, values) in enumerate(errors.items(), 1):
        plot(sheet.panels[0], np.arange(len(values)), positive(values), k, dual)
    sheet.panels[0].set(xlabel="number of generators R", ylabel="largest relative error of the cone", yscale="log")
    counted(sheet.panels[0])
    return sheet.finish()


def _cones(axes: Axes, histories: pd.DataFrame, xlabel: str, ylabel: str) -> None:
    """A line for the longest cone of every dual strategy."""
    for k, (dual, found) in enumerate(longest(histories), 1):
        plot(axes, found["step"], positive(found["value"]), k, dual)
    axes.set(xlabel=xlabel, ylabel=ylabel, yscale="log")
    counted(axes)


def enrichment(data: Data) -> Figure | None:
    """Fixed enrichments: σ and min β against the vectors added, β over the validation set (paper, Figures 7 and 14).

    σ and min β are those over the training set, at the tightest tolerance of every strategy.
    """
    fixed = data.queries[data.queries["enrichment_kind"] == Kind.FIXED]
    if fixed.empty:
        return None
    sheet = Sheet(fixed["pair"].nunique(), 3, f"{data.problem}, {data.duals[0]}: fixed enrichments")
    styles: dict[str, int] = {}
    for row in fixed.drop_duplicates(["primal", "primal_tol"]).itertuples():
        style_of(label(row.primal, row.primal_tol), styles)  # styles in the order of the tables, whatever panels show
    for row, (pair, group) in enumerate(fixed.groupby("pair", sort=False)):
        histories = data.histories[(data.histories["stage"] == "enrichment") & (data.histories["pair"] == pair)]
        steps = _tightest(histories)
        for column, (quantity, ylabel) in enumerate(GROWTH.items()):
            panel = sheet.at(row, column)
            for name, one in by_strategy(steps[steps["quantity"] == quantity]):
                plot(panel, one["step"], positive(one["value"], SINE_FLOOR), style_of(name, styles), name)
            panel.set(xlabel="vectors added", ylabel=ylabel, title=dimensions(group), xlim=(0, None), yscale="log")
            counted(panel)
        panel = sheet.at(row, 2)
        for name, one in by_strategy(one_solver(group)):
            plot(panel, np.arange(1, len(one) + 1), np.sort(one["beta_span"]), style_of(name, styles), name)
        panel.set(xlabel="validation parameters, sorted", ylabel="β over span", title=dimensions(group), ylim=(0, None))
        counted(panel)
    return sheet.finish()


def _tightest(steps: pd.DataFrame) -> pd.DataFrame:
    """The histories of every strategy at the tolerance with the most vectors."""
    grown = steps[steps["quantity"] == "beta_span_min"]  # this quantity has a value per vector added
    return at_best_tolerance(steps, grown.groupby(["primal", "primal_tol"])["step"].max())
