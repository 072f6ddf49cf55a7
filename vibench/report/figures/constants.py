"""Figures of inf-sup constants over the validation set (paper, Figures 8, 13 and 15)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.interfaces.strategies import Kind
from vibench.report.figures.data import (
    PRIMAL,
    ProblemTables,
    at_best_tolerance,
    by_strategy,
    common_tolerances,
    dimensions,
    one_solver,
    series,
    some,
    titled_parts,
)
from vibench.report.figures.style import (
    HIGH_FIDELITY_LOOK,
    Look,
    Looks,
    Pages,
    Series,
    counted,
    plot,
    positive,
    two_rows,
)
from vibench.stability.infsup import VANISHES


class _Panel(NamedTuple):
    """Content of one panel over the span and of the one below it over the cone."""

    title: str
    strategies: list[tuple[Series, str, pd.DataFrame]]
    reference: pd.DataFrame
    order: pd.Series  # queries along the abscissa


def inf_sup(data: ProblemTables) -> Pages:
    """Inf-sup constants β of every primal strategy and of the high-fidelity pair over the validation set."""
    # Without the other columns: a run may have thousands of pairs, each with a copy of its rows.
    needed = ["pair", "query", "cell", "mu_1", "enrichment_kind", *PRIMAL]
    needed += [name for name in data.queries if name.startswith("beta_")]
    constants = one_solver(data.queries[needed], ["pair"])
    shown, axis = loosest(constants), data.parameter
    for panels, part in data.pages(_panels(data, shown), 6):
        sheet, over, below = two_rows(len(panels), f"{data.problem}, {data.duals[0]}: inf-sup constants")
        looks = Looks(one for panel in panels for one, _, _ in panel.strategies)
        zeros: list[list[str]] = []
        for panel, span, cone in zip(panels, over, below, strict=True):
            reference, both = panel.reference.set_index("query").reindex(panel.order), (span, cone)
            # Without a single parameter the abscissae are places in the order.
            x = reference["mu_1"].to_numpy(float) if axis else np.arange(1, len(reference) + 1)
            _draw_constants(both, x, reference, "beta_hf_", HIGH_FIDELITY_LOOK, "high-fidelity")
            drawn = {
                name: _draw_constants(both, x, rows.set_index("query").reindex(panel.order), "beta_", looks[one], name)
                for one, name, rows in panel.strategies
            }
            zeros.append([name for name, zero in drawn.items() if zero])
            span.set_title(panel.title)
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


def _panels(data: ProblemTables, shown: pd.DataFrame) -> list[_Panel]:
    """A panel for each pair, and several where there are more strategies than a panel takes."""
    panels, by_pair = [], dict(iter(shown.groupby("pair", sort=False)))
    for pair, sizes in data.queries[["pair", "N", "R"]].groupby("pair", sort=False):
        # Without contact, as without generators, a pair has no constants.
        if pair not in by_pair:
            continue
        rows = by_pair[pair]
        fixed = rows[rows["enrichment_kind"] == Kind.FIXED]
        sorting = fixed if len(fixed) else rows
        first = sorting[sorting["cell"] == sorting["cell"].iloc[0]]
        order = first.sort_values("mu_1" if data.parameter else "beta_span", kind="stable")["query"]
        strategies = [
            (series(one["primal"].iloc[0], one["primal_tol"].iloc[0]), name, one) for name, one in by_strategy(rows)
        ]
        groups = titled_parts(dimensions(sizes), strategies, beside_reference=True)
        panels += [_Panel(title, group, strategies[0][2], order) for title, group in groups]
    return panels


def _draw_constants(axes: tuple[Axes, Axes], x: Any, rows: pd.DataFrame, prefix: str, look: Look, name: str) -> bool:
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
