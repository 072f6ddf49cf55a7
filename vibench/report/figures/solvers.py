"""QP solvers side by side: time against the accuracy they achieved, and performance profiles."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibench.qp.status import Status
from vibench.report.figures.data import Data
from vibench.report.figures.style import Sheet, line, logarithmic, plot
from vibench.results.columns import KEYS

RESIDUALS = ["primal_residual", "dual_residual", "gap"]

INSTANCE = [*(name for name in KEYS if name not in ("problem", "problem_options", "solver")), "query"]
"""What names a program that every solver was asked."""

EXACT = 1e-16
"""Residuals are drawn no lower than this."""


def solvers(data: Data) -> Figure | None:
    """Time against achieved accuracy of every solver, and its performance profile (Dolan and Moré, 2002).

    A profile is the share of programs solved to the accuracy asked for within a factor of the time of the fastest
    solver of that program; failures are at infinity, so that a solver's curve ends at the share it solved.
    """
    queries = data.queries
    names = list(dict.fromkeys(queries["solver"]))
    if not queries["solve_s"].notna().any():
        return None
    sheet = Sheet(1, 2, f"{data.problem}: QP solvers")
    left, right = sheet.panels
    _accuracy(left, queries, names)
    left.axhline(_asked(data.cells), color="0.4", linewidth=0.8, linestyle=(0, (1, 2)), label="accuracy asked for")
    _profile(right, queries, names)
    return sheet.finish()


def _asked(cells: pd.DataFrame) -> float:
    return float(json.loads(cells["definition"].iloc[0])["accuracy"])


def _accuracy(panel: Axes, queries: pd.DataFrame, names: list[str]) -> None:
    """A point per reduced model and solver: median time over its queries, and the largest residual of any."""
    for k, solver in enumerate(names):
        mine = queries[(queries["solver"] == solver) & queries["solve_s"].notna()]
        worst = mine[RESIDUALS].max(axis=1)
        found = mine.assign(worst=worst).groupby("cell").agg(time=("solve_s", "median"), worst=("worst", "max"))
        finite = found[np.isfinite(found["worst"])]  # a query without an answer has no residual
        style = line(k) | {"linestyle": "none", "markevery": None}
        panel.plot(1e3 * finite["time"], np.maximum(finite["worst"], EXACT), label=solver, **style)
    panel.set(xlabel="median time of a program [ms]", ylabel="largest residual of a model's queries")
    logarithmic(panel, "xy")


def _profile(panel: Axes, queries: pd.DataFrame, names: list[str]) -> None:
    solved = queries["solve_s"].where(queries["status"] == Status.OK, np.inf).fillna(np.inf)
    instances = queries.assign(time=solved).groupby([*INSTANCE, "solver"], dropna=False)["time"].min().unstack()
    fastest = instances.min(axis=1)
    ratios = instances.div(fastest.where(np.isfinite(fastest), 1.0), axis=0)
    finite = ratios.to_numpy()[np.isfinite(ratios.to_numpy())]
    last = 1.1 * float(finite.max(initial=1.0))
    for k, solver in enumerate(names):
        mine = np.sort(ratios[solver].fillna(np.inf).to_numpy())
        count = int(np.isfinite(mine).sum())
        x = np.concatenate([[1.0], mine[:count], [last]])
        y = np.concatenate([[0.0], np.arange(1, count + 1), [count]]) / len(mine)
        plot(panel, x, y, k, solver, drawstyle="steps-post")
    panel.set(xlabel="time over that of the fastest solver", ylabel="share of programs solved", ylim=(0.0, 1.03))
    logarithmic(panel, "x")
    panel.set_xlim(1.0, max(last, 1.5))
