"""Figures 5 to 7, 11, 12 and 14: projection errors, angles between generators, PGA; claims, and the figures again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from vibench import Stop, project_on_cone
from vibench.report import CaptionedFigure, Looks, Series, Sheet, plot
from vibench_problems.obstacle import Obstacle
from vibench_problems.paper.claims import DIMENSION, Claim, holds, judged_figure, number, ordered, span, text
from vibench_problems.paper.evidence import (
    MODIFIED,
    PLAIN,
    Evidence,
    History,
    for_log_axis,
    last,
    reached,
    reduction_of,
    stopped,
)
from vibench_problems.paper.published import OBSTACLE

STABLE = 0.1
"""Smallest share of β_on that counts as stable."""

PGA = "offline-pga"
POD = Series("POD")
CONES = {PLAIN: "CPG", MODIFIED: "mCPG"}
CROSSES: dict[str, Any] = {"color": "black", "marker": "x", "linestyle": "none", "markersize": 6}
"""Look of numbers of the paper."""

CAUSES = {
    "obstacle": {
        "N": "û = u∘h(µ) depends on the map h outside ω̂, and the POD on the norm of V; neither is published.",
        "R": "The snapshots depend on the mesh of ω̂, which is not published.",
    },
    "hertz": dict.fromkeys(
        "NR",
        "The dimensions follow the oscillations of λ, and these the quadrature of the contact and the master mesh; "
        "neither is published.",
    ),
}
"""Causes of other dimensions."""

OTHER_CONES = (
    "For the same snapshots the cone of mCPG contains that of CPG (Remark 4.1), but the two algorithms select "
    "different ones after the first steps."
)
OTHER_GENERATORS = (
    "After the first steps the two algorithms select different snapshots; nothing implies an order of these."
)
"""Causes of violations of the inequalities between the two greedy algorithms."""


def projection_error_claims(evidence: Evidence) -> Iterator[Claim]:
    """Errors of POD and cones decrease, reach the tolerances at the published sizes, and are smaller for mCPG."""
    paper, causes = evidence.paper, CAUSES[evidence.tables.problem_name]
    modes = evidence.history("pod")
    plain, modified = (evidence.history("cone", dual=dual) for dual in (PLAIN, MODIFIED))
    place = f"Fig. {paper.figures[0]}"
    for side, symbol, tolerance, sizes, errors in (
        ("left", "N", "δ_POD", paper.modes, modes),
        ("right", "R", "δ_mCPG", paper.generators, modified),
    ):
        for delta, size in sizes.items():
            statement, ours = f"{symbol} for {tolerance} = {delta:g}", reached(errors, delta)
            where, cause = f"{place} {side}, {paper.section}", causes[symbol]
            yield number(where, statement, size, ours, within=DIMENSION, cause=cause)
        at_sizes = [errors.get(size, np.nan) for size in sizes.values()]
        small = all(error <= delta for error, delta in zip(at_sizes, sizes, strict=True))
        yield holds(
            f"{place} {side}",
            f"error at {symbol} = {text(list(sizes.values()))}",
            text(at_sizes),
            small if np.all(np.isfinite(at_sizes)) else None,
            paper=f"at most {text(list(sizes))}",
            why="The tolerances of the published dimensions.",
            cause="The dimensions for these tolerances are in the rows above.",
        )
    monotone = all(map(_decreasing, (modes, plain, modified)))
    course = "monotone" if monotone else "not monotone"
    yield holds(place, "errors of POD, CPG and mCPG decrease", course, monotone, why="At every step.")
    yield ordered(f"{place} right", "e_mCPG(r) ≤ e_CPG(r)", modified, plain, cause=OTHER_CONES)


def _decreasing(curve: History) -> bool:
    return all(later <= earlier * (1.0 + 1e-9) + 1e-15 for earlier, later in pairwise(curve.values()))


def projection_errors(evidence: Evidence) -> CaptionedFigure | None:
    """Figures 5 and 11: relative errors of POD, CPG and mCPG, with the published dimensions as crosses."""
    paper, modes = evidence.paper, evidence.history("pod")
    cones = {name: errors for name in CONES if (errors := evidence.history("cone", dual=name))}
    if not modes or len(cones) < 2:
        return None
    sheet = Sheet(1, 2, f"Figure {paper.figures[0]}: projection errors, {paper.heading}")
    left, right = sheet.panels
    plot(left, list(modes), for_log_axis(list(modes.values())), Looks([POD])[POD], "POD")
    looks = Looks(map(Series, cones))
    for name, curve in cones.items():
        plot(right, list(curve), for_log_axis(list(curve.values())), looks[Series(name)], CONES[name])
    panels: tuple[tuple[Any, Mapping[float, int], str], ...] = (
        (left, paper.modes, "N"),
        (right, paper.generators, "R"),
    )
    for panel, points, symbol in panels:
        panel.plot(list(points.values()), list(points), label="paper: size for a tolerance", **CROSSES)
        for tolerance, size in points.items():
            panel.annotate(f"{symbol} = {size}", (size, tolerance), (3, 3), textcoords="offset points", fontsize=6)
    left.set(xlabel="number of modes N", ylabel="e_POD(N)", title="POD", yscale="log")
    right.set(xlabel="number of generators R", ylabel="e_CPG(R), e_mCPG(R)", title="CPG and mCPG", yscale="log")
    caption = (
        f"Relative projection errors over the training set, {paper.heading}: left, of the POD against the number of "
        "modes; right, of the cones of CPG and mCPG against the number of generators. Crosses are the sizes that the "
        "paper gives for its tolerances."
    )
    return judged_figure(sheet, caption, projection_error_claims(evidence))


def without_symmetry() -> Iterator[Claim]:
    """Cones of the obstacle on a mesh on which no snapshots are mirror images of others."""
    problem = Obstacle(asymmetric=True)
    reduction, W = reduction_of(problem), problem.W
    why = "On a mesh whose nodes are displaced at random, where no two snapshots are equally far from a cone."
    for delta, size in OBSTACLE.generators.items():
        statement, ours = f"R for δ_mCPG = {delta:g}, without symmetry", stopped(reduction, Stop(tolerance=delta)).size
        yield number("Fig. 5 right, §5.1", statement, size, ours, within=DIMENSION, why=why)
    plain, modified = (stopped(reduction, Stop(tolerance=1e-3), dual) for dual in (PLAIN, MODIFIED))
    larger, smaller = (dict(enumerate(map(float, cone.errors))) for cone in (plain, modified))
    yield ordered("Fig. 5 right", "e_mCPG(r) ≤ e_CPG(r), without symmetry", smaller, larger, why, OTHER_CONES)
    smaller, larger = (
        {r: project_on_cone(chi[:, :r], chi[:, r], W).distance for r in range(chi.shape[1])}
        for chi in (plain.generators, modified.generators)
    )
    statement = "e_orth(r) of CPG ≤ that of mCPG, without symmetry"
    yield ordered("Fig. 6", statement, smaller, larger, why, OTHER_GENERATORS)


def orthogonality_claims(evidence: Evidence) -> Iterator[Claim]:
    """The generators of mCPG are farther from the cone before them; e_orth is at most 1."""
    plain, modified = (evidence.history("cone", "e_orth", dual) for dual in (PLAIN, MODIFIED))
    place = f"Fig. {evidence.paper.figures[1]}"
    yield ordered(place, "e_orth(r) of CPG ≤ that of mCPG", plain, modified, cause=OTHER_GENERATORS)
    largest = max(*plain.values(), *modified.values())
    why = f"The smallest are {min(plain.values()):.2g} for CPG and {min(modified.values()):.2g} for mCPG."
    yield holds(f"{place}, (41)", "e_orth(r) ≤ 1", f"at most {largest:.3g}", largest <= 1.0 + 1e-9, why=why)


def orthogonality(evidence: Evidence) -> CaptionedFigure | None:
    """Figures 6 and 12: distance of every generator from the cone of those before it."""
    paper = evidence.paper
    curves = {name: curve for name in CONES if (curve := evidence.history("cone", "e_orth", name))}
    if len(curves) < 2:
        return None
    sheet = Sheet(1, 1, f"Figure {paper.figures[1]}: e_orth(r), {paper.heading}")
    looks = Looks(map(Series, curves))
    for name, curve in curves.items():
        plot(sheet.panels[0], list(curve), for_log_axis(list(curve.values())), looks[Series(name)], CONES[name])
    sheet.panels[0].set(xlabel="r", ylabel="e_orth(r)", yscale="log")
    caption = (
        "Distance e_orth(r), equation (41), of generator r + 1 of CPG and of mCPG from the cone of the r generators "
        f"before it, {paper.heading}."
    )
    return judged_figure(sheet, caption, orthogonality_claims(evidence))


def greedy_claims(evidence: Evidence) -> Iterator[Claim]:
    """PGA converges, fast for the obstacle and slowly for Hertz contact, and makes the pair of spaces stable."""
    paper, pairs = evidence.paper, evidence.pairs
    place = f"Fig. {paper.figures[2]}"
    sigma, beta, share = (
        [evidence.growth(pair, name) for pair in pairs] for name in ("sigma", "beta_span_min", "share_min")
    )
    added, sizes = [max(curve) for curve in sigma], [evidence.size(pair)[1] for pair in pairs]
    ends = [last(curve) for curve in sigma]
    ours = f"σ = {text(ends)} with {text(added)} vectors"
    yield holds(f"{place} left", f"PGA converges to δ_PGA = {paper.tight:g}", ours, max(ends) <= paper.tight)
    if evidence.tables.problem_name == "obstacle":
        yield holds(
            f"{place} left, {paper.section}",
            f"PGA reaches δ_PGA = {paper.tight:g} in at most R iterations",
            f"{text(added)} for R = {text(sizes)}",
            max(ends) <= paper.tight and all(k <= size for k, size in zip(added, sizes, strict=True)),
            paper=f"R = {text([pair.size[1] for pair in pairs])}",
            why="All µ share one S_R, of dimension R.",
        )
    else:
        ratios = [k / size for k, size in zip(added, sizes, strict=True)]
        yield holds(
            f"{place} left, {paper.section}",
            "σ decreases much more slowly than for the obstacle",
            f"{text(ratios)} vectors per generator for {paper.tight:g}",
            min(ratios) > 1.0,
            why="For the obstacle, at most one per generator for 0.001.",
        )
    yield holds(
        f"{place} middle",
        "min β over D_train recovers as vectors are added",
        ", ".join(f"{curve[0]:.2g} → {last(curve):.3g}" for curve in beta),
        all(last(curve) > curve[0] for curve in beta) and min(map(last, share)) >= STABLE,
        why=f"Over the span, from none to all vectors: it grows, to at least {STABLE:g} of β_on at every parameter.",
    )
    for pair in pairs:
        for delta in (paper.tight, pair.loose):
            rows = evidence.constants(pair, "fixed", delta)
            shares = rows["beta_span"] / rows["beta_full_span"]
            yield holds(
                f"{place} right",
                f"β_off over D_valid, {pair.name}, δ_PGA = {delta:g}",
                f"{span(rows['beta_span'])}, at least {shares.min():.4g} of β_on",
                shares.min() >= STABLE,
                paper="stable",
                why=f"Over the span; {STABLE:g} of β_on counts as stable. {_added(evidence, rows)} vectors; σ ≤ δ_PGA "
                f"guarantees the share {np.sqrt(1.0 - delta**2):.3g} over D_train.",
            )


def _added(evidence: Evidence, rows: Any) -> str:
    cells = evidence.cells.set_index("cell")
    return f"{cells.loc[rows['cell'].iloc[0], 'enrichment']:.0f}"


def greedy(evidence: Evidence) -> CaptionedFigure | None:
    """Figures 7 and 14: σ, min β over the training set, and β_off over the validation set; a row for every pair."""
    paper, pairs = evidence.paper, evidence.pairs
    if not pairs:
        return None
    sheet = Sheet(len(pairs), 3, f"Figure {paper.figures[2]}: PGA, {paper.heading}", sharey="col")
    looks = Looks(Series(PGA, delta) for pair in pairs for delta in (paper.tight, pair.loose))
    for row, pair in enumerate(pairs):
        title = f"(N, R) = {evidence.size(pair)}, paper {pair.name}"
        for column, (quantity, ylabel) in enumerate((("sigma", "σ(µₙ)"), ("beta_span_min", "min β over D_train"))):
            panel, curve = sheet.panel(row, column), evidence.growth(pair, quantity)
            look = looks[Series(PGA, paper.tight)]
            plot(panel, list(curve), for_log_axis(list(curve.values())), look, f"{PGA}, δ = {paper.tight:g}")
            panel.set(xlabel="vectors n", ylabel=ylabel, title=title, yscale="log")
        panel = sheet.panel(row, 2)
        for delta in (paper.tight, pair.loose):
            rows, x, xlabel = evidence.abscissa(evidence.constants(pair, "fixed", delta))
            plot(panel, x, rows["beta_span"], looks[Series(PGA, delta)], f"{PGA}, δ = {delta:g}")
            panel.set(xlabel=xlabel, ylabel="β_off over D_valid", title=title)
    sheet.panel(0, 2).set_ylim(0, None)
    caption = (
        f"The projected greedy algorithm, {paper.heading}, a row for every pair (N, R). Left, the largest σ over the "
        "training set against the number n of vectors; middle, the smallest β over the span on the training set; both "
        f"for δ_PGA = {paper.tight:g}. Right, β_off over the span at the validation parameters, for this and the "
        "looser δ_PGA of the pair. On logarithmic axes, zeros are not drawn."
    )
    return judged_figure(sheet, caption, greedy_claims(evidence))
