"""Inequalities that hold in every row of `queries`; a violation is a bug in the linear algebra of vibench.

Inf-sup constants grow with the primal space: V_N ≤ enriched V_N ≤ V, with equality of the last two for per-parameter
enrichments; that of V is at least that of the high-fidelity pair, and that over the cone at least that over the span.
Error bounds are at least the errors, whatever the formulation. Of intervals over the cone, the upper end of the larger
constant is compared with the lower end of the smaller. A cone with free generators is not in W⁺, and compared with the
high-fidelity pair over the span alone. The tolerance for round-off is relative to the constant of V, at most the norm
of the form.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vibench.interfaces.strategies import Kind
from vibench.results.columns import BOUNDS, CONSTANTS
from vibench.stability.conic_infsup import ABSOLUTE, RELATIVE
from vibench.stability.infsup import UNSIGNED

EFFECTIVITIES = tuple(f"effectivity_{name}" for name in BOUNDS)
"""Error bound over error, at least 1."""

ROUND_OFF = 1e-10
"""An effectivity may be below 1 by this: a bound that is the error itself is so in exact arithmetic."""

ORDER = (("full_", ""), ("", "plain_"), ("full_", "hf_"))
"""Pairs of inf-sup constants, the larger one first."""


@dataclass(frozen=True)
class Violation:
    """An invariant, the number of rows that violate it, and the largest violation."""

    invariant: str
    rows: int
    worst: float

    def __str__(self) -> str:
        return f"{self.invariant} is violated in {self.rows} rows, by up to {self.worst:.1e}"


def violations(queries: pd.DataFrame, kinds: pd.Series) -> list[Violation]:
    """Violated invariants in rows of the queries table; `kinds` is the kind of enrichment of each cell, by cell."""
    return list(_violations(queries, kinds))


def added_up(parts: Iterable[Violation]) -> list[Violation]:
    """Violations of several parts of a table, each invariant once."""
    found: dict[str, Violation] = {}
    for one in parts:
        before = found.get(one.invariant, Violation(one.invariant, 0, one.worst))
        worst = float(np.fmax(before.worst, one.worst))  # NaN where every difference is one
        found[one.invariant] = Violation(one.invariant, before.rows + one.rows, worst)
    return list(found.values())


def _violations(rows: pd.DataFrame, kinds: pd.Series) -> Iterator[Violation]:
    for name in EFFECTIVITIES:
        below = rows[name].astype(float) < 1.0 - ROUND_OFF
        if below.any():
            yield Violation(f"{name} ≥ 1", int(below.sum()), float(1.0 - rows[name].min()))
    rows = rows[rows["bounds"].notna()]  # other formulations than the mixed one have no constants
    queries, kind = rows[list(CONSTANTS)].astype(float), rows["cell"].map(kinds)
    signed = ~rows["bounds"].str.startswith(f"{UNSIGNED}/")
    scale = queries["beta_full_cone_upper"]
    for larger, smaller in ORDER:
        inside = signed if smaller == "hf_" else signed | True
        yield from _at_least(queries, f"beta_{larger}span", f"beta_{smaller}span", scale)
        yield from _at_least(queries[inside], f"beta_{larger}cone_upper", f"beta_{smaller}cone_lower", scale[inside])
    for whose in ("", "full_", "plain_", "hf_"):
        yield from _at_least(queries, f"beta_{whose}cone_upper", f"beta_{whose}span", scale)
        yield from _at_least(queries, f"beta_{whose}cone_upper", f"beta_{whose}cone_lower", scale)
    online, of_online = queries[kind == Kind.PER_PARAMETER], scale[kind == Kind.PER_PARAMETER]
    for larger, smaller in (("span", "full_span"), ("cone_upper", "full_cone_lower")):
        yield from _at_least(online, f"beta_{larger}", f"beta_{smaller}", of_online)


def _at_least(rows: pd.DataFrame, larger: str, smaller: str, scale: pd.Series) -> Iterator[Violation]:
    missing = rows[smaller] * (1.0 - RELATIVE) - ABSOLUTE * scale - rows[larger]
    broken = ~(missing <= 0.0) & np.isfinite(rows[smaller])  # NaN violates it too
    if broken.any():
        yield Violation(f"{larger} ≥ {smaller}", int(broken.sum()), float(missing[broken].max()))
