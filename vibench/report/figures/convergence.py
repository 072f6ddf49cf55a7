"""Figures of projection errors, enrichment and inf-sup constants (paper, Figures 5 to 8 and 11 to 15)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import starmap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.interfaces.strategies import Kind
from vibench.report.figures import style
from vibench.report.figures.data import ProblemTables, by_strategy, dimensions, parts, series, titled_parts
from vibench.report.figures.style import CaptionedFigure, Looks, Pages, Series, Sheet, counted, plot, positive
from vibench.stability.infsup import VANISHES


def projection_errors(data: ProblemTables) -> Pages:
    """Relative projection errors of the POD and of the cones against their size (paper, Figures 5 and 11)."""
    errors = data.histories[data.histories["quantity"] == "error"]
    cones = parts([(str(dual), rows) for dual, rows in longest(errors[errors["stage"] == "cone"])]) or [[]]
    sheet = Sheet.with_panels(1 + len(cones), f"{data.problem}: projection errors over the training set")
    left, *others = sheet.panels
    for _, steps in longest(errors[errors["stage"] == "pod"]):
        # A tail below this is round-off.
        shown = steps[steps["value"] > 1e-12]
        plot(left, shown["step"], shown["value"], style.look_of("POD"), "POD")
    left.set(xlabel="number of modes N", ylabel="relative error of the POD", title="primal", yscale="log")
    counted(left)
    for panel, group in zip(others, cones, strict=False):
        panel.set(title="dual")
        _cones(panel, group)
    yield sheet.finish(
        f"Projection errors of {data.problem} over the training set: left, the relative tail of the POD against the "
        "number N of modes; right, the largest relative distance of a multiplier from the cone of the first R "
        "generators, for every dual strategy. Each curve is that of the tightest tolerance, which contains the others."
    )


def cone_errors(title: str, steps: pd.DataFrame) -> CaptionedFigure:
    """Relative errors of cones against their numbers of generators, from rows of `dual`, `step` and `value`."""
    groups = parts([(str(dual), rows) for dual, rows in steps.groupby("dual")])
    sheet = Sheet.with_panels(len(groups), f"{title}: projection errors of the multipliers", share="all")
    for panel, group in zip(sheet.panels, groups, strict=False):
        _cones(panel, group)
    return sheet.finish(
        f"Largest relative distance of a multiplier of {title} from the cone of the first R generators, for every dual "
        "strategy."
    )


def _cones(panel: Axes, cones: Sequence[tuple[str, pd.DataFrame]]) -> None:
    looks = Looks(Series(dual) for dual, _ in cones)
    for dual, steps in cones:
        plot(panel, steps["step"], positive(steps["value"], 0.0), looks[Series(dual)], dual)
    panel.set(xlabel="number of generators R", ylabel="largest relative error of the cone", yscale="log")
    counted(panel)


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
                for name, key, one in by_strategy(steps[steps["quantity"] == quantity]):
                    # σ that is round-off is drawn at the floor, so that its curve ends at the last vector.
                    sines = quantity == "sigma"
                    values = np.maximum(one["value"], floor) if sines else positive(one["value"], floor)
                    plot(panel, one["step"], values, looks[key], name)
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
    axis, wanted = data.parameter, {series(*name) for name in names}
    for name, key, one in by_strategy(one_solver(queries)):
        if key in wanted:
            ordered = one.sort_values("mu_1" if axis else "beta_span")
            plot(panel, ordered["mu_1"] if axis else np.arange(1, len(one) + 1), ordered["beta_span"], looks[key], name)
    panel.set(xlabel=axis or "validation parameters, sorted by β", ylabel="β over span")
    if not axis:
        counted(panel)


def _tightest(steps: pd.DataFrame) -> pd.DataFrame:
    """The histories of every strategy at the tolerance with the most vectors."""
    # This quantity has a value per vector added.
    grown = steps[steps["quantity"] == "beta_span_min"]
    return at_best_tolerance(steps, grown.groupby(["primal", "primal_tol"])["step"].max())


def inf_sup(data: ProblemTables) -> Pages:
    """Inf-sup constants β of every primal strategy and of the high-fidelity pair over the validation set."""
    # Without the other columns: a run may have thousands of pairs, each with a copy of its rows.
    needed = ["pair", "query", "cell", "mu_1", "enrichment_kind", "primal", "primal_tol"]
    needed += [name for name in data.queries if name.startswith("beta_")]
    constants = one_solver(data.queries[needed], ["pair"])
    shown, axis = loosest(constants), data.parameter
    for panels, part in data.pages(list(_panels(data, shown)), 6):
        sheet, over, below = style.two_rows(len(panels), f"{data.problem}, {data.duals[0]}: inf-sup constants")
        looks = Looks(key for _, strategies, _, _ in panels for _, key, _ in strategies)
        zeros: list[list[str]] = []
        for (title, strategies, first, order), span, cone in zip(panels, over, below, strict=True):
            reference, both = first.set_index("query").reindex(order), (span, cone)
            # Without a single parameter the abscissae are places in the order.
            x = reference["mu_1"].to_numpy(float) if axis else np.arange(1, len(reference) + 1)
            _draw_constants(both, x, reference, "beta_hf_", style.HIGH_FIDELITY_LOOK, "high-fidelity")
            drawn = {
                name: _draw_constants(both, x, rows.set_index("query").reindex(order), "beta_", looks[key], name)
                for name, key, rows in strategies
            }
            zeros.append([name for name, zero in drawn.items() if zero])
            span.set_title(title)
            for axes, generated in ((span, "span"), (cone, "cone")):
                axes.set(ylabel=f"β over {generated}", xlabel=axis or "validation parameters, sorted", yscale="log")
                if not axis:
                    counted(axes)
        _name_zeros(over, zeros)
        yield sheet.finish(_caption(data, constants, shown, bool(axis)), part)


def loosest(constants: pd.DataFrame) -> pd.DataFrame:
    """The rows of fixed enrichments at the tolerance of the smallest mean β, and those of all other strategies."""
    fixed = constants["enrichment_kind"] == Kind.FIXED
    compared = common_tolerances(constants[fixed])
    # Each pair weighs the same, whatever the size of its constants.
    means = compared.groupby(["primal", "primal_tol", "pair"])["beta_span"].mean().unstack()
    score = -(means / means.max()).mean(axis=1).astype(float)
    return constants.loc[~fixed | constants.index.isin(at_best_tolerance(compared, score).index)]


def _panels(data: ProblemTables, shown: pd.DataFrame) -> Iterator[tuple[str, list[Any], pd.DataFrame, pd.Series]]:
    """Title, strategies, rows of the first of these and order of the queries of each panel.

    A pair has a panel, and several where there are more strategies than a panel takes.
    """
    by_pair = dict(iter(shown.groupby("pair", sort=False)))
    for pair, sizes in data.queries[["pair", "N", "R"]].groupby("pair", sort=False):
        # Without contact, as without generators, a pair has no constants.
        if pair not in by_pair:
            continue
        rows = by_pair[pair]
        fixed = rows[rows["enrichment_kind"] == Kind.FIXED]
        sorting = fixed if len(fixed) else rows
        first = sorting[sorting["cell"] == sorting["cell"].iloc[0]]
        order = first.sort_values("mu_1" if data.parameter else "beta_span", kind="stable")["query"]
        strategies = list(by_strategy(rows))
        groups = titled_parts(dimensions(sizes), strategies, beside_reference=True)
        yield from ((title, group, strategies[0][2], order) for title, group in groups)


def _draw_constants(
    axes: tuple[Axes, Axes], x: Any, rows: pd.DataFrame, prefix: str, look: style.Look, name: str
) -> bool:
    """Constants over the span, and the interval over the cone as its upper end with a band; whether β is 0 there."""
    top, below = axes
    span = rows[f"{prefix}span"].to_numpy(float)
    finite = span[np.isfinite(span)]
    plot(top, x, positive(span, VANISHES), look, name)
    lower, upper = rows[f"{prefix}cone_lower"].to_numpy(float), rows[f"{prefix}cone_upper"].to_numpy(float)
    plot(below, x, positive(upper, VANISHES), look)
    below.fill_between(x, lower, upper, color=look.colour, alpha=0.2, linewidth=0.0)
    return bool(finite.size and finite.max() < VANISHES)


def _name_zeros(panels: list[Axes], zeros: list[list[str]]) -> None:
    """Write below the curves what a logarithmic axis cannot show; the panels share their axis."""
    low, high = panels[0].get_ylim()
    lines = max(map(len, zeros))
    if lines and 0.0 < low < high:
        panels[0].set_ylim(low * (low / high) ** (0.1 * lines), high)
    for panel, names in zip(panels, zeros, strict=True):
        if names:
            text = "\n".join(f"β = 0: {name}" for name in names)
            panel.text(0.02, 0.03, text, transform=panel.transAxes, fontsize=7)


def _caption(data: ProblemTables, constants: pd.DataFrame, shown: pd.DataFrame, along: bool) -> str:
    text = [
        f"Inf-sup constants β of {data.problem} with the cones of {data.duals[0]} at the validation parameters, "
        f"{data.queries['query'].nunique()} of them, for the high-fidelity pair and every primal strategy: over the "
        "span of the generators (upper row) and over their cone (lower row, with certified intervals as bands).",
        "" if along else "Parameters are sorted by the constant of the first fixed enrichment, or else strategy.",
    ]
    for primal, rows in constants.groupby("primal", sort=False):
        given, kept = rows["primal_tol"].dropna().unique(), shown[shown["primal"] == primal]["primal_tol"].dropna()
        if len(given) > kept.nunique():
            left_out = [value for value in given if value not in set(kept)]
            text.append(f"{primal} is shown at δ = {some(kept)}, its loosest; left out: {some(left_out)}.")
    return " ".join(text)


def at_best_tolerance(rows: pd.DataFrame, score: pd.Series) -> pd.DataFrame:
    """Rows of every primal strategy at the tolerance of its largest score by (primal, primal_tol), or without one."""
    scores = score.dropna().rename("score").reset_index()
    top = scores.groupby("primal")["score"].transform("max")
    # The largest tolerance of scores equal up to 1e-6: figures do not depend on the last digits of a run.
    near = scores[scores["score"] >= top - 1e-6 * top.abs()]
    tolerances = near.groupby("primal")["primal_tol"].max()
    return rows[rows["primal_tol"].isna() | (rows["primal_tol"] == rows["primal"].map(tolerances))]


def common_tolerances(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows at tolerances that a strategy has at every pair, where it has such ones."""
    pairs = rows.groupby(["primal", "primal_tol"])["pair"].nunique()
    everywhere = pairs[pairs == rows.groupby("primal")["pair"].nunique().reindex(pairs.index, level="primal")]
    common = pd.MultiIndex.from_frame(rows[["primal", "primal_tol"]]).isin(everywhere.index)
    return rows[common | ~rows["primal"].isin(everywhere.index.get_level_values("primal"))]


def longest(histories: pd.DataFrame) -> Iterator[tuple[Any, pd.DataFrame]]:
    """The longest history for each dual strategy."""
    # It contains the others: POD and cones are nested, so a looser tolerance stops at an earlier step.
    for dual, group in histories.groupby("dual", dropna=False):
        yield dual, group[group["artefact"] == group.groupby("artefact")["step"].max().idxmax()]


def one_solver(queries: pd.DataFrame, axes: Sequence[str] = ()) -> pd.DataFrame:
    """One row per strategy, tolerance, query and values on the `axes`, sorted by these."""
    # Inf-sup constants depend on no solver, assembly or correction.
    rows = queries.drop_duplicates([*axes, "primal", "primal_tol", "query"])
    return rows.iloc[np.argsort(rows.groupby(list(axes), sort=False).ngroup(), kind="stable")] if axes else rows


def some(values: Any) -> str:
    """Numbers as an enumeration, in their order; of more than six the middle is left out."""
    texts = [f"{value:g}" for value in np.unique(np.asarray(values, float))]
    return ", ".join(texts if len(texts) <= 6 else [*texts[:5], "…", texts[-1]])
