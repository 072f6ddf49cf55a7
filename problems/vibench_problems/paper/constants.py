"""Twins of Figures 8, 13 and 15: inf-sup constants over the validation set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from vibench.report import HIGH_FIDELITY_LOOK, CaptionedFigure, Look, Looks, Series, Sheet, plot
from vibench_problems.paper.curves import ZERO, Curves, Fact, below, compared, positive, span
from vibench_problems.paper.published import Pair, Published

STRATEGIES = {"decorrelated": "β_dec", "online-supremizers": "β_on", "offline-pga": "β_off"}
COLUMNS = {"decorrelated": "beta_plain_", "online-supremizers": "beta_full_", "offline-pga": "beta_"}
"""Columns of a query of the fixed enrichment with the three constants: an enrichment per parameter reaches all of V."""

SMALL = 0.1
"""Share of β_HF that counts as very small."""


def comparison(curves: Curves, paper: Published, parameter: str) -> CaptionedFigure | None:
    """Figures 8 and 15: β_HF, β_dec, β_on and β_off, over the span and over the cone; a column for every pair."""
    pairs = [pair for pair in paper.pairs if curves.has(pair)]
    if not pairs:
        return None
    sheet = Sheet(
        2, len(pairs), f"Figure {paper.figures[3]}: inf-sup constants, {paper.section}", sharex="all", sharey="row"
    )
    looks = Looks(map(Series, STRATEGIES))
    for column, pair in enumerate(pairs):
        rows = _ordered(curves, pair, parameter)
        x = rows["mu_1"].to_numpy(float) if parameter else np.arange(1, len(rows) + 1)
        for row, (generated, part) in enumerate((("span", "span"), ("cone", "cone_upper"))):
            panel = sheet.at(row, column)
            plot(panel, x, positive(rows[f"beta_hf_{part}"]), HIGH_FIDELITY_LOOK, "β_HF")
            for name, symbol in STRATEGIES.items():
                look: Look = looks[Series(name)]
                values = rows[COLUMNS[name] + part].to_numpy(float)
                wide = {"linewidth": 3.0} if symbol == "β_on" else {}  # another curve may lie upon it
                plot(panel, x, positive(values), look, symbol, **wide)
                if row == 0 and values.max() < ZERO:
                    text = f"{symbol} = 0" if values.max() == 0.0 else f"{symbol} ≤ {values.max():.0e}"
                    panel.text(0.02, 0.03, text, transform=panel.transAxes, fontsize=7)
            panel.set(ylabel=f"β over {generated}", yscale="log")
            panel.set_xlabel(parameter or "validation parameters, sorted by β_off")
        sheet.at(0, column).set_title(f"(N, R) = {curves.size(pair)}, δ = {pair.loose:g}; paper {pair.name}")
    low, high = sheet.at(0, 0).get_ylim()
    sheet.at(0, 0).set_ylim(low * (low / high) ** 0.12, high)  # room for what is zero
    figure = sheet.finish(
        f"Inf-sup constants at the validation parameters, {paper.section}, over the span of the generators (upper row) "
        "and over their cone (lower row, upper ends of certified intervals): β_HF of the high-fidelity pair, β_dec "
        "without enrichment, β_on with online supremizers, β_off with PGA at the δ_PGA of the pair."
    )
    figure.published = (
        f"δ_PGA = {', '.join(f'{pair.loose:g} for {pair.name}' for pair in paper.pairs)}. β_on ≥ β_off ≥ β_dec and "
        "β_on ≥ β_HF at all parameters, no order between β_off and β_HF; β_dec = 0 where N < R"
        f"{', and of the order of 1e-7 for (89, 50)' * (paper.figures[3] == 8)}."
    )
    figure.compared = compared(*_facts(curves, pairs, parameter))
    return figure


def without_enrichment(curves: Curves, paper: Published, parameter: str) -> CaptionedFigure | None:
    """Figure 13: β_dec for (46, 12)."""
    pair = paper.pairs[-1]
    if not curves.has(pair):
        return None
    rows = _ordered(curves, pair, parameter)
    sheet = Sheet(1, 1, f"Figure 13: β_dec, {paper.section}")
    (panel,) = sheet.panels
    look = Looks([Series("decorrelated")])[Series("decorrelated")]
    plot(panel, rows["mu_1"], rows["beta_plain_span"], look, "β_dec over the span")
    plot(panel, rows["mu_1"], rows["beta_hf_span"], HIGH_FIDELITY_LOOK, "β_HF over the span")
    panel.set(xlabel=parameter, ylabel="β over span", title=f"(N, R) = {curves.size(pair)}", ylim=(0.0, None))
    plain, reference = rows["beta_plain_span"], rows["beta_hf_span"]
    share = plain / reference
    figure = sheet.finish(
        "Inf-sup constant β_dec over the span without enrichment at the validation parameters, and β_HF of the "
        f"high-fidelity pair, {paper.section}, (N, R) = {curves.size(pair)}."
    )
    figure.published = "β_dec is not zero and very small compared with β_HF, which is of the order of 8."
    figure.compared = compared(
        (bool(plain.min() > ZERO), f"β_dec over the span is {span(plain)}"),
        (bool(share.max() <= SMALL), f"it is {span(share)} of β_HF"),
        (
            8.0 / np.sqrt(10.0) <= reference.min() <= reference.max() <= 8.0 * np.sqrt(10.0),
            f"β_HF is {span(reference)} in the norms of V and L², where it depends on the norms and on the mesh",
        ),
    )
    return figure


def _ordered(curves: Curves, pair: Pair, parameter: str) -> pd.DataFrame:
    """The queries of the fixed enrichment at the looser tolerance, which have all four constants, in their order."""
    return curves.constants(pair, "fixed", pair.loose).sort_values("mu_1" if parameter else "beta_span")


def _facts(curves: Curves, pairs: Sequence[Pair], parameter: str) -> Iterator[Fact]:
    """Whether the constants are ordered as the paper says, and vanish where it says so, over the span and the cone."""
    rows = {pair.name: _ordered(curves, pair, parameter) for pair in pairs}
    every = pd.concat(list(rows.values()))
    over_span = all(below(every[f"{a}span"], every[f"{b}span"]) for a, b in ORDERED)
    over_cone = all(below(every[f"{a}cone_lower"], every[f"{b}cone_upper"]) for a, b in ORDERED)
    where = "hold" if over_span and over_cone else "do not hold"
    yield (
        over_span and over_cone,
        f"the inequalities {where} at all {len(every)} points, over the span and over the cone",
    )
    small = [pair for pair in pairs if pair.size[0] < pair.size[1]]
    if small:
        names = ", ".join(pair.name for pair in small)
        plain = pd.concat([rows[pair.name] for pair in small])
        yield plain["beta_plain_span"].max() < ZERO, f"β_dec = 0 over the span for {names}"
        cone = plain["beta_plain_cone_lower"]
        yield cone.max() <= ZERO, f"over the cone, the infimum of equation (14), β_dec is {span(cone)} there"
    for pair in (pair for pair in pairs if pair not in small):
        plain_span = rows[pair.name]["beta_plain_span"]
        if plain_span.max() < ALMOST:
            yield True, f"β_dec over the span is almost zero for {pair.name}, at most {plain_span.max():.1g}"
    smaller = int((every["beta_span"] < every["beta_hf_span"]).sum())
    unordered = 0 < smaller < len(every)
    yield unordered or None, f"β_off is below β_HF over the span in {smaller} of {len(every)} cases"


ALMOST = 1e-6
"""Inf-sup constants below this are almost zero: the paper has 1e-7 for (89, 50)."""

ORDERED = (("beta_plain_", "beta_"), ("beta_", "beta_full_"), ("beta_hf_", "beta_full_"))
"""Prefixes of the columns of two constants, the smaller one first."""
