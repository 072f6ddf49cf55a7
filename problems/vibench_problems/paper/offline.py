"""Twins of Figures 5 to 7, 11, 12 and 14: projection errors, angles between generators, and PGA."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from vibench.report import CaptionedFigure, Looks, Series, Sheet, plot
from vibench_problems.paper.curves import (
    MODIFIED,
    PLAIN,
    ZERO,
    Curves,
    Fact,
    close,
    compared,
    named,
    positive,
    reached,
    violations,
)
from vibench_problems.paper.published import Published

WITHIN = 0.15
"""Dimensions agree within this relative difference."""

STABLE = 0.1
"""Smallest share of β_on that counts as stable."""

LOOSE = 0.1
"""δ_PGA below this is a tight one."""

PGA = "offline-pga"
POD = Series("POD")
CONES = {PLAIN: "CPG", MODIFIED: "mCPG"}
PAPER: dict[str, Any] = {"color": "black", "marker": "x", "linestyle": "none", "markersize": 6}
"""Crosses at numbers of the paper."""


def projection_errors(curves: Curves, paper: Published) -> CaptionedFigure | None:
    """Figures 5 and 11: relative errors of POD, CPG and mCPG, with the published dimensions as crosses."""
    modes = curves.error("pod")
    cones = {name: found for name in CONES if (found := curves.error("cone", name))}
    if not modes or len(cones) < 2:
        return None
    sheet = Sheet(1, 2, f"Figure {paper.figures[0]}: projection errors, {paper.section}")
    left, right = sheet.panels
    plot(left, list(modes), positive(list(modes.values())), Looks([POD])[POD], "POD")
    looks = Looks(map(Series, cones))
    for name, curve in cones.items():
        plot(right, list(curve), positive(list(curve.values())), looks[Series(name)], CONES[name])
    for panel, points, symbol in ((left, paper.modes, "N"), (right, paper.generators, "R")):
        panel.plot(list(points.values()), list(points), label="paper: size for a tolerance", **PAPER)
        for tolerance, size in points.items():
            sheet.label(panel, size, tolerance, f"{symbol} = {size}")
    left.set(xlabel="number of modes N", ylabel="e_POD(N)", title="POD", yscale="log")
    right.set(xlabel="number of generators R", ylabel="e_CPG(R), e_mCPG(R)", title="CPG and mCPG", yscale="log")
    worse = violations(cones[MODIFIED], cones[PLAIN])
    figure = sheet.finish(
        f"Relative projection errors over the training set, {paper.section}: left, of the POD against the number of "
        "modes; right, of the cones of CPG and mCPG against the number of generators. Crosses are the sizes that the "
        "paper gives for its tolerances."
    )
    figure.published = (
        f"N = {named(list(paper.modes.values()))} for δ_POD = {named([f'{d:g}' for d in paper.modes])}; "
        f"R = {named(list(paper.generators.values()))} for δ_mCPG = {named([f'{d:g}' for d in paper.generators])}. The "
        "errors decrease, and those of mCPG are below those of CPG."
    )
    figure.compared = compared(
        *_sizes("N", "δ_POD", paper.modes, modes),
        *_sizes("R", "δ_mCPG", paper.generators, cones[MODIFIED]),
        (
            not worse,
            f"e_mCPG ≤ e_CPG at all {len(cones[PLAIN])} steps"
            if not worse
            else f"e_mCPG is above e_CPG at {len(worse)} steps, {worse[0]} to {worse[-1]}",
        ),
    )
    return figure


def _sizes(symbol: str, tolerance: str, published: Mapping[float, int], curve: Mapping[int, float]) -> Iterator[Fact]:
    """Whether the sizes for some tolerances are those of the paper."""
    for delta, size in published.items():
        ours = reached(curve, delta)
        text = f"{symbol} = {named([ours])} for {tolerance} = {delta:g}, {size} published"
        yield close([size], [ours], WITHIN), text


def orthogonality(curves: Curves, paper: Published) -> CaptionedFigure | None:
    """Figures 6 and 12: distance of every generator from the cone of those before it."""
    found = {name: curve for name in CONES if (curve := curves.error("cone", name, "e_orth"))}
    if len(found) < 2:
        return None
    sheet = Sheet(1, 1, f"Figure {paper.figures[1]}: e_orth(r), {paper.section}")
    looks = Looks(map(Series, found))
    for name, curve in found.items():
        plot(sheet.panels[0], list(curve), positive(list(curve.values())), looks[Series(name)], CONES[name])
    sheet.panels[0].set(xlabel="r", ylabel="e_orth(r)", yscale="log")
    worse = violations(found[PLAIN], found[MODIFIED])
    largest = max(max(curve.values()) for curve in found.values())
    figure = sheet.finish(
        f"Distance e_orth(r), equation (41), of generator r + 1 of CPG and of mCPG from the cone of the r generators "
        f"before it, {paper.section}."
    )
    figure.published = "e_orth(r) ≤ 1, and e_orth(r) of CPG is at most that of mCPG for all r."
    figure.compared = compared(
        (largest <= 1.0 + 1e-9, f"e_orth is at most {largest:.4g}"),
        (
            not worse,
            f"CPG is at most mCPG at all {min(map(len, found.values()))} r"
            if not worse
            else f"CPG is above mCPG at r = {named(worse)}",
        ),
        (
            None,
            f"the smallest values, {min(found[PLAIN].values()):.2g} of CPG and {min(found[MODIFIED].values()):.2g} of "
            "mCPG",
        ),
    )
    return figure


def greedy(curves: Curves, paper: Published, parameter: str) -> CaptionedFigure | None:
    """Figures 7 and 14: σ, min β over the training set, and β_off over the validation set; a row for every pair."""
    pairs = [pair for pair in paper.pairs if curves.has(pair)]
    if not pairs:
        return None
    sheet = Sheet(len(pairs), 3, f"Figure {paper.figures[2]}: PGA, {paper.section}", sharey="col")
    looks = Looks(Series(PGA, delta) for pair in pairs for delta in (pair.tight, pair.loose))
    shares, vectors, least = [], [], []
    for row, pair in enumerate(pairs):
        sigma, beta = (curves.growth(pair, name, pair.tight) for name in ("sigma", "beta_span_min"))
        title = f"(N, R) = {curves.size(pair)}, paper {pair.name}"
        for column, (curve, ylabel) in enumerate(((sigma, "σ(µₙ)"), (beta, "min β over D_train"))):
            panel = sheet.at(row, column)
            look = looks[Series(PGA, pair.tight)]
            plot(panel, list(curve), positive(list(curve.values())), look, f"{PGA}, δ = {pair.tight:g}")
            panel.set(xlabel="vectors n", ylabel=ylabel, title=title, yscale="log")
        panel = sheet.at(row, 2)
        for delta in (pair.tight, pair.loose):
            off = curves.constants(pair, "fixed", delta)
            ordered = off.sort_values("mu_1" if parameter else "beta_span")
            x = ordered["mu_1"] if parameter else np.arange(1, len(ordered) + 1)
            plot(panel, x, ordered["beta_span"], looks[Series(PGA, delta)], f"{PGA}, δ = {delta:g}")
            shares.append(float((off["beta_span"] / off["beta_full_span"]).min()))
        xlabel = parameter or "validation parameters, sorted by β_off"
        panel.set(xlabel=xlabel, ylabel="β_off over D_valid", title=title)
        vectors.append(reached(sigma, pair.tight))
        least.append((beta[0], beta[max(beta)]))
    sheet.at(0, 2).set_ylim(0, None)
    figure = sheet.finish(
        f"The projected greedy algorithm, {paper.section}, a row for every pair (N, R). Left, the largest σ over the "
        "training set against the number n of vectors; middle, the smallest β over the span on the training set; both "
        f"for δ_PGA = {paper.pairs[0].tight:g}. Right, β_off over the span at the validation parameters, for this and "
        "the looser δ_PGA of the pair. On logarithmic axes, zeros are not drawn."
    )
    loose = ", ".join(f"{pair.loose:g} for {pair.name}" for pair in paper.pairs)
    figure.published = (
        f"δ_PGA = {paper.pairs[0].tight:g} and, on the right, {loose}. PGA converges, min β recovers, and β_off is "
        f"stable; {paper.convergence}."
    )
    tight, sizes = paper.pairs[0].tight, [curves.size(pair)[1] for pair in pairs]
    growth = ", ".join(f"{first:.2g} → {last:.3g}" for first, last in least)
    figure.compared = compared(
        (
            None not in vectors,
            f"σ stays above {tight:g}"
            if None in vectors
            else f"σ reaches {tight:g} with {named(vectors)} vectors, R being {named(sizes)}",
        ),
        (all(last > max(first, ZERO) for first, last in least), f"min β over D_train recovers: {growth}"),
        (
            min(shares) >= STABLE,
            f"β_off is at least {min(shares):.3g} of β_on at every parameter of D_valid and every δ",
        ),
        _convergence(tight, vectors, sizes),
    )
    return figure


def _convergence(tight: float, vectors: Sequence[int | None], sizes: Sequence[int]) -> Fact:
    """How many vectors PGA needs for each generator, against what the paper says of the two problems."""
    ratios = [0.0 if count is None else count / size for count, size in zip(vectors, sizes, strict=True)]
    text = f"{named([f'{ratio:.2g}' for ratio in ratios])} vectors for each generator"
    if tight < LOOSE:  # the obstacle
        return max(ratios) <= 1.0, f"at most R vectors: {text}"
    return min(ratios) > 1.0, f"σ decreases slowly, over {text}; of the obstacle at most one"
