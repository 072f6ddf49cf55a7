"""Errors against dimension and time of a query, and total cost against the number of queries."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.model.bound_terms import CorrectionMode
from vibench.qp.status import Status
from vibench.report.figures.data import (
    ProblemTables,
    best_solver,
    by_dimensions,
    common_programs,
    correction_in_words,
    label,
    of_solvers,
    on_common_queries,
    parts,
    point_names,
    program_columns,
    series,
    titled_parts,
)
from vibench.report.figures.style import HIGH_FIDELITY_LOOK, Layout, Looks, Pages, Series, Sheet, plot, scatter
from vibench.results import ranking
from vibench.results.break_even import HIGH_FIDELITY, Meaning

ERRORS = {"error_u_mean": "mean relative error of u", "error_lambda_mean": "mean relative error of λ"}


def dimension(data: ProblemTables) -> Pages:
    """Errors against the dimension of the reduced problem, N + S + R; means over the queries that all cells solved."""
    cells = best_solver(data.cells)
    # Reduced assembly changes no dimension: it is shown only where a correction has no full assembly.
    full = cells["assembly"] == "full"
    cells = cells[full | ~full.groupby(cells["correction"]).transform("any")]
    size = cells["N"] + cells["enrichment"].fillna(0) + cells["R"]
    return _errors_against(data, cells, size, "dimension N + S + R", "errors against dimension")


def work_precision(data: ProblemTables) -> Pages:
    """Errors against the time of a query; no cell is both faster and more accurate than those on the line."""
    cells = best_solver(data.cells)
    seconds = 1e3 * cells["online_s"]
    return _errors_against(data, cells, seconds, "mean time of a query [ms]", "work and precision", front=True)


def _errors_against(
    data: ProblemTables, cells: pd.DataFrame, x: pd.Series, xlabel: str, title: str, *, front: bool = False
) -> Pages:
    """One point per cell with its (N, R) and δ; a row of panels for every dual strategy, assembly and correction."""
    compared = on_common_queries(cells[x.notna()], data.queries)
    cells = compared.cells[compared.cells[list(ERRORS)].notna().any(axis=1)]
    over = compared.over or f" over all {compared.asked} queries"
    rows_of = "dual strategy" + " and way of a query" * (cells["way"].nunique() > 1)
    beyond = "The thin line is the Pareto front: no model is both faster and more accurate." if front else ""
    looks = Looks(Series(str(primal)) for primal in cells["primal"].unique())
    for rows, part in data.pages(list(_ways(cells)), 4):
        heading = f"{data.problem}, {cells['solver'].iloc[0]}: {title}{compared.over}"
        sheet = Sheet(len(rows), 2, heading, Layout(4.4, 3.3), "all", "col")
        for row, (way, mine, names) in enumerate(rows):
            for place, (column, ylabel) in enumerate(ERRORS.items()):
                panel, drawn = sheet.panel(row, place), mine[mine[column].notna()]
                _points(panel, drawn, x, drawn[column], names, looks)
                _name_points(sheet, panel, drawn[drawn["primal"].isin(names)], x, drawn[column])
                if front:
                    best = drawn.index[_front(x[drawn.index].to_numpy(float), drawn[column].to_numpy(float))]
                    panel.plot(x[best], drawn[column][best], c="0.6", lw=0.8, drawstyle="steps-post", zorder=0)
                panel.set(xlabel=xlabel, ylabel=ylabel, title=way, xscale="log", yscale="log")
        yield sheet.finish(
            f"Relative errors of u (left) and of λ (right) of the reduced models of {data.problem}, means{over}, "
            f"against the {xlabel}; solver {cells['solver'].iloc[0]}. A row for every {rows_of}, a point for "
            "every model, with its (N, R) and the tolerance δ of its primal strategy; a number alone is another δ. "
            f"{beyond}",
            part,
        )


def _points(panel: Axes, cells: pd.DataFrame, x: pd.Series, y: pd.Series, names: Iterable[Any], looks: Looks) -> None:
    for name in names:
        mine = cells.index[cells["primal"] == name]
        scatter(panel, x[mine], y[mine], looks[Series(str(name))], str(name))


def _name_points(sheet: Sheet, panel: Axes, cells: pd.DataFrame, x: pd.Series, y: pd.Series) -> None:
    for index, text in point_names(cells).items():
        sheet.label(panel, x[index], y[index], text)


def _ways(cells: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame, list[str]]]:
    """Dual strategies and ways of a query: title, cells, and as many primal strategies as a panel takes."""
    ways = cells.groupby(["dual", "assembly", "bounds", "correction"], sort=False)
    for (dual, assembly, bounds, correction), mine in ways:
        title = f"{dual}{f', {assembly} assembly' * (assembly != 'full')}{' with bounds' * bool(bounds)}"
        title += f", {correction_in_words(correction)}" * (correction != CorrectionMode.NONE)
        for part, names in titled_parts(title, [str(name) for name in mine["primal"].unique()]):
            yield part, mine, names


def outputs(data: ProblemTables) -> Pages:
    """Errors of every quantity of interest, over its largest value of the training set, against the time of a query."""
    of_outputs = data.outputs.loc[data.outputs["error_scaled_mean"].notna(), ["cell", "output", "error_scaled_mean"]]
    models = best_solver(data.cells).merge(of_outputs, "inner", "cell")
    panels = [
        (f"{name}, {title}", rows, names)
        for name, of_output in models.groupby("output", sort=False)
        for title, rows, names in _ways(of_output)
    ]
    for shown, part in data.pages(panels, 12):
        solver = models["solver"].iloc[0]
        sheet = Sheet.with_panels(len(shown), f"{data.problem}, {solver}: quantities of interest")
        looks = Looks(Series(name) for _, _, names in shown for name in names)
        for panel, (title, mine, names) in zip(sheet.panels, shown, strict=False):
            x, y = 1e3 * mine["online_s"], mine["error_scaled_mean"]
            _points(panel, mine, x, y.where(y > 0.0), names, looks)
            _name_points(sheet, panel, mine[mine["primal"].isin(names)], x, y)
            panel.set(xlabel="mean time of a query [ms]", ylabel="mean error over the scale", title=title)
            panel.set(xscale="log", yscale="log")
        yield sheet.finish(
            f"Mean errors of the quantities of interest of {data.problem} over their largest value on the training "
            f"set, against the mean time of a query; solver {solver}. A panel for every quantity, dual strategy and "
            "assembly, a point for every model, with its (N, R) and the tolerance δ of its primal strategy; a number "
            "alone is another δ.",
            part,
        )


def break_even(data: ProblemTables) -> Pages:
    """Queries from which a reduced model is cheaper than the high-fidelity one, against its errors, also of outputs."""
    cells, numbers = best_solver(data.cells), ["benefit_threshold", "threshold_low", "threshold_high", "meaning"]
    against = data.thresholds[data.thresholds["cell_a"].isna()].set_index("cell_b")[numbers]
    models = cells.merge(against, "inner", left_on="cell", right_index=True)
    decided = models[models["meaning"] == Meaning.FROM]
    if (decided["correction"] != CorrectionMode.NONE).any():
        # Strategies are distinguished by their names: a corrected one needs another.
        named = [label(row.primal, None, correction_in_words(row.correction)) for row in decided.itertuples()]
        decided = decided.assign(primal=named)
    errors = {
        measure: ranking.errors_of(decided, data.outputs, measure).dropna()
        for measure in ranking.measures(data.outputs)
        if measure != "solution"
    }
    panels = [(measure, decided.loc[error.index], error) for measure, error in errors.items() if len(error)]
    without = len(models) - len(decided)
    left_out = f"Models without such a number, or with an undecided one, have no point: {without}." * bool(without)
    for shown, part in data.pages(panels, 12):
        solver = decided["solver"].iloc[0]
        sheet = Sheet.with_panels(len(shown), f"{data.problem}, {solver}: break-even and accuracy")
        looks = Looks(Series(str(name)) for _, mine, _ in shown for name in mine["primal"].unique())
        for panel, (measure, mine, error) in zip(sheet.panels, shown, strict=False):
            number = mine["benefit_threshold"]
            _points(panel, mine, error.where(error > 0.0), number, mine["primal"].unique(), looks)
            low, high = (mine[f"threshold_{end}"].replace(np.inf, np.nan) for end in ("low", "high"))
            panel.vlines(error, low, high, color="0.6", lw=0.8, zorder=0)
            best = mine.iloc[_front(error.to_numpy(float), number.to_numpy(float))]
            _name_points(sheet, panel, best, error, number)
            title = measure.removeprefix("output:").replace("lambda", "λ")
            panel.set(xlabel="mean relative error", ylabel="break-even [queries]", title=title)
            panel.set(xscale="log", yscale="log")
        yield sheet.finish(
            f"Number of queries from which a reduced model of {data.problem} is cheaper than the high-fidelity one, "
            f"over its mean relative error of u, of λ and of every quantity of interest; solver {solver}. Lines are "
            "95 % intervals. A point for every model; those on the Pareto front, which no model beats in both, have "
            f"their (N, R) and the tolerance δ of their primal strategy. {left_out}",
            part,
        )


def _front(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Places of the points on the Pareto front, of those that are small in x and y, from left to right."""
    # From left to right, a point is on the front if it is lower than all before it.
    order = np.lexsort((y, x))
    best = np.minimum.accumulate(y[order])
    return np.asarray(order[np.concatenate([np.ones(min(len(best), 1), dtype=bool), best[1:] < best[:-1]])])


def total_cost(data: ProblemTables) -> Pages:
    """Offline and online seconds against the number of queries; triangles mark where two models break even."""
    cells, queries = best_solver(data.cells), np.geomspace(1.0, 1e6, 61)
    panels = [
        (part, models.iloc[places])
        for title, mine in by_dimensions(cells)
        for models in [_most_vectors(mine)]
        for part, places in titled_parts(title, list(range(len(models))), "models", beside_reference=True)
    ]
    for shown, part in data.pages(panels, 12):
        sheet = Sheet.with_panels(len(shown), f"{data.problem}, {cells['solver'].iloc[0]}: total cost", share="all")
        drawn = [cell for _, mine in shown for cell in mine.itertuples()]
        looks = Looks(series(cell.primal, cell.primal_tol, cell.way) for cell in drawn)
        for panel, (title, mine) in zip(sheet.panels, shown, strict=False):
            model = mine.iloc[0]
            plot(panel, queries, model["hf_setup_s"] + queries * model["hf_s"], HIGH_FIDELITY_LOOK, HIGH_FIDELITY)
            for cell in mine.itertuples():
                key = (cell.primal, cell.primal_tol, cell.way)
                plot(panel, queries, cell.offline_s + queries * cell.online_s, looks[series(*key)], label(*key))
            _marks(panel, mine, data.thresholds, queries[-1])
            panel.set(xlabel="number of queries", ylabel="offline + online [s]", title=title)
            panel.set(xlim=(1.0, queries[-1]), xscale="log", yscale="log")
        yield sheet.finish(
            f"CPU seconds offline and online of the models of {data.problem} together against the number of queries; "
            f"solver {cells['solver'].iloc[0]}. A panel for every dual strategy and pair (N, R); every primal strategy "
            "and assembly is shown at the tolerance δ with the most vectors. Triangles mark where two models cost the "
            "same and point to the side on which the reduced model is cheaper than the high-fidelity one, the fixed "
            "enrichment than the one per parameter, or another formulation than the mixed program; bars are 95 % "
            "intervals of that number of queries.",
            part,
        )


def _most_vectors(cells: pd.DataFrame) -> pd.DataFrame:
    """The cells with the most vectors of every strategy and way: a line per tolerance would hide the crossings."""
    by = {"by": ["added", "primal_tol"], "ascending": [False, True], "kind": "stable"}
    added = cells.assign(added=cells["enrichment"].fillna(0)).sort_values(**by)
    return added.drop_duplicates(["primal", "primal_options", "way"]).sort_index()


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


def solvers(data: ProblemTables) -> Pages:
    """Time of every solver against the accuracy it achieves, and its performance profile (Dolan and Moré, 2002).

    Failures count as infinite times, so that a curve ends at the fraction its solver solved. One solver has no profile.
    """
    queries = of_solvers(data.queries)
    if not queries["solve_s"].notna().any():
        return
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
    """Median time of a program against the part of the error of u and of λ that the solver makes, over the accuracy."""
    shared = common_programs(data.queries)
    if shared["accuracy"].nunique() < 2:
        return
    count = len(shared) // shared.groupby(["solver", "accuracy"]).ngroups
    groups = parts(sorted(map(str, shared["solver"].unique())))
    title = f"{data.problem}: time and precision of the QP solvers, {count} programs"
    sheet = Sheet(len(groups), 2, title, sharex="all", sharey="col")
    looks = Looks(Series(name) for group in groups for name in group)
    for row, group in enumerate(groups):
        for solver in group:
            mine = shared[shared["solver"] == solver]
            medians = mine.groupby("accuracy")[["solve_s", "solver_error_u", "solver_error_lambda"]].median()
            for column, name in enumerate(("u", "lambda")):
                # A logarithmic axis has no zero.
                error = np.maximum(medians[f"solver_error_{name}"], 1e-16)
                panel, look = sheet.panel(row, column), looks[Series(solver)]
                # Every point is an accuracy, and has a marker.
                plot(panel, 1e3 * medians["solve_s"], error, look, solver, markevery=1)
        for column, name in enumerate(("u", "λ")):
            panel = sheet.panel(row, column)
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
        worst = mine[["primal_residual", "dual_residual", "gap"]].max(axis=1) / mine["accuracy"]
        models = mine.assign(worst=worst).groupby("cell").agg(time=("solve_s", "median"), worst=("worst", "max"))
        # A query without a solution has no residual.
        finite = models[np.isfinite(models["worst"])]
        scatter(panel, 1e3 * finite["time"], np.maximum(finite["worst"], 1e-16), looks[Series(solver)], solver)
    panel.set(xlabel="median time of a program [ms]", ylabel="largest residual / accuracy")
    panel.set(xscale="log", yscale="log")


def _profile(panel: Axes, queries: pd.DataFrame, names: list[str], looks: Looks) -> None:
    solved = queries["solve_s"].where(queries["status"] == Status.OK, np.inf).fillna(np.inf)
    by = [*program_columns(), "accuracy", "solver"]
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
