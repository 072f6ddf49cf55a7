"""Figures of the offline phase: mesh, projection errors, enrichment (paper, Figures 3, 5 to 7, 11, 12 and 14)."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from vibench.interfaces.strategies import Kind
from vibench.report.figures.data import Data, label, longest, one_solver, pair_title, pairs, same
from vibench.report.figures.style import Sheet, counted, logarithmic, plot, positive

ROUND_OFF = 1e-12
"""The tail of a POD below this is round-off."""

SINE_FLOOR = 1e-14
"""Sines below this are round-off."""

DIAGNOSED = ("training", "validation")


def diagnostics(data: Data) -> Figure | None:
    """What the problem says of itself at every parameter, such as the largest aspect ratio (paper, Figure 3)."""
    found = data.histories[data.histories["stage"].isin(DIAGNOSED)]
    if found.empty:
        return None
    quantities = list(found["quantity"].unique())
    sheet = Sheet(1, len(quantities), f"{data.problem}: the problem over its parameters")
    for panel, quantity in zip(sheet.panels, quantities, strict=True):
        first = 0
        for k, stage in enumerate(DIAGNOSED):
            mine = found[(found["stage"] == stage) & (found["quantity"] == quantity)]
            values = mine.drop_duplicates("step").sort_values("step")["value"].to_numpy()
            style = {"linestyle": "none", "markevery": None}
            plot(panel, first + np.arange(len(values)), values, k, f"{stage} parameters", **style)
            first += len(values)
        panel.set(xlabel="parameter, training then validation", ylabel=quantity.replace("_", " "))
    return sheet.finish()


def projection_errors(data: Data) -> Figure:
    """Relative projection errors of the POD and of the cones over their size (paper, Figures 5 and 11)."""
    sheet = Sheet(1, 2, f"{data.problem}: projection errors over the training set")
    left, right = sheet.panels
    errors = data.histories[data.histories["quantity"] == "error"]
    for _, found in longest(errors[errors["stage"] == "pod"], []):
        shown = found[found["value"] > ROUND_OFF]
        plot(left, shown["step"], shown["value"], 0, "POD")
    left.set(xlabel="number of modes N", ylabel="relative error of the POD", title="primal")
    for k, ((dual,), found) in enumerate(longest(errors[errors["stage"] == "cone"], ["dual"]), 1):
        plot(right, found["step"], positive(found["value"]), k, dual)
    right.set(xlabel="number of generators R", ylabel="largest relative error of the cone", title="dual")
    for panel in sheet.panels:
        logarithmic(panel)
        counted(panel)
    return sheet.finish()


def orthogonality(data: Data) -> Figure | None:
    """Distance of every generator from the cone of those before it (paper, Figures 6 and 12)."""
    found = data.histories[(data.histories["stage"] == "cone") & (data.histories["quantity"] == "e_orth")]
    if found.empty:
        return None
    sheet = Sheet(1, 1, f"{data.problem}: angles between generators")
    (axes,) = sheet.panels
    for k, ((dual,), one) in enumerate(longest(found, ["dual"]), 1):
        plot(axes, one["step"], positive(one["value"]), k, dual)
    axes.set(xlabel="generators before, r", ylabel="e_orth(r)")
    counted(axes)
    logarithmic(axes)
    return sheet.finish()


def enrichment(data: Data) -> Figure | None:
    """σ and min β over the steps of the tightest fixed enrichments, β over the validation set (Figures 7 and 14)."""
    fixed = data.queries[data.queries["enrichment_kind"] == Kind.FIXED]
    if fixed.empty:
        return None
    asked = pairs(fixed)
    sheet = Sheet(len(asked), 3, f"{data.problem}, {data.duals[0]}: fixed enrichments")
    names = {name: k for k, name in enumerate(_labels(fixed))}
    for row, (pair, group) in enumerate(asked):
        steps = data.histories[(data.histories["stage"] == "enrichment") & same(data.histories, pair)]
        tight = steps[steps["primal_tol"].isna() | (steps["primal_tol"] == _tightest(steps))]
        drawn = (("sigma", "largest σ, training set"), ("beta_span_min", "min β over span, training set"))
        for column, (quantity, said) in enumerate(drawn):
            panel = sheet.at(row, column)
            for (primal, tolerance), one in tight[tight["quantity"] == quantity].groupby(
                ["primal", "primal_tol"], dropna=False
            ):
                values = positive(one["value"], SINE_FLOOR)
                plot(panel, one["step"], values, names.get(label(primal, tolerance), 0), label(primal, tolerance))
            panel.set(xlabel="vectors added", ylabel=said, title=pair_title(pair, data.cells))
            panel.set_xlim(left=0)
            counted(panel)
            logarithmic(panel)
        panel = sheet.at(row, 2)
        for (primal, tolerance), one in one_solver(group).groupby(["primal", "primal_tol"], dropna=False):
            values = np.sort(one["beta_span"].to_numpy())
            plot(
                panel, np.arange(1, len(values) + 1), values, names[label(primal, tolerance)], label(primal, tolerance)
            )
        panel.set(xlabel="validation parameters, sorted", ylabel="β over span", title=pair_title(pair, data.cells))
        panel.set_ylim(bottom=0.0)
        counted(panel)
    return sheet.finish()


def _labels(queries: pd.DataFrame) -> list[str]:
    known = queries.drop_duplicates(["primal", "primal_tol"])
    return [label(primal, tolerance) for primal, tolerance in zip(known["primal"], known["primal_tol"], strict=True)]


def _tightest(steps: pd.DataFrame) -> pd.Series:
    """Of every row the tolerance at which its strategy went farthest."""
    grown = steps[steps["quantity"] == "beta_span_min"]  # a value per vector
    reach = grown.groupby(["primal", "primal_tol"])["step"].max()
    if reach.empty:
        return pd.Series(np.nan, index=steps.index)
    farthest = {primal: of_primal.idxmax()[1] for primal, of_primal in reach.groupby(level=0)}
    return steps["primal"].map(farthest)
