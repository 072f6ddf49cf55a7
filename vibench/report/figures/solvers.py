"""QP solvers side by side: time against the accuracy they achieve, and performance profiles."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.qp.status import Status
from vibench.report.common_queries import PROGRAM, WAY, common_programs
from vibench.report.figures.data import Data
from vibench.report.figures.style import POINTS, Sheet, plot

RESIDUALS = ["primal_residual", "dual_residual", "gap"]

EXACT = 1e-16
"""Residuals and errors are drawn no lower than this."""


def solvers(data: Data) -> Figure | None:
    """Time of every solver against the accuracy it achieves, and its performance profile (Dolan and Moré, 2002).

    A profile is the share of programs solved to the prescribed accuracy within a factor of the time of the fastest
    solver of that program. Failures count as infinite times, so that a curve ends at the share its solver solved.
    """
    queries = data.queries
    if not queries["solve_s"].notna().any():
        return None
    sheet = Sheet(1, 2, f"{data.problem}: QP solvers")
    left, right = sheet.panels
    names = list(queries["solver"].unique())
    _accuracy(left, queries, names)
    left.axhline(1.0, color="0.4", linewidth=0.8, linestyle=(0, (1, 2)), label="prescribed accuracy")
    _profile(right, queries, names)
    return sheet.finish()


def precision(data: Data) -> Figure | None:
    """Median time of a program against the part of the error of u and of λ that the solver makes, over the accuracy.

    Each point is one accuracy of one solver: median over the programs that are ok in all of these ways. A solver that
    has fewer than half of its queries ok at an accuracy has no point there.
    """
    shared = common_programs(data.queries)
    if shared["accuracy"].nunique() < 2:
        return None
    count = len(shared) // shared.groupby(WAY).ngroups
    sheet = Sheet(1, 2, f"{data.problem}: time and precision of the QP solvers, {count} programs")
    for k, (solver, mine) in enumerate(shared.groupby("solver")):
        found = mine.groupby("accuracy")[["solve_s", "solver_error_u", "solver_error_lambda"]].median()
        for panel, name in zip(sheet.panels, ("u", "lambda"), strict=True):
            error = np.maximum(found[f"solver_error_{name}"], EXACT)
            plot(panel, 1e3 * found["solve_s"], error, k, str(solver), markevery=1)  # a marker per accuracy
    for panel, name in zip(sheet.panels, ("u", "λ"), strict=True):
        panel.set(xlabel="median time of a program [ms]", ylabel=f"median error of {name} made by the solver")
        panel.set(xscale="log", yscale="log")
    return sheet.finish()


def _accuracy(panel: Axes, queries: pd.DataFrame, names: list[str]) -> None:
    """A point per cell: median time and largest residual of its queries, relative to its accuracy."""
    for k, solver in enumerate(names):
        mine = queries[(queries["solver"] == solver) & queries["solve_s"].notna()]
        rows = mine.assign(worst=mine[RESIDUALS].max(axis=1) / mine["accuracy"]).groupby("cell")
        found = rows.agg(time=("solve_s", "median"), worst=("worst", "max"))
        finite = found[np.isfinite(found["worst"])]  # a query without a solution has no residual
        plot(panel, 1e3 * finite["time"], np.maximum(finite["worst"], EXACT), k, solver, **POINTS)
    panel.set(xlabel="median time of a program [ms]", ylabel="largest residual / accuracy")
    panel.set(xscale="log", yscale="log")


def _profile(panel: Axes, queries: pd.DataFrame, names: list[str]) -> None:
    solved = queries["solve_s"].where(queries["status"] == Status.OK, np.inf).fillna(np.inf)
    instances = (
        queries.assign(time=solved).groupby([*PROGRAM, "accuracy", "solver"], dropna=False)["time"].min().unstack()
    )
    fastest = instances.min(axis=1).replace(np.inf, 1.0)  # where nobody solved a program all ratios are infinite
    ratios = instances.div(fastest, axis=0).fillna(np.inf)
    last = 1.1 * ratios.replace(np.inf, 1.0).to_numpy().max()
    for k, solver in enumerate(names):
        mine = np.sort(ratios[solver].to_numpy())
        count = int(np.isfinite(mine).sum())
        x = np.concatenate([[1.0], mine[:count], [last]])
        y = np.concatenate([[0.0], np.arange(1, count + 1), [count]]) / len(mine)
        plot(panel, x, y, k, solver, drawstyle="steps-post")
    panel.set(xlabel="time relative to the fastest solver", ylabel="share of programs solved", ylim=(0.0, 1.03))
    panel.set(xscale="log", xlim=(1.0, max(last, 1.5)))
