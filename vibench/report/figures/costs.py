"""Errors against dimension and time of a query, and total cost against the number of queries."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.report.common_queries import on_common_queries
from vibench.report.figures.data import (
    Data,
    best_solver,
    by_dimensions,
    label,
    parts,
    point_names,
    series,
)
from vibench.report.figures.looks import HIGH_FIDELITY_LOOK, Looks, Series
from vibench.report.figures.style import ABREAST, DEEP, SERIES, CaptionedFigure, Layout, Sheet, plot, positive, scatter
from vibench.results import error_measures
from vibench.results.break_even import HIGH_FIDELITY, Meaning
from vibench.results.error_measures import OUTPUT

ERRORS = {"error_u_mean": "mean relative error of u", "error_lambda_mean": "mean relative error of λ"}

MOST_QUERIES = 1e6
"""Total cost is drawn up to this number of queries."""

MODEL = ["primal", "primal_options", "assembly"]
"""Columns of which total cost has a line for every combination, at one tolerance."""

MARKS = {Meaning.FROM: ">", Meaning.UNTIL: "<"}


def dimension(data: Data) -> CaptionedFigure | None:
    """Errors against the dimension of the reduced problem, N + S + R; means over the queries that all cells solved."""
    cells = _of_one_assembly(best_solver(data.cells))
    size = cells["N"] + cells["enrichment"].fillna(0) + cells["R"]
    return _scatter(data, cells, size, "dimension N + S + R", "errors against dimension")


def work_precision(data: Data) -> CaptionedFigure | None:
    """Errors against the time of a query; no cell is both faster and more accurate than those on the line.

    Errors are means over the queries that all of these cells solved; a cell that solved fewer than half has no point.
    """
    cells = best_solver(data.cells)
    return _scatter(data, cells, 1e3 * cells["online_s"], "mean time of a query [ms]", "work and precision", front=True)


def _scatter(
    data: Data, cells: pd.DataFrame, x: pd.Series, xlabel: str, title: str, *, front: bool = False
) -> CaptionedFigure | None:
    """One point per cell with its (N, R) and δ; a row of panels for every dual strategy and assembly among them."""
    compared = on_common_queries(cells[x.notna()], data.queries)
    cells = compared.cells[compared.cells[list(ERRORS)].notna().any(axis=1)]
    if cells.empty:
        return None
    rows = data.on_page(list(_rows(cells)), DEEP)
    if not rows:
        return None
    heading = f"{data.problem}, {cells['solver'].iloc[0]}: {title}{compared.over}"
    sheet = Sheet(len(rows), 2, heading, Layout(width=4.4, height=3.3), "all", "col")
    looks = Looks(Series(str(primal)) for primal in cells["primal"].unique())
    for row, (name, mine, names) in enumerate(rows):
        for place, (column, ylabel) in enumerate(ERRORS.items()):
            panel = sheet.at(row, place)
            drawn = mine[mine[column].notna()]
            for primal in names:
                one = drawn[drawn["primal"] == primal]
                scatter(panel, x[one.index], one[column], looks[Series(str(primal))], str(primal))
            for index, text in point_names(drawn[drawn["primal"].isin(names)]).items():
                sheet.label(panel, x[index], drawn.at[index, column], text)
            if front:
                best = drawn.iloc[_front(x[drawn.index].to_numpy(float), drawn[column].to_numpy(float))]
                panel.plot(x[best.index], best[column], color="0.6", linewidth=0.8, drawstyle="steps-post", zorder=0)
            panel.set(xlabel=xlabel, ylabel=ylabel, title=name, xscale="log", yscale="log")
    over = compared.over or f" over all {compared.asked} queries"
    rows_of = "dual strategy" + " and assembly" * (cells["assembly"].nunique() > 1)
    beyond = "The thin line is the Pareto front: no model is both faster and more accurate." if front else ""
    return sheet.finish(
        f"Relative errors of u (left) and of λ (right) of the reduced models of {data.problem}, means{over}, against "
        f"the {xlabel}; solver {cells['solver'].iloc[0]}. A row for every {rows_of}, a point for "
        "every model, with its (N, R) and the tolerance δ of its primal strategy; a number alone is another δ. "
        f"{beyond}"
        f"{data.part}"
    )


def sized(data: Data) -> int:
    """Number of rows of panels of `dimension`."""
    return len(list(_rows(_of_one_assembly(best_solver(data.cells)))))


def timed(data: Data) -> int:
    """Number of rows of panels of `work_precision`."""
    return len(list(_rows(best_solver(data.cells))))


def _of_one_assembly(cells: pd.DataFrame) -> pd.DataFrame:
    """Cells of full assembly, where there are any: reduced assembly changes no dimension."""
    return cells[(cells["assembly"] == "full") | ~(cells["assembly"] == "full").any()]


def _rows(cells: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame, list[str]]]:
    """Title, cells and primal strategies of every row of panels."""
    for (dual, assembly), mine in cells.groupby(["dual", "assembly"], sort=False):
        groups = parts([str(name) for name in mine["primal"].unique()], SERIES)
        how = f", {assembly} assembly" * (assembly != "full")
        for k, names in enumerate(groups, 1):
            yield f"{dual}{how}{f', strategies {k} of {len(groups)}' * (len(groups) > 1)}", mine, names


def outputs(data: Data) -> CaptionedFigure | None:
    """Errors of every quantity of interest, over its largest value of the training set, against the time of a query."""
    panels = data.on_page(_reported(data), ABREAST * DEEP)
    if not panels:
        return None
    solver = data.cells.loc[data.cells["cell"] == panels[0][1]["cell"].iloc[0], "solver"].iloc[0]
    sheet = Sheet.of(len(panels), f"{data.problem}, {solver}: quantities of interest")
    looks = Looks(Series(name) for _, _, names in panels for name in names)
    for panel, (title, mine, names) in zip(sheet.panels, panels, strict=False):  # the last ones may be empty
        for name in names:
            one = mine[mine["primal"] == name]
            scatter(panel, 1e3 * one["online_s"], positive(one["error_scaled_mean"]), looks[Series(name)], name)
        for index, text in point_names(mine[mine["primal"].isin(names)]).items():
            sheet.label(panel, 1e3 * mine.at[index, "online_s"], mine.at[index, "error_scaled_mean"], text)
        panel.set(xlabel="mean time of a query [ms]", ylabel="mean error over the scale", title=title)
        panel.set(xscale="log", yscale="log")
    return sheet.finish(
        f"Mean errors of the quantities of interest of {data.problem} over their largest value on the training set, "
        f"against the mean time of a query; solver {solver}. A panel for every quantity, dual strategy and assembly, a "
        "point for every model, with its (N, R) and the tolerance δ of its primal strategy; a number alone is another "
        f"δ.{data.part}"
    )


def break_even(data: Data) -> CaptionedFigure | None:
    """Queries from which a reduced model is cheaper than the high-fidelity one, against its errors, also of outputs."""
    panels, without = _decided(data)
    shown = data.on_page(panels, ABREAST * DEEP)
    if not shown:
        return None
    solver = data.cells.loc[data.cells["cell"] == shown[0][1]["cell"].iloc[0], "solver"].iloc[0]
    sheet = Sheet.of(len(shown), f"{data.problem}, {solver}: break-even and accuracy")
    looks = Looks(Series(str(name)) for _, mine in shown for name in mine["primal"].unique())
    for panel, (measure, mine) in zip(sheet.panels, shown, strict=False):
        for name, rows in mine.groupby("primal", sort=False):
            scatter(panel, positive(rows["error"]), rows["benefit_threshold"], looks[Series(str(name))], str(name))
        low, high = (mine[f"threshold_{end}"].replace(np.inf, np.nan) for end in ("low", "high"))
        panel.vlines(mine["error"], low, high, color="0.6", lw=0.8, zorder=0)
        best = mine.iloc[_front(mine["error"].to_numpy(float), mine["benefit_threshold"].to_numpy(float))]
        for index, text in point_names(best).items():
            sheet.label(panel, best.at[index, "error"], best.at[index, "benefit_threshold"], text)
        title = measure.removeprefix(OUTPUT).replace("lambda", "λ")
        panel.set(xlabel="mean relative error", ylabel="break-even [queries]", title=title, xscale="log", yscale="log")
    left_out = f" Models without such a number, or with an undecided one, have no point: {without}." * bool(without)
    return sheet.finish(
        f"Number of queries from which a reduced model of {data.problem} is cheaper than the high-fidelity one, over "
        f"its mean relative error of u, of λ and of every quantity of interest; solver {solver}. Lines are 95 % "
        f"intervals. A point for every model; those on the Pareto front, which no model beats in both, "
        f"have their (N, R) and the tolerance δ of their primal strategy.{left_out}"
        f"{data.part}"
    )


def decided(data: Data) -> int:
    """Number of panels of `break_even`."""
    return len(_decided(data)[0])


def _decided(data: Data) -> tuple[list[tuple[str, pd.DataFrame]], int]:
    """Measure and models of every panel of `break_even`, and the number of models that have no break-even."""
    cells, numbers = best_solver(data.cells), ["benefit_threshold", "threshold_low", "threshold_high", "meaning"]
    against = data.thresholds[data.thresholds["cell_a"].isna()].set_index("cell_b")[numbers]
    mine = cells.merge(against, "inner", left_on="cell", right_index=True)
    found = mine[mine["meaning"] == Meaning.FROM]
    panels = [
        (measure, found.assign(error=error_measures.errors_of(found, data.outputs, measure)).dropna(subset=["error"]))
        for measure in error_measures.measures(data.outputs)
        if measure != error_measures.SOLUTION
    ]
    return [(measure, rows) for measure, rows in panels if len(rows)], len(mine) - len(found)


def reported(data: Data) -> int:
    """Number of panels of `outputs`."""
    return len(_reported(data))


def _reported(data: Data) -> list[tuple[str, pd.DataFrame, list[str]]]:
    """Title, models and primal strategies of every panel of `outputs`."""
    known = ["cell", "output", "error_scaled_mean"]
    found = data.outputs.loc[data.outputs["error_scaled_mean"].notna(), known]
    mine = best_solver(data.cells).merge(found, "inner", "cell")
    return [
        (f"{name}, {title}", rows, names)
        for name, of_output in mine.groupby("output", sort=False)
        for title, rows, names in _rows(of_output)
    ]


def _front(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Places of the points on the Pareto front, of those that are small in x and y, from left to right."""
    order = np.lexsort((y, x))
    best = np.minimum.accumulate(y[order])
    kept: np.ndarray = order[np.concatenate([np.ones(min(len(best), 1), dtype=bool), best[1:] < best[:-1]])]
    return kept


def total_cost(data: Data) -> CaptionedFigure | None:
    """Offline and online seconds against the number of queries; triangles mark where two models break even."""
    cells = best_solver(data.cells)
    if cells.empty:
        return None
    shown = data.on_page(_pairs(cells), DEEP * ABREAST)
    sheet = Sheet.of(len(shown), f"{data.problem}, {cells['solver'].iloc[0]}: total cost", share="all")
    looks = Looks(_model(cell) for _, mine in shown for cell in mine.itertuples())
    for panel, (title, mine) in zip(sheet.panels, shown, strict=False):
        queries = np.geomspace(1.0, MOST_QUERIES, 61)
        model = mine.iloc[0]
        plot(panel, queries, model["hf_setup_s"] + queries * model["hf_s"], HIGH_FIDELITY_LOOK, HIGH_FIDELITY)
        for cell in mine.itertuples():
            name = label(cell.primal, cell.primal_tol, cell.assembly)
            plot(panel, queries, cell.offline_s + queries * cell.online_s, looks[_model(cell)], name)
        _marks(panel, mine, data.thresholds)
        panel.set(xlabel="number of queries", ylabel="offline + online [s]", title=title)
        panel.set(xlim=(1.0, MOST_QUERIES), xscale="log", yscale="log")
    return sheet.finish(
        f"CPU seconds offline and online of the models of {data.problem} together against the number of queries; "
        f"solver {cells['solver'].iloc[0]}. A panel for every dual strategy and pair (N, R); every primal strategy and "
        "assembly is shown at the tolerance δ with the most vectors. Triangles mark where two models cost the same and "
        "point to the side on which the reduced model is cheaper than the high-fidelity one, or the fixed enrichment "
        "than the one per parameter; bars are 95 % intervals of that number of queries."
        f"{data.part}"
    )


def pairs(data: Data) -> int:
    """Number of panels of `total_cost`."""
    models = best_solver(data.cells).drop_duplicates(["dual", "pair", *MODEL])
    return int((-(-models.groupby(["dual", "pair"]).size() // (SERIES - 1))).sum())


def _pairs(cells: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Title and cells of every panel."""
    return [
        (f"{title}{f', models {k} of {len(groups)}' * (len(groups) > 1)}", shown.iloc[group])
        for title, mine in by_dimensions(cells)
        for shown in [_most_vectors(mine)]
        for groups in [parts(list(range(len(shown))), SERIES - 1)]
        for k, group in enumerate(groups, 1)
    ]


def _most_vectors(cells: pd.DataFrame) -> pd.DataFrame:
    """The cells with the most vectors of every strategy and assembly: a line per tolerance would hide the crossings."""
    added = cells.assign(added=cells["enrichment"].fillna(0)).sort_values(
        ["added", "primal_tol"], ascending=[False, True], kind="stable"
    )
    return added.drop_duplicates(MODEL).sort_index()


def _model(cell: Any) -> Series:
    return series(cell.primal, cell.primal_tol, cell.assembly)


def _marks(panel: Axes, cells: pd.DataFrame, thresholds: pd.DataFrame) -> None:
    """Break-even points between the lines of a panel, at their cost, with their intervals."""
    drawn, number = cells["cell"], thresholds["benefit_threshold"]
    between = thresholds["cell_a"].isna() | thresholds["cell_a"].isin(drawn)
    found = thresholds[thresholds["cell_b"].isin(drawn) & between & number.between(1.0, MOST_QUERIES)]
    found = found.assign(cost=found["offline_b_s"] + found["benefit_threshold"] * found["online_b_s"])
    for meaning, mine in found.groupby("meaning"):
        shape, name = MARKS[Meaning(meaning)], f"break-even: cheaper {meaning} here"
        panel.plot(mine["benefit_threshold"], mine["cost"], shape, c="black", ms=5, mfc="none", label=name, zorder=5)
    known = found[found[["threshold_low", "threshold_high"]].notna().all(axis=1)]
    panel.hlines(known["cost"], known["threshold_low"], known["threshold_high"], colors="black", lw=0.8, zorder=5)
