"""Figures of the reduced spaces: their convergence and their inf-sup constants (paper, Figures 5 to 8 and 11 to 15)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.interfaces.strategies import Kind
from vibench.report.figures import style
from vibench.report.figures.data import ProblemTables, by_strategy, dimensions, leading, parts, titled_parts
from vibench.report.figures.style import CaptionedFigure, Looks, Series, Sheet, counted, plot, positive
from vibench.results.schema import Row
from vibench.stability.infsup import VANISHES


def convergence(data: ProblemTables) -> CaptionedFigure:
    """POD and cones against their sizes, and fixed enrichments against the vectors added (paper, Figures 5, 7, 11, 14).

    Enrichments are those of the first cone at its tightest tolerances.
    """
    errors = data.histories[data.histories["quantity"] == "error"]
    # Nobody tells more than four curves of a panel apart.
    cones, part = leading([(str(dual), rows) for dual, rows in longest(errors[errors["stage"] == "cone"])], 4, "cones")
    fixed = data.queries.loc[data.queries["enrichment_kind"] == Kind.FIXED, "primal"]
    grown = data.histories[(data.histories["stage"] == "enrichment") & data.histories["primal"].isin(set(fixed))]
    grown = grown[grown["dual"] == grown["dual"].iloc[0]] if len(grown) else grown
    # The strategies at the tolerances with the most vectors.
    most = [rows for _, rows in longest(grown[grown["quantity"] == "beta_span_min"], "primal")][:4]
    steps = grown[grown["artefact"].isin({name for rows in most for name in rows["artefact"]})]
    looks = Looks([*(Series(dual) for dual, _ in cones), *(key for _, key, _ in by_strategy(steps))])
    sheet = Sheet(2 if most else 1, 2, f"{data.problem}: convergence over the training set")
    pod, cone, *others = sheet.panels
    for _, rows in longest(errors[errors["stage"] == "pod"]):
        # A tail below this is round-off.
        shown = rows[rows["value"] > 1e-12]
        plot(pod, shown["step"], shown["value"], style.HIGH_FIDELITY_LOOK, "POD")
    pod.set(xlabel="number of modes N", ylabel="relative error of the POD", title="primal", yscale="log")
    counted(pod)
    cone.set(title="dual")
    _cones(cone, cones, looks)
    quantities = (("sigma", "largest σ"), ("beta_span_min", "min β over span"))
    for panel, (quantity, label) in zip(others, quantities, strict=False):
        for name, key, rows in by_strategy(steps[steps["quantity"] == quantity]):
            # Round-off is drawn at the floor, so that the curve of σ ends at the last vector.
            values = np.maximum(rows["value"], 1e-14) if quantity == "sigma" else positive(rows["value"], 1e-14)
            plot(panel, rows["step"], values, looks[key], name)
        panel.set(xlabel="vectors added", ylabel=label, title="enrichment", xlim=(0, None), yscale="log")
        counted(panel)
    return sheet.finish(
        f"Convergence of {data.problem} over the training set: the relative tail of the POD against the number N of "
        "modes; the largest relative distance of a multiplier from the cone of the first R generators, for every dual "
        "strategy; and, for fixed enrichments of the first cone, the largest σ, where a strategy reports it, and the "
        "smallest β over the span against the number of vectors added. Each curve is that of the tightest tolerance.",
        part,
    )


def cone_errors(title: str, steps: pd.DataFrame) -> CaptionedFigure:
    """Relative errors of cones against their numbers of generators, from rows of `dual`, `step` and `value`."""
    groups = parts([(str(dual), rows) for dual, rows in steps.groupby("dual")])
    sheet = Sheet.with_panels(len(groups), f"{title}: projection errors of the multipliers", share="all")
    for panel, group in zip(sheet.panels, groups, strict=False):
        _cones(panel, group, Looks(Series(dual) for dual, _ in group))
    distance = f"Largest relative distance of a multiplier of {title} from the cone of the first R generators"
    return sheet.finish(f"{distance}, for every dual strategy.")


def _cones(panel: Axes, cones: Sequence[tuple[str, pd.DataFrame]], looks: Looks) -> None:
    for dual, steps in cones:
        plot(panel, steps["step"], positive(steps["value"], 0.0), looks[Series(dual)], dual)
    panel.set(xlabel="number of generators R", ylabel="largest relative error of the cone", yscale="log")
    counted(panel)


def inf_sup(data: ProblemTables) -> CaptionedFigure | None:
    """Inf-sup constants β of every primal strategy and of the high-fidelity pair over the validation set."""
    constants = _constants(data.queries)
    shown, axis = loosest(constants), data.parameter
    panels, part = leading(list(_panels(data, shown)), 2)
    if not panels:
        return None
    sheet, over, below = style.two_rows(len(panels), f"{data.problem}, {data.duals[0]}: inf-sup constants")
    looks = Looks(key for _, strategies, _, _ in panels for _, key, _ in strategies)
    zeros: list[list[str]] = []
    for (title, strategies, first, order), span, cone in zip(panels, over, below, strict=True):
        both = (span, cone)
        reference, x = _along(data, first, order, both)
        _draw_constants(both, x, reference, "beta_hf_", style.HIGH_FIDELITY_LOOK, "high-fidelity")
        drawn = {
            name: _draw_constants(both, x, rows.set_index("query").reindex(order), "beta_", looks[key], name)
            for name, key, rows in strategies
        }
        zeros.append([name for name, zero in drawn.items() if zero])
        span.set_title(title)
        for axes, generated in ((span, "span"), (cone, "cone")):
            axes.set(ylabel=f"β over {generated}", yscale="log")
    _name_zeros(over, zeros)
    return sheet.finish(_caption(data, constants, shown, bool(axis)), part)


def draw_stability(panel: Axes, data: ProblemTables, best: Row, names: Sequence[str], looks: Looks) -> str:
    """Draw β over the span at the pair of a cell, of the high-fidelity model and of some strategies.

    Returns what the panel shows, a sentence; "" where there are no constants.
    """
    mine = data.queries[(data.queries["dual"] == best["dual"]) & (data.queries["pair"] == best["pair"])]
    rows = _constants(mine)
    rows = loosest(rows[rows["primal"].isin(names) & rows["beta_hf_span"].notna()])
    strategies = list(by_strategy(rows))
    if not strategies:
        return ""
    sorting = next((of for _, _, of in strategies if (of["enrichment_kind"] == Kind.FIXED).any()), strategies[0][2])
    reference, x = _along(data, sorting, sorting.sort_values(_order(data), kind="stable")["query"], (panel,))
    _draw_constants((panel,), x, reference, "beta_hf_", style.HIGH_FIDELITY_LOOK, "high-fidelity")
    zeros = []
    for _, key, of in strategies:
        here = of.set_index("query").reindex(reference.index)
        if _draw_constants((panel,), x, here, "beta_", looks[Series(key.name)], key.name):
            zeros.append(key.name)
    panel.set(ylabel="β over span", yscale="log")
    _name_zeros([panel], [zeros])
    return (
        f"Upper right, inf-sup constants over the span of the {dimensions(mine)} pair of {best['dual']} at the "
        "validation parameters; an answer for λ is stable where the constant is near that of the full model."
    )


def _constants(queries: pd.DataFrame) -> pd.DataFrame:
    """The inf-sup constants of queries, pair by pair; they depend on no solver, assembly or correction."""
    # Without the other columns: a run may have thousands of pairs, each with a copy of its rows.
    needed = ["pair", "query", "cell", "mu_1", "enrichment_kind", "primal", "primal_tol"]
    needed += [name for name in queries if name.startswith("beta_")]
    rows = queries[needed].drop_duplicates(["pair", "primal", "primal_tol", "query"])
    return rows.iloc[np.argsort(rows.groupby(["pair"], sort=False).ngroup(), kind="stable")]


def _order(data: ProblemTables) -> str:
    """The column that validation parameters are sorted by."""
    return "mu_1" if data.parameter else "beta_span"


def _along(data: ProblemTables, rows: pd.DataFrame, order: pd.Series, panels: Sequence[Axes]) -> tuple[Any, Any]:
    """The rows of a cell in the order of the queries, and their abscissae; names the axis of the panels."""
    reference, axis = rows.set_index("query").reindex(order), data.parameter
    for panel in panels:
        panel.set(xlabel=axis or "validation parameters, sorted")
        if not axis:
            counted(panel)
    # Without a single parameter the abscissae are places in the order.
    return reference, reference["mu_1"].to_numpy(float) if axis else np.arange(1, len(reference) + 1)


def loosest(constants: pd.DataFrame) -> pd.DataFrame:
    """The rows of fixed enrichments at the tolerance of the smallest mean β, and those of all other strategies."""
    fixed = constants["enrichment_kind"] == Kind.FIXED
    compared = common_tolerances(constants[fixed])
    # Each pair weighs the same, whatever the size of its constants.
    means = compared.groupby(["primal", "primal_tol", "pair"])["beta_span"].mean().unstack()
    score = -(means / means.max()).mean(axis=1).astype(float)
    scores = score.dropna().rename("score").reset_index()
    top = scores.groupby("primal")["score"].transform("max")
    # The largest tolerance of scores equal up to 1e-6: figures do not depend on the last digits of a run.
    near = scores[scores["score"] >= top - 1e-6 * top.abs()]
    tolerances = near.groupby("primal")["primal_tol"].max()
    best = compared[compared["primal_tol"].isna() | (compared["primal_tol"] == compared["primal"].map(tolerances))]
    return constants.loc[~fixed | constants.index.isin(best.index)]


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
        order = first.sort_values(_order(data), kind="stable")["query"]
        strategies = list(by_strategy(rows))
        groups = titled_parts(dimensions(sizes), strategies, beside_reference=True)
        yield from ((title, group, strategies[0][2], order) for title, group in groups)


def _draw_constants(axes: Sequence[Axes], x: Any, rows: pd.DataFrame, prefix: str, look: style.Look, name: str) -> bool:
    """Constants over the span, and in a second panel the interval over the cone with its upper end.

    Returns whether β is zero over the span.
    """
    span = rows[f"{prefix}span"].to_numpy(float)
    finite = span[np.isfinite(span)]
    plot(axes[0], x, positive(span, VANISHES), look, name)
    lower, upper = rows[f"{prefix}cone_lower"].to_numpy(float), rows[f"{prefix}cone_upper"].to_numpy(float)
    for below in axes[1:]:
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


def common_tolerances(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows at tolerances that a strategy has at every pair, where it has such ones."""
    pairs = rows.groupby(["primal", "primal_tol"])["pair"].nunique()
    everywhere = pairs[pairs == rows.groupby("primal")["pair"].nunique().reindex(pairs.index, level="primal")]
    common = pd.MultiIndex.from_frame(rows[["primal", "primal_tol"]]).isin(everywhere.index)
    return rows[common | ~rows["primal"].isin(everywhere.index.get_level_values("primal"))]


def longest(histories: pd.DataFrame, axis: str = "dual") -> Iterator[tuple[Any, pd.DataFrame]]:
    """The longest history for each dual strategy, or on another axis."""
    # It contains the others: bases are nested, so that a looser tolerance stops at an earlier step.
    for name, group in histories.groupby(axis, dropna=False):
        yield name, group[group["artefact"] == group.groupby("artefact")["step"].max().idxmax()]


def some(values: Any) -> str:
    """Numbers as an enumeration, in their order; of more than six the middle is left out."""
    texts = [f"{value:g}" for value in np.unique(np.asarray(values, float))]
    return ", ".join(texts if len(texts) <= 6 else [*texts[:5], "…", texts[-1]])
