"""Claims that the paper makes for both problems: projection errors, orthogonality, inf-sup constants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from claims.runs import Pair, Run
from claims.verdicts import Claim, below, exceptions, holds, ranges, span, text

POSITIVE = 0.1
"""Smallest share of β_on that is stable."""

CONES = (
    "For the same snapshots the cone of mCPG contains that of CPG (Remark 4.1), but the two algorithms select "
    "different ones after the first steps."
)
GENERATORS = "After the first steps the two algorithms select different snapshots; nothing implies an order of these."
"""Causes of violations of the inequalities between the two greedy algorithms."""


def projection_errors(run: Run, pairs: Sequence[Pair], figure: str) -> Iterator[Claim]:
    """Errors of POD and cones decrease, reach the tolerances at the published sizes, and are smaller for mCPG."""
    plain, modified = run.curve("cone", "error", "cpg"), run.curve("cone", "error", "mcpg")
    modes = run.curve("pod", "error")
    decreasing = all(map(_decreasing, (modes, plain, modified)))
    yield holds(
        f"{figure}: errors of POD, CPG and mCPG decrease",
        "yes",
        "monotone" if decreasing else "not monotone",
        decreasing,
        why="At every step.",
    )
    for k, (name, curve, tolerances) in enumerate(
        (("left: e_POD", modes, POD_TOLERANCES), ("right: e_mCPG", modified, CONE_TOLERANCES))
    ):
        wanted = sorted({pair.paper.size[k]: tolerances[run.study][i] for i, pair in enumerate(pairs)}.items())
        found = [curve.get(size, np.nan) for size, _ in wanted]
        limits = [limit for _, limit in wanted]
        yield holds(
            f"{figure} {name} at {text([size for size, _ in wanted])}",
            f"at most {text(limits)}",
            text(found),
            all(error <= limit for error, limit in zip(found, limits, strict=True)),
            why="The tolerances of the published dimensions.",
            cause="The dimensions for these tolerances are in the rows above.",
        )
    yield comparison(f"{figure} right: e_mCPG(r) ≤ e_CPG(r)", modified, plain, CONES)


POD_TOLERANCES = {"paper-obstacle": (1e-3, 1e-4, 1e-6), "paper-hertz": (1e-2, 1e-3, 1e-3)}
CONE_TOLERANCES = {"paper-obstacle": (1e-2, 1e-3, 1e-2), "paper-hertz": (1e-2, 1e-3, 1e-2)}
"""Tolerances from which the paper gets the dimensions of the columns of its tables."""


def orthogonality(run: Run, figure: str) -> Iterator[Claim]:
    """The generators of mCPG are farther from the cone before them; e_orth is at most 1."""
    plain, modified = run.curve("cone", "e_orth", "cpg"), run.curve("cone", "e_orth", "mcpg")
    yield comparison(f"{figure}: e_orth(r) of CPG ≤ that of mCPG", plain, modified, GENERATORS)
    largest = max(*plain.values(), *modified.values())
    yield holds(
        f"{figure}, (41): e_orth(r) ≤ 1",
        "yes",
        f"at most {largest:.3g}",
        largest <= 1.0 + 1e-9,
        why=f"The smallest are {min(plain.values()):.2g} for CPG and {min(modified.values()):.2g} for mCPG.",
    )


def comparison(
    claim: str, smaller: Mapping[int, float], larger: Mapping[int, float], cause: str, why: str = ""
) -> Claim:
    """A claim that one history lies below another."""
    bad = exceptions(smaller, larger)
    common = smaller.keys() & larger.keys()
    worst = max((smaller[k] / larger[k] for k in bad), default=1.0)
    return holds(
        claim,
        "for all r",
        f"fails at r = {ranges(bad)} of {len(common)}, by a factor up to {worst:.3g}" if bad else f"at {len(common)} r",
        not bad,
        why=why,
        cause=cause,
    )


def vanishing(run: Run, pairs: Sequence[Pair], place: str) -> Iterator[Claim]:
    """β_dec is zero where N < R: over the span it is, over the cone it need not be."""
    for pair in pairs:
        name = f"{place}: N < R implies β_dec = 0, {pair.name}"
        found = run.constants(pair.plain, "beta_plain_span")
        yield holds(
            f"{name}, over the span", "0", text(found.max()), found.max() == 0.0, why=f"(N, R) is {pair.ours} here."
        )
        lower, reference = (run.constants(pair.plain, f"beta_{which}cone_lower") for which in ("plain_", "hf_"))
        yield holds(
            f"{name}, over the cone as in (14)",
            "0",
            f"{span(lower)}, lower bounds",
            lower.max() == 0.0,
            why=f"β_HF over the cone is {span(reference)}.",
            cause="The statement holds for the span. A cone may have β > 0 in a space with fewer dimensions than "
            "it has generators.",
        )


def stability(run: Run, pairs: Sequence[Pair], figure: str) -> Iterator[Claim]:
    """β_off over the validation set, at the tight and at the looser tolerance."""
    for pair in pairs:
        for cell in (pair.offline, pair.loose):
            off, on = run.constants(cell, "beta_span"), run.constants(cell, "beta_full_span")
            yield holds(
                f"{figure}: β_off over D_valid, {pair.name}, δ_PGA = {cell['primal_tol']:g}",
                "stable",
                f"{span(off)}; share of β_on at least {np.min(off / on):.4g}",
                np.min(off / on) >= POSITIVE,
                why=f"Over the span; {cell['enrichment']:.0f} vectors. σ ≤ δ_PGA guarantees the share "
                f"{np.sqrt(1.0 - cell['primal_tol'] ** 2):.3g} over D_train.",
            )


def ordering(run: Run, pairs: Sequence[Pair], figure: str) -> Iterator[Claim]:
    """The order of the four constants, over the span and over the cone."""
    for pair in pairs:
        cell = pair.loose
        off, on, plain, reference = (run.constants(cell, f"beta_{name}span") for name in PAIRS)
        ordered = below(plain, off) and below(off, on) and below(reference, on)
        lower, upper = ([run.constants(cell, f"beta_{name}cone_{end}") for name in PAIRS] for end in ("lower", "upper"))
        conic = all(below(lower[small], upper[large]) for small, large in ((2, 0), (0, 1), (3, 1)))
        yield holds(
            f"{figure}: β_on ≥ β_off ≥ β_dec and β_on ≥ β_HF, {pair.name}, δ_PGA = {cell['primal_tol']:g}",
            "at all µ",
            f"over the span {_where(ordered, on)}, over the cone {_where(conic, on)}",
            ordered and conic,
            why=f"Over the span β_on is {span(on)}, β_off {span(off)}, β_dec {span(plain)}, β_HF {span(reference)}; "
            f"over the cone {span(lower[1])}, {span(lower[0])}, {span(lower[2])}, {span(lower[3])}.",
        )
    off, reference = (run.constants_by_cell("fixed", f"beta_{name}span") for name in ("", "hf_"))
    lower_share = float(np.mean(off < reference))
    own = [np.mean(run.constants(p.loose, "beta_span") < run.constants(p.loose, "beta_hf_span")) for p in pairs]
    yield holds(
        f"{figure}: no order between β_off and β_HF",
        "none",
        f"β_off < β_HF in {100 * lower_share:.0f} % of {len(off)} cases",
        0.0 < lower_share < 1.0,
        why=f"Over the span, all tolerances. In the three panels, {text([f'{100 * share:.0f} %' for share in own])}.",
    )


PAIRS = ("", "full_", "plain_", "hf_")
"""Columns of β_off, β_on, β_dec and β_HF."""


def _where(everywhere: bool, parameters: np.ndarray) -> str:
    return f"at all {len(parameters)}" if everywhere else "not at all"


def _decreasing(curve: Mapping[int, float]) -> bool:
    return all(later <= earlier * (1.0 + 1e-9) + 1e-15 for earlier, later in pairwise(curve.values()))
