"""Figures of the offline phase: mesh, projection errors, enrichment (paper, Figures 3, 5 to 7, 11, 12 and 14)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import starmap

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.arrays import Array
from vibench.interfaces.strategies import Kind
from vibench.report.figures.data import (
    ProblemTables,
    at_best_tolerance,
    by_strategy,
    dimensions,
    longest,
    one_solver,
    parts,
    series,
    some,
    titled_parts,
)
from vibench.report.figures.style import (
    CaptionedFigure,
    Looks,
    Pages,
    Series,
    Sheet,
    counted,
    look_of,
    plot,
    positive,
)


def projection_errors(data: ProblemTables) -> Pages:
    """Relative projection errors of the POD and of the cones against their size (paper, Figures 5 and 11)."""
    errors = data.histories[data.histories["quantity"] == "error"]
    cones = _in_panels(errors[errors["stage"] == "cone"])
    sheet = Sheet.with_panels(1 + len(cones), f"{data.problem}: projection errors over the training set")
    left, *others = sheet.panels
    for _, steps in longest(errors[errors["stage"] == "pod"]):
        # A tail below this is round-off.
        shown = steps[steps["value"] > 1e-12]
        plot(left, shown["step"], shown["value"], look_of("POD"), "POD")
    left.set(xlabel="number of modes N", ylabel="relative error of the POD", title="primal", yscale="log")
    counted(left)
    for panel, names in zip(others, cones, strict=False):
        panel.set(title="dual")
        _cones(panel, names, "number of generators R", "largest relative error of the cone")
    yield sheet.finish(
        f"Projection errors of {data.problem} over the training set: left, the relative tail of the POD against the "
        "number N of modes; right, the largest relative distance of a multiplier from the cone of the first R "
        "generators, for every dual strategy. Each curve is that of the tightest tolerance, which contains the others."
    )


def cone_errors(title: str, errors: Mapping[str, Array]) -> CaptionedFigure:
    """Relative errors of cones, by dual strategy, against their numbers of generators 0 … R."""
    groups = parts(sorted(errors))
    sheet = Sheet.with_panels(len(groups), f"{title}: projection errors of the multipliers", share="all")
    looks = Looks(map(Series, errors))
    for panel, names in zip(sheet.panels, groups, strict=False):
        for dual in names:
            plot(panel, np.arange(len(errors[dual])), positive(errors[dual], 0.0), looks[Series(dual)], dual)
        panel.set(xlabel="number of generators R", ylabel="largest relative error of the cone", yscale="log")
        counted(panel)
    return sheet.finish(
        f"Largest relative distance of a multiplier of {title} from the cone of the first R generators, for every dual "
        "strategy."
    )


def _in_panels(histories: pd.DataFrame) -> list[dict[str, pd.DataFrame]]:
    cones = [(str(dual), rows) for dual, rows in longest(histories)]
    return [dict(group) for group in parts(cones)] or [{}]


def _cones(axes: Axes, cones: Mapping[str, pd.DataFrame], xlabel: str, ylabel: str) -> None:
    looks = Looks(map(Series, cones))
    for dual, steps in cones.items():
        plot(axes, steps["step"], positive(steps["value"], 0.0), looks[Series(dual)], dual)
    axes.set(xlabel=xlabel, ylabel=ylabel, yscale="log")
    counted(axes)


def enrichment(data: ProblemTables) -> Pages:
    """Fixed enrichments: σ and min β against the vectors added, β over the validation set (paper, Figures 7 and 14)."""
    fixed = data.queries[data.queries["enrichment_kind"] == Kind.FIXED]
    strategies = fixed.drop_duplicates(["primal", "primal_tol"])
    # Sines below this are round-off.
    floor = 1e-14
    looks = Looks(starmap(series, zip(strategies["primal"], strategies["primal_tol"], strict=True)))
    for rows, part in data.pages(_enrichment_rows(fixed), 4):
        sheet = Sheet(len(rows), 3, f"{data.problem}, {data.duals[0]}: fixed enrichments", sharey="col")
        for row, (title, pair, names) in enumerate(rows):
            histories = data.histories[(data.histories["stage"] == "enrichment") & (data.histories["pair"] == pair)]
            steps = _tightest(histories[histories["primal"].isin({name for name, _ in names})])
            for column, quantity in enumerate(("sigma", "beta_span_min")):
                panel, name_of = sheet.panel(row, column), ("largest σ", "min β over span")[column]
                for name, one in by_strategy(steps[steps["quantity"] == quantity]):
                    look = looks[series(one["primal"].iloc[0], one["primal_tol"].iloc[0])]
                    # σ that is round-off is drawn at the floor, so that its curve ends at the last vector.
                    sines = quantity == "sigma"
                    values = np.maximum(one["value"], floor) if sines else positive(one["value"], floor)
                    plot(panel, one["step"], values, look, name)
                panel.set(xlabel="vectors added", ylabel=f"{name_of}, training set", title=title)
                panel.set(xlim=(0, None), yscale="log")
                counted(panel)
            _validation(sheet.panel(row, 2), data, fixed[fixed["pair"] == pair], names, looks)
            sheet.panel(row, 2).set_title(title)
        # All rows share this axis.
        sheet.panel(0, 2).set_ylim(0, None)
        yield sheet.finish(_enrichment_caption(data, fixed, floor), part)


def _enrichment_caption(data: ProblemTables, fixed: pd.DataFrame, floor: float) -> str:
    tolerances = ", ".join(
        f"{primal} at δ = {some(mine['primal_tol'].dropna())}"
        for primal, mine in fixed.groupby("primal", sort=False)
        if mine["primal_tol"].notna().any()
    )
    return (
        f"Fixed enrichments of {data.problem} with the cones of {data.duals[0]}, a row for every pair (N, R). Left, "
        f"the largest σ over the training set against the number of vectors added, for strategies that report it, at "
        f"{floor:g} where it is smaller, which is round-off; "
        "middle, the smallest β over the span on the training set; both for the tolerance that went farthest. Right, "
        f"β over the span at the validation parameters, for every tolerance{f' ({tolerances})' * bool(tolerances)}."
    )


def _enrichment_rows(fixed: pd.DataFrame) -> list[tuple[str, str, list[tuple[str, float]]]]:
    """Title, pair, and strategies with their tolerances of every row of panels."""
    rows = list[tuple[str, str, list[tuple[str, float]]]]()
    for pair, group in fixed.groupby("pair", sort=False):
        strategies = group.drop_duplicates(["primal", "primal_tol"]).sort_values(["primal", "primal_tol"])
        names = list(zip(strategies["primal"], strategies["primal_tol"], strict=True))
        rows += [(title, str(pair), some_names) for title, some_names in titled_parts(dimensions(group), names)]
    return rows


def _validation(
    panel: Axes, data: ProblemTables, queries: pd.DataFrame, names: list[tuple[str, float]], looks: Looks
) -> None:
    """β at the validation parameters: over the only parameter, or each curve sorted for itself."""
    wanted = {str(series(*name)) for name in names}
    for name, one in by_strategy(one_solver(queries)):
        of = series(one["primal"].iloc[0], one["primal_tol"].iloc[0])
        if str(of) not in wanted:
            continue
        if data.parameter:
            ordered = one.sort_values("mu_1")
            plot(panel, ordered["mu_1"], ordered["beta_span"], looks[of], name)
        else:
            plot(panel, np.arange(1, len(one) + 1), np.sort(one["beta_span"]), looks[of], name)
    xlabel = data.parameter or "validation parameters, sorted by β"
    panel.set(xlabel=xlabel, ylabel="β over span")
    if not data.parameter:
        counted(panel)


def _tightest(steps: pd.DataFrame) -> pd.DataFrame:
    """The histories of every strategy at the tolerance with the most vectors."""
    # This quantity has a value per vector added.
    grown = steps[steps["quantity"] == "beta_span_min"]
    return at_best_tolerance(steps, grown.groupby(["primal", "primal_tol"])["step"].max())
