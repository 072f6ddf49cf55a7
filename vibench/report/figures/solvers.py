"""QP solvers side by side: time against the accuracy they achieve, and performance profiles."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.qp.status import Status
from vibench.report.common_queries import PROGRAM, WAY, common_programs, of_solvers
from vibench.report.figures.data import ProblemTables, parts
from vibench.report.figures.looks import Looks, Series
from vibench.report.figures.style import SERIES, Pages, Sheet, plot, scatter

RESIDUALS = ["primal_residual", "dual_residual", "gap"]

EXACT = 1e-16
"""Residuals and errors are drawn no lower than this."""


def solvers(data: ProblemTables) -> Pages:
    """Time of every solver against the accuracy it achieves, and its performance profile (Dolan and Moré, 2002).

    A profile is the share of programs solved to the prescribed accuracy within a factor of the time of the fastest
    solver of that program. Failures count as infinite times, so that a curve ends at the share its solver solved. One
    solver has no profile.
    """
    queries = of_solvers(data.queries)
    if not queries["solve_s"].notna().any():
        return
    names = [str(name) for name in queries["solver"].unique()]
    groups = parts(names, SERIES)
    compared = len(names) > 1
    sheet = Sheet(len(groups), 1 + compared, f"{data.problem}: QP solvers", sharex="col", sharey="col")
    looks = Looks(map(Series, names))
    for row, group in enumerate(groups):
        _accuracy(sheet.at(row, 0), queries, group, looks)
        sheet.at(row, 0).axhline(1.0, color="0.4", linewidth=0.8, linestyle=(0, (1, 2)), label="prescribed accuracy")
        if compared:
            _profile(sheet.at(row, 1), queries, group, looks)
    yield sheet.finish(
        f"QP solvers on the programs of {data.problem}. {'Left, the' if compared else 'The'} largest residual of a "
        "reduced model's programs, relative to the prescribed accuracy, against the median time of a program, one "
        "point for each model; points above the dotted line miss the accuracy. "
        + (
            "Right, performance profiles: the share of programs solved to the accuracy within a factor of the time of "
            "the fastest solver."
            if compared
            else f"The run has one solver, {names[0]}: there is no performance profile to draw."
        )
    )


def precision(data: ProblemTables) -> Pages:
    """Median time of a program against the part of the error of u and of λ that the solver makes, over the accuracy.

    Each point is one accuracy of one solver: median over the programs that are ok in all of these ways. A solver that
    has fewer than half of its queries ok at an accuracy has no point there.
    """
    shared = common_programs(data.queries)
    if shared["accuracy"].nunique() < 2:
        return
    count = len(shared) // shared.groupby(WAY).ngroups
    groups = parts(sorted(map(str, shared["solver"].unique())), SERIES)
    title = f"{data.problem}: time and precision of the QP solvers, {count} programs"
    sheet = Sheet(len(groups), 2, title, sharex="all", sharey="col")
    looks = Looks(Series(name) for group in groups for name in group)
    for row, group in enumerate(groups):
        for solver in group:
            mine = shared[shared["solver"] == solver]
            medians = mine.groupby("accuracy")[["solve_s", "solver_error_u", "solver_error_lambda"]].median()
            for column, name in enumerate(("u", "lambda")):
                error = np.maximum(medians[f"solver_error_{name}"], EXACT)
                # a marker per accuracy
                plot(sheet.at(row, column), 1e3 * medians["solve_s"], error, looks[Series(solver)], solver, markevery=1)
        for column, name in enumerate(("u", "λ")):
            panel = sheet.at(row, column)
            panel.set(xlabel="median time of a program [ms]", ylabel=f"median error of {name} made by the solver")
            panel.set(xscale="log", yscale="log")
    accuracies = ", ".join(f"{value:g}" for value in sorted(shared["accuracy"].unique(), reverse=True))
    yield sheet.finish(
        f"The part of the relative error of u (left) and of λ (right) of {data.problem} that the QP solver makes, "
        f"against the time of a program: medians over the {count} programs that every solver shown solved at each of "
        f"its accuracies, of {accuracies}; a marker for each accuracy."
    )


def _accuracy(panel: Axes, queries: pd.DataFrame, names: list[str], looks: Looks) -> None:
    """A point per cell: median time and largest residual of its queries, relative to its accuracy."""
    for solver in names:
        mine = queries[(queries["solver"] == solver) & queries["solve_s"].notna()]
        rows = mine.assign(worst=mine[RESIDUALS].max(axis=1) / mine["accuracy"]).groupby("cell")
        models = rows.agg(time=("solve_s", "median"), worst=("worst", "max"))
        finite = models[np.isfinite(models["worst"])]  # a query without a solution has no residual
        scatter(panel, 1e3 * finite["time"], np.maximum(finite["worst"], EXACT), looks[Series(solver)], solver)
    panel.set(xlabel="median time of a program [ms]", ylabel="largest residual / accuracy")
    panel.set(xscale="log", yscale="log")


def _profile(panel: Axes, queries: pd.DataFrame, names: list[str], looks: Looks) -> None:
    """The profiles of some solvers, against the fastest of all."""
    solved = queries["solve_s"].where(queries["status"] == Status.OK, np.inf).fillna(np.inf)
    instances = (
        queries.assign(time=solved).groupby([*PROGRAM, "accuracy", "solver"], dropna=False)["time"].min().unstack()
    )
    fastest = instances.min(axis=1).replace(np.inf, 1.0)  # where nobody solved a program all ratios are infinite
    ratios = instances.div(fastest, axis=0).fillna(np.inf)
    last = 1.1 * ratios.replace(np.inf, 1.0).to_numpy().max()
    for solver in names:
        mine = np.sort(ratios[solver].to_numpy())
        count = int(np.isfinite(mine).sum())
        x = np.concatenate([[1.0], mine[:count], [last]])
        y = np.concatenate([[0.0], np.arange(1, count + 1), [count]]) / len(mine)
        plot(panel, x, y, looks[Series(solver)], solver, drawstyle="steps-post")
    panel.set(xlabel="time relative to the fastest solver", ylabel="share of programs solved", ylim=(0.0, 1.03))
    panel.set(xscale="log", xlim=(1.0, max(last, 1.5)))
