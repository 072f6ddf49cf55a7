"""Figures 8, 13 and 15: inf-sup constants over the validation set; their claims and the figures drawn again."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from vibench.report import HIGH_FIDELITY_LOOK, CaptionedFigure, Look, Looks, Series, Sheet, plot
from vibench_problems.paper.claims import ORDER, Claim, below, holds, judged_figure, same_order, span, text, unknown
from vibench_problems.paper.evidence import VISIBLE, Evidence, for_log_axis
from vibench_problems.paper.published import Pair

OFF, ON, DEC, HF = "beta_", "beta_full_", "beta_plain_", "beta_hf_"
"""Prefixes of the columns of β_off, β_on, β_dec and β_HF.

Queries with PGA have all four: β_dec is the constant of V_N alone, β_on that of the whole of V.
"""

STRATEGIES = {"decorrelated": ("β_dec", DEC), "online-supremizers": ("β_on", ON), "offline-pga": ("β_off", OFF)}
"""Symbol and column of the constant of a strategy."""

SMALL = 0.1
"""What is at most this share of β_HF is very small."""

ZERO = 1e-6
"""What is at most this share of β_HF is almost zero."""


def comparison_claims(evidence: Evidence) -> Iterator[Claim]:
    """Where the constants vanish and how they are ordered, over the span and over the cone."""
    paper, pairs = evidence.paper, evidence.pairs
    place = f"Fig. {paper.figures[3]}"
    for pair in pairs:
        if pair.size[0] < pair.size[1]:
            yield from vanishing(evidence, pair, f"{place}, {paper.section}")
        elif evidence.tables.problem_name == "obstacle":
            yield from almost_vanishing(evidence, pair, f"{place}, {paper.section}")
    if evidence.tables.problem_name == "hertz" and len(pairs) > 1:
        yield unknown(
            place,
            "δ_PGA of (3, 12) and (46, 12)",
            "0.4, 0.5 in the text, 0.5, 0.4 in the captions",
            "0.5, 0.4",
            "The paper contradicts itself.",
        )
    for pair in pairs:
        yield in_order(evidence, pair, place)
    yield no_order(evidence, place)


def vanishing(evidence: Evidence, pair: Pair, place: str) -> Iterator[Claim]:
    """β_dec is zero where N < R: over the span it is, over the cone it need not be."""
    rows, statement = evidence.loose(pair), f"N < R implies β_dec = 0, {pair.name}"
    plain = rows[f"{DEC}span"]
    yield holds(
        place,
        f"{statement}, over the span",
        text(plain.max()),
        plain.max() == 0.0,
        paper="0",
        why=f"(N, R) is {evidence.size(pair)} here.",
    )
    lower, upper = rows[f"{DEC}cone_lower"], rows[f"{DEC}cone_upper"]
    yield holds(
        place,
        f"{statement}, over the cone as in (14)",
        f"{span(lower)}, lower bounds",
        False if lower.max() > 0.0 else True if upper.max() == 0.0 else None,
        paper="0",
        why=f"β_HF over the cone is {span(rows[f'{HF}cone_lower'])}.",
        cause="The statement holds for the span. A cone may have β > 0 in a space with fewer dimensions than it has "
        "generators.",
    )


def almost_vanishing(evidence: Evidence, pair: Pair, place: str) -> Iterator[Claim]:
    """β_dec of the pair of the obstacle with N ≥ R."""
    rows = evidence.loose(pair)
    plain, share = rows[f"{DEC}span"], rows[f"{DEC}span"].max() / rows[f"{HF}span"].min()
    yield holds(
        place,
        f"β_dec over D_valid, {pair.name}, almost zero",
        f"at most {text(share)} of β_HF",
        share <= ZERO,
        why=f"Over the span, where {ZERO:g} of β_HF is almost zero. Over the cone, as in (14), β_dec is "
        f"{span(rows[f'{DEC}cone_lower'])}.",
    )
    yield holds(
        place,
        f"β_dec over D_valid, {pair.name}, order of magnitude",
        span(plain),
        same_order(1e-7, plain),
        paper="1e-7",
        why=f"Over the span, within a factor {ORDER:.2g}.",
        cause="The square root of a smallest eigenvalue is accurate to about 1e-8 of the largest one. Here β is a "
        "smallest singular value.",
    )


def in_order(evidence: Evidence, pair: Pair, place: str) -> Claim:
    """The order of the four constants, over the span and over the cone."""
    rows = evidence.loose(pair)
    pairs = ((DEC, OFF), (OFF, ON), (HF, ON))
    over_span = all(below(rows[f"{one}span"], rows[f"{other}span"]) for one, other in pairs)
    over_cone = all(below(rows[f"{one}cone_lower"], rows[f"{other}cone_upper"]) for one, other in pairs)
    said = [f"at all {len(rows)}" if everywhere else "not at all" for everywhere in (over_span, over_cone)]
    off, on, dec, hf = (span(rows[f"{name}span"]) for name in (OFF, ON, DEC, HF))
    return holds(
        place,
        f"β_on ≥ β_off ≥ β_dec and β_on ≥ β_HF, {pair.name}, δ_PGA = {pair.loose:g}",
        f"over the span {said[0]}, over the cone {said[1]}",
        over_span and over_cone,
        paper="at all µ",
        why=f"Over the span β_on is {on}, β_off {off}, β_dec {dec}, β_HF {hf}; over the cone "
        f"{', '.join(span(rows[f'{name}cone_lower']) for name in (ON, OFF, DEC, HF))}.",
    )


def no_order(evidence: Evidence, place: str) -> Claim:
    """No order between β_off and β_HF, in the panels of the figure: at their tolerances, of all pairs together."""
    panels = [evidence.loose(pair) for pair in evidence.pairs]
    smaller = [int((rows[f"{OFF}span"] < rows[f"{HF}span"]).sum()) for rows in panels]
    count = sum(map(len, panels))
    every = evidence.queries[evidence.queries["enrichment_kind"] == "fixed"]
    share = float((every[f"{OFF}span"] < every[f"{HF}span"]).mean())
    return holds(
        place,
        "no order between β_off and β_HF",
        f"β_off < β_HF in {sum(smaller)} of {count} cases",
        0 < sum(smaller) < count,
        why=f"Over the span, at the δ_PGA of the figure: {text(smaller)} in the panels.",
        cause=f"At all tolerances of the run together it is smaller in {100 * share:.0f} % of {len(every)} cases.",
    )


def comparison(evidence: Evidence) -> CaptionedFigure | None:
    """Figures 8 and 15: β_HF, β_dec, β_on and β_off, over the span and over the cone; a column for every pair."""
    paper, pairs = evidence.paper, evidence.pairs
    if not pairs:
        return None
    title = f"Figure {paper.figures[3]}: inf-sup constants, {paper.heading}"
    sheet, looks = Sheet(2, len(pairs), title, sharex="all", sharey="row"), Looks(map(Series, STRATEGIES))
    for column, pair in enumerate(pairs):
        rows, x, xlabel = evidence.abscissa(evidence.loose(pair))
        for row, (generated, part) in enumerate((("span", "span"), ("cone", "cone_upper"))):
            panel = sheet.panel(row, column)
            _constants(panel, x, rows, part, looks, zeros=row == 0)
            panel.set(ylabel=f"β over {generated}", yscale="log")
            panel.set_xlabel(xlabel)
        sheet.panel(0, column).set_title(f"(N, R) = {evidence.size(pair)}, δ = {pair.loose:g}; paper {pair.name}")
    low, high = sheet.panel(0, 0).get_ylim()
    sheet.panel(0, 0).set_ylim(low * (low / high) ** 0.12, high)  # space for what is zero
    caption = (
        f"Inf-sup constants at the validation parameters, {paper.heading}, over the span of the generators (upper row) "
        "and over their cone (lower row, upper ends of certified intervals): β_HF of the high-fidelity pair, β_dec "
        "without enrichment, β_on with online supremizers, β_off with PGA at the δ_PGA of the pair."
    )
    return judged_figure(sheet, caption, comparison_claims(evidence))


def _constants(panel: Any, x: Any, rows: pd.DataFrame, part: str, looks: Looks, *, zeros: bool) -> None:
    """The four constants in one panel, with a text for those that are zero."""
    plot(panel, x, for_log_axis(rows[f"{HF}{part}"]), HIGH_FIDELITY_LOOK, "β_HF")
    for name, (symbol, prefix) in STRATEGIES.items():
        look: Look = looks[Series(name)]
        values = rows[prefix + part].to_numpy(float)
        wide = {"linewidth": 3.0} if symbol == "β_on" else {}  # another curve may lie upon it
        plot(panel, x, for_log_axis(values), look, symbol, **wide)
        if zeros and values.max() < VISIBLE:
            words = f"{symbol} = 0" if values.max() == 0.0 else f"{symbol} ≤ {values.max():.0e}"
            panel.text(0.02, 0.03, words, transform=panel.transAxes, fontsize=7)


def without_enrichment_claims(evidence: Evidence) -> Iterator[Claim]:
    """Figure 13: β_dec against β_HF, and the order of magnitude of the latter in two normalisations of b."""
    pair = evidence.paper.pairs[-1]
    rows, place = evidence.loose(pair), f"Fig. 13, {evidence.paper.section}"
    plain, reference = rows[f"{DEC}span"], rows[f"{HF}span"]
    share, cone = plain / reference, [span(rows[f"{name}cone_lower"]) for name in (DEC, HF)]
    error = evidence.history("pod").get(evidence.size(pair)[0], np.nan)
    every = evidence.queries[evidence.queries["enrichment_kind"] == "fixed"]
    tolerances = every[(every["pod_tol"] == 1e-3) & (every["dual_tol"] == 1e-2)]
    own = span(tolerances[f"{DEC}span"] / tolerances[f"{HF}span"]) if len(tolerances) else ""
    yield holds(
        place,
        f"β_dec, {pair.name}, is not zero",
        span(plain),
        share.min() > ZERO,
        why=f"Over the span; more than {ZERO:g} of β_HF.",
    )
    yield holds(
        place,
        f"β_dec, {pair.name}, is very small compared with β_HF",
        f"{span(share)} of β_HF",
        share.max() <= SMALL,
        why=f"Over the span; {SMALL:g} counts as very small. Over the cone β_dec is {cone[0]}, β_HF {cone[1]}.",
        cause=f"{pair.size[0]} modes have an error of {error:.1g}, not 1e-3."
        + f" With the dimensions of the tolerances 1e-3 and 1e-2 the share is {own}." * bool(own),
    )
    yield holds(
        place,
        "β_HF is of the order of 8",
        f"{span(reference)} over the span",
        same_order(8.0, reference),
        paper="8",
        why=f"With (51), the norm of L²(Γ̂c1) and ℓ̂ = 1 m; within a factor {ORDER:.2g}. Over the cone it is {cone[1]}.",
        cause="b integrates over macro-edges; with mean values over them it is another one.",
    )
    length = float(evidence.problem.macro_lengths.mean())
    yield holds(
        place,
        "β_HF is of the order of 8, b with mean values over macro-edges",
        f"{span(reference / length)} over the span",
        same_order(8.0, reference / length),
        paper="8",
        why=f"All macro-edges have the length {length:.3g} m; within a factor {ORDER:.2g}.",
    )


def without_enrichment(evidence: Evidence) -> CaptionedFigure | None:
    """Figure 13: β_dec for (46, 12)."""
    paper, pair = evidence.paper, evidence.paper.pairs[-1]
    if pair not in evidence.pairs:
        return None
    rows, x, xlabel = evidence.abscissa(evidence.loose(pair))
    sheet = Sheet(1, 1, f"Figure 13: β_dec, {paper.heading}")
    (panel,) = sheet.panels
    look = Looks([Series("decorrelated")])[Series("decorrelated")]
    plot(panel, x, rows[f"{DEC}span"], look, "β_dec over the span")
    plot(panel, x, rows[f"{HF}span"], HIGH_FIDELITY_LOOK, "β_HF over the span")
    panel.set(xlabel=xlabel, ylabel="β over span", title=f"(N, R) = {evidence.size(pair)}", ylim=(0.0, None))
    caption = (
        "Inf-sup constant β_dec over the span without enrichment at the validation parameters, and β_HF of the "
        f"high-fidelity pair, {paper.heading}, (N, R) = {evidence.size(pair)}."
    )
    return judged_figure(sheet, caption, without_enrichment_claims(evidence))
