"""Errors against dimension and time of a query, and total cost against the number of queries."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.qp.status import Status
from vibench.report.figures import data as tables
from vibench.report.figures import style
from vibench.report.figures.data import ProblemTables, label, parts, series, titled_parts, whole
from vibench.report.figures.style import CaptionedFigure, Layout, Looks, Series, Sheet, plot, scatter
from vibench.results.break_even import HIGH_FIDELITY, Meaning


def work_precision(data: ProblemTables) -> CaptionedFigure | None:
    """Errors against the time of a query, a point per cell; no cell is both faster and more accurate than the front.

    Dual strategies, assemblies and corrections have a row of panels each.
    """
    cells = tables.best_solver(data.cells)
    compared = tables.on_common_queries(cells, data.queries)
    cells = compared.cells[compared.cells[["error_u_mean", "error_lambda_mean"]].notna().any(axis=1)]
    over, seconds = compared.over or f" over all {compared.asked} queries", 1e3 * cells["online_s"]
    rows_of = "dual strategy" + " and way of a query" * (cells["way"].nunique() > 1)
    looks = Looks(Series(str(primal)) for primal in cells["primal"].unique())
    # Dual strategies and ways of a query: title, cells, and as many primal strategies as a panel takes.
    ways = [
        (title, mine, names)
        for (dual, way), mine in cells.groupby(["dual", "way"], sort=False)
        for title, names in titled_parts(f"{dual}{f', {way}' * bool(way)}", list(map(str, mine["primal"].unique())))
    ]
    rows, part = tables.leading(ways, 2)
    if not rows:
        return None
    heading = f"{data.problem}, {cells['solver'].iloc[0]}: work and precision{compared.over}"
    sheet = Sheet(len(rows), 2, heading, Layout(4.4, 3.3), "all", "col")
    for row, (way, mine, names) in enumerate(rows):
        for place, (column, symbol) in enumerate((("error_u_mean", "u"), ("error_lambda_mean", "λ"))):
            panel, drawn = sheet.panel(row, place), mine[mine[column].notna()]
            for name in names:
                own = drawn.index[drawn["primal"] == name]
                scatter(panel, seconds[own], drawn[column][own], looks[Series(str(name))], str(name))
            for index, text in _point_names(drawn[drawn["primal"].isin(names)]).items():
                sheet.label(panel, seconds[index], drawn[column][index], text)
            best = drawn.index[_front(seconds[drawn.index].to_numpy(float), drawn[column].to_numpy(float))]
            panel.plot(seconds[best], drawn[column][best], c="0.6", lw=0.8, drawstyle="steps-post", zorder=0)
            panel.set(xlabel="mean time of a query [ms]", ylabel=f"mean relative error of {symbol}", title=way)
            panel.set(xscale="log", yscale="log")
    return sheet.finish(
        f"Relative errors of u (left) and of λ (right) of the reduced models of {data.problem}, means{over}, "
        f"against the mean time of a query; solver {cells['solver'].iloc[0]}. A row for every {rows_of}, a point "
        "for every model, with its (N, R) and the tolerance δ of its primal strategy; a number alone is another δ. "
        "The thin line is the Pareto front: no model is both faster and more accurate.",
        part,
    )


def _point_names(cells: pd.DataFrame) -> dict[Any, str]:
    """Labels of the points of cells, (N, R) and δ, by index; of several tolerances only the first has (N, R)."""
    names, named = {}, set()
    for index, cell in cells.iterrows():
        size = f"({whole(cell['N'])}, {whole(cell['R'])})"
        tolerance = "" if pd.isna(cell["primal_tol"]) else f"{cell['primal_tol']:g}"
        key = (cell["primal"], cell["dual"], size)
        names[index] = tolerance if tolerance and key in named else size + f", δ = {tolerance}" * bool(tolerance)
        named.add(key)
    return names


def _front(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Places of the points on the Pareto front, of those that are small in x and y, from left to right."""
    # From left to right, a point is on the front if it is lower than all before it.
    order = np.lexsort((y, x))
    best = np.minimum.accumulate(y[order])
    return np.asarray(order[np.concatenate([np.ones(min(len(best), 1), dtype=bool), best[1:] < best[:-1]])])


def total_cost(data: ProblemTables) -> CaptionedFigure | None:
    """Offline and online seconds against the number of queries; triangles mark where two models break even."""
    cells, queries = tables.best_solver(data.cells), np.geomspace(1.0, 1e6, 61)
    panels = []
    for (dual, _), mine in cells.groupby(["dual", "pair"], sort=False):
        # The cells with the most vectors of every strategy and way: a line per tolerance would hide the crossings.
        added = mine.assign(added=mine["enrichment"].fillna(0))
        most = added.sort_values(["added", "primal_tol"], ascending=[False, True], kind="stable")
        models = most.drop_duplicates(["primal", "way"]).sort_index()
        title = f"{dual}, {tables.dimensions(mine)}"
        groups = titled_parts(title, list(range(len(models))), "models", beside_reference=True)
        panels += [(part, models.iloc[places]) for part, places in groups]
    shown, part = tables.leading(panels, 4)
    if not shown:
        return None
    sheet = Sheet.with_panels(len(shown), f"{data.problem}, {cells['solver'].iloc[0]}: total cost", share="all")
    drawn = [cell for _, mine in shown for cell in mine.itertuples()]
    looks = Looks(series(cell.primal, cell.primal_tol, cell.way) for cell in drawn)
    for panel, (title, mine) in zip(sheet.panels, shown, strict=False):
        model = mine.iloc[0]
        plot(panel, queries, model["hf_setup_s"] + queries * model["hf_s"], style.HIGH_FIDELITY_LOOK, HIGH_FIDELITY)
        for cell in mine.itertuples():
            key = (cell.primal, cell.primal_tol, cell.way)
            plot(panel, queries, cell.offline_s + queries * cell.online_s, looks[series(*key)], label(*key))
        _marks(panel, mine, data.thresholds, queries[-1])
        panel.set(xlabel="number of queries", ylabel="offline + online [s]", title=title)
        panel.set(xlim=(1.0, queries[-1]), xscale="log", yscale="log")
    return sheet.finish(
        f"CPU seconds offline and online of the models of {data.problem} together against the number of queries; "
        f"solver {cells['solver'].iloc[0]}. A panel for every dual strategy and pair (N, R); every primal strategy "
        "and assembly is shown at the tolerance δ with the most vectors. Triangles mark where two models cost the "
        "same and point to the side on which the reduced model is cheaper than the high-fidelity one, the fixed "
        "enrichment than the one per parameter, or another formulation than the mixed program; bars are 95 % "
        "intervals of that number of queries.",
        part,
    )


def _marks(panel: Axes, cells: pd.DataFrame, thresholds: pd.DataFrame, most: float) -> None:
    """Break-even points between the lines of a panel, at their cost, with their intervals."""
    drawn, number = cells["cell"], thresholds["benefit_threshold"]
    between = thresholds["cell_a"].isna() | thresholds["cell_a"].isin(drawn)
    shown = thresholds[thresholds["cell_b"].isin(drawn) & between & number.between(1.0, most)]
    shown = shown.assign(cost=shown["offline_b_s"] + shown["benefit_threshold"] * shown["online_b_s"])
    for meaning, mine in shown.groupby("meaning"):
        shape, name = {Meaning.FROM: ">", Meaning.UNTIL: "<"}[Meaning(meaning)], f"break-even: cheaper {meaning} here"
        panel.plot(mine["benefit_threshold"], mine["cost"], shape, c="black", ms=5, mfc="none", label=name, zorder=5)
    bounded = shown[shown[["threshold_low", "threshold_high"]].notna().all(axis=1)]
    panel.hlines(bounded["cost"], bounded["threshold_low"], bounded["threshold_high"], colors="black", lw=0.8, zorder=5)


def solvers(data: ProblemTables) -> CaptionedFigure | None:
    """Time of every solver against the accuracy it achieves, and its performance profile (Dolan and Moré, 2002).

    Failures count as infinite times, so that a curve ends at the fraction its solver solved. One solver has no profile.
    """
    queries = tables.of_solvers(data.queries)
    if not queries["solve_s"].notna().any():
        return None
    names = [str(name) for name in queries["solver"].unique()]
    groups = parts(names)
    compared = len(names) > 1
    sheet = Sheet(len(groups), 1 + compared, f"{data.problem}: QP solvers", sharex="col", sharey="col")
    looks = Looks(map(Series, names))
    for row, group in enumerate(groups):
        _accuracy(sheet.panel(row, 0), queries, group, looks)
        sheet.panel(row, 0).axhline(1.0, color="0.4", linewidth=0.8, linestyle=(0, (1, 2)), label="prescribed accuracy")
        if compared:
            _profile(sheet.panel(row, 1), queries, group, looks)
    return sheet.finish(
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


def _profile(panel: Axes, queries: pd.DataFrame, names: list[str], looks: Looks) -> None:
    solved = queries["solve_s"].where(queries["status"] == Status.OK, np.inf).fillna(np.inf)
    by = [*tables.program_columns(), "accuracy", "solver"]
    instances = queries.assign(time=solved).groupby(by, dropna=False)["time"].min().unstack()
    # Where nobody solved a program all ratios are infinite.
    fastest = instances.min(axis=1).replace(np.inf, 1.0)
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
