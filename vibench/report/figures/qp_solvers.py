"""QP solvers compared: time against accuracy, and performance profiles."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.qp.status import Status
from vibench.report.figures import data as tables
from vibench.report.figures.data import ProblemTables
from vibench.report.figures.style import CaptionedFigure, Looks, Series, Sheet, plot, scatter
from vibench.results.schema import KEYS


def solvers(data: ProblemTables) -> CaptionedFigure | None:
    """Time of every solver against the accuracy it achieves, and its performance profile (Dolan and Moré, 2002).

    Failures count as infinite times, so that a curve ends at the fraction its solver solved. One solver has no profile.
    """
    queries = tables.of_solvers(data.queries)
    if not queries["solve_s"].notna().any():
        return None
    names = [str(name) for name in queries["solver"].unique()]
    compared = len(names) > 1
    sheet, looks = Sheet(1, 1 + compared, f"{data.problem}: QP solvers"), Looks(map(Series, names))
    _accuracy(sheet.panels[0], queries, names, looks)
    sheet.panels[0].axhline(1.0, color="0.4", linewidth=0.8, linestyle=(0, (1, 2)), label="prescribed accuracy")
    if compared:
        _profile(sheet.panels[1], queries, looks)
    return sheet.finish(
        f"QP solvers on the programs of {data.problem}. {'Left, the' if compared else 'The'} largest residual of a "
        "reduced model's programs, relative to the prescribed accuracy, against the median time of a program, one "
        "point for each model; points above the dotted line miss the accuracy. "
        + (
            "Right, performance profiles: the share of programs solved to the accuracy within a factor of the time of "
            "the fastest solver; of more than four solvers those that solve most within a factor of two."
            if compared
            else f"The run has one solver, {names[0]}: there is no performance profile to draw."
        )
    )


def _accuracy(panel: Axes, queries: pd.DataFrame, names: list[str], looks: Looks) -> None:
    """A point per cell: median time and largest residual of its queries, relative to its accuracy."""
    for solver in names:
        mine = queries[(queries["solver"] == solver) & queries["solve_s"].notna()]
        worst = mine[["primal_residual", "dual_residual", "gap"]].max(axis=1) / mine["accuracy"]
        models = mine.assign(worst=worst).groupby("cell").agg(time=("solve_s", "median"), worst=("worst", "max"))
        # A query without a solution has no residual.
        finite = models[np.isfinite(models["worst"])]
        scatter(panel, 1e3 * finite["time"], np.maximum(finite["worst"], 1e-16), looks[Series(solver)], solver)
    panel.set(xlabel="median time of a program [ms]", ylabel="largest residual / accuracy")
    panel.set(xscale="log", yscale="log")


def _profile(panel: Axes, queries: pd.DataFrame, looks: Looks) -> None:
    solved = queries["solve_s"].where(queries["status"] == Status.OK, np.inf).fillna(np.inf)
    # Every solver solves every program of the problem at every accuracy.
    by = [*(name for name in KEYS if name not in ("problem", "problem_options", "solver")), "query", "solver"]
    instances = queries.assign(time=solved).groupby(by, dropna=False)["time"].min().unstack()
    # Where nobody solved a program all ratios are infinite.
    fastest = instances.min(axis=1).replace(np.inf, 1.0)
    ratios = instances.div(fastest, axis=0).fillna(np.inf)
    last = 1.1 * ratios.replace(np.inf, 1.0).to_numpy().max()
    # Nobody tells more than four curves apart.
    for solver in (ratios <= 2.0).mean().nlargest(4).index:
        mine = np.sort(ratios[solver].to_numpy())
        count = int(np.isfinite(mine).sum())
        x = np.concatenate([[1.0], mine[:count], [last]])
        y = np.concatenate([[0.0], np.arange(1, count + 1), [count]]) / len(mine)
        plot(panel, x, y, looks[Series(solver)], solver, drawstyle="steps-post")
    panel.set(xlabel="time relative to the fastest solver", ylabel="share of programs solved", ylim=(0.0, 1.03))
    panel.set(xscale="log", xlim=(1.0, max(last, 1.5)))
