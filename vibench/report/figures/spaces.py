"""The reduced spaces: their convergence (paper, Figures 5, 7, 11 and 14), and their inf-sup constants in a panel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from vibench.interfaces.strategies import Kind
from vibench.report.figures import style
from vibench.report.figures.data import ProblemTables, by_strategy, dimensions, leading
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
    duals = [(str(dual), rows) for dual, rows in steps.groupby("dual")]
    groups = [duals[k : k + 4] for k in range(0, len(duals), 4)]
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


def draw_stability(panel: Axes, data: ProblemTables, best: Row, names: Sequence[str], looks: Looks) -> str:
    """Draw β over the span at the pair of a cell, of the high-fidelity model and of some strategies.

    Returns what the panel shows, a sentence; "" where there are no constants.
    """
    mine = data.queries[(data.queries["dual"] == best["dual"]) & (data.queries["pair"] == best["pair"])]
    # Inf-sup constants depend on no solver, assembly or correction.
    rows = mine.drop_duplicates(["primal", "primal_tol", "query"])
    rows = loosest(rows[rows["primal"].isin(names) & rows["beta_hf_span"].notna()])
    strategies = list(by_strategy(rows))
    if not strategies:
        return ""
    axis = data.parameter
    first = next((of for _, _, of in strategies if (of["enrichment_kind"] == Kind.FIXED).any()), strategies[0][2])
    reference = first.sort_values("mu_1" if axis else "beta_span", kind="stable").set_index("query")
    # Without a single parameter the abscissae are places in the order.
    x = reference["mu_1"].to_numpy(float) if axis else np.arange(1, len(reference) + 1)
    plot(panel, x, positive(reference["beta_hf_span"], VANISHES), style.HIGH_FIDELITY_LOOK, "high-fidelity")
    zeros = []
    for _, key, of in strategies:
        span = of.set_index("query")["beta_span"].reindex(reference.index)
        plot(panel, x, positive(span, VANISHES), looks[Series(key.name)], key.name)
        zeros += [f"β = 0: {key.name}"] * bool(span.max() < VANISHES)
    panel.set(ylabel="β over span", yscale="log", xlabel=axis or "validation parameters, sorted")
    if not axis:
        counted(panel)
    # Below the curves stands what a logarithmic axis cannot show.
    low, high = panel.get_ylim()
    panel.set_ylim(low * (low / high) ** (0.1 * len(zeros)), high)
    panel.text(0.02, 0.03, "\n".join(zeros), transform=panel.transAxes, fontsize=7)
    return (
        f"Upper right, inf-sup constants over the span of the {dimensions(mine)} pair of {best['dual']} at the "
        "validation parameters; an answer for λ is stable where the constant is near that of the full model."
    )


def loosest(constants: pd.DataFrame) -> pd.DataFrame:
    """The rows of fixed enrichments at the tolerance of the smallest mean β, and those of all other strategies."""
    fixed = constants["enrichment_kind"] == Kind.FIXED
    means = constants[fixed].groupby(["primal", "primal_tol"])["beta_span"].mean().reset_index()
    smallest = means.groupby("primal")["beta_span"].transform("min")
    # The largest tolerance of means equal up to 1e-6: figures do not depend on the last digits of a run.
    near = means[means["beta_span"] <= smallest * (1.0 + 1e-6)]
    tolerances = near.groupby("primal")["primal_tol"].max()
    of_loosest = constants["primal_tol"] == constants["primal"].map(tolerances)
    return constants[~fixed | of_loosest | constants["primal_tol"].isna()]


def longest(histories: pd.DataFrame, axis: str = "dual") -> Iterator[tuple[Any, pd.DataFrame]]:
    """The longest history for each dual strategy, or on another axis."""
    # It contains the others: bases are nested, so that a looser tolerance stops at an earlier step.
    for name, group in histories.groupby(axis, dropna=False):
        yield name, group[group["artefact"] == group.groupby("artefact")["step"].max().idxmax()]
