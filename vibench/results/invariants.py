"""What must hold in every row of `queries`, whatever was run; a violation is a bug in our own linear algebra.

Whole space ≥ own space ≥ V_N alone, whole space ≥ high-fidelity pair, own = whole space for per-parameter enrichments,
cone ≥ span; certified error bounds ≥ errors. The order is exact for the span; of intervals over the cone, the upper end
of the larger constant is compared with the lower end of the smaller. A reduced cone with free generators is not in W⁺,
and its constant is compared with that of the high-fidelity pair over the span alone. Round-off is allowed for, in units
of the constant of the whole space, which is no larger than the norm of the form.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vibench.interfaces.strategies import Kind
from vibench.results.columns import CONSTANTS
from vibench.stability.conic_infsup import ABSOLUTE, RELATIVE
from vibench.stability.infsup import UNSIGNED

EFFECTIVITIES = ("effectivity_u", "effectivity_lambda")
"""Certified bound over error: at least 1 wherever there is one."""

ORDER = (("full_", ""), ("", "plain_"), ("full_", "hf_"))
"""Pairs of constants: the first is at least the second."""


@dataclass(frozen=True)
class Violation:
    """An invariant that some rows break."""

    invariant: str
    rows: int
    worst: float

    def __str__(self) -> str:
        return f"{self.invariant} is violated in {self.rows} rows, by up to {self.worst:.1e}"


def violations(queries: pd.DataFrame, kinds: pd.Series) -> list[Violation]:
    """Invariants that do not hold.

    Parameters
    ----------
    queries
        Rows of the queries table.
    kinds
        How the enrichment of each cell depends on the parameter, by cell.
    """
    numbers = queries[[*CONSTANTS, *EFFECTIVITIES]].astype(float)
    signed = ~queries["bounds"].fillna("").str.startswith(f"{UNSIGNED}/")
    return list(_found(numbers, queries["cell"].map(kinds), signed))


def _found(queries: pd.DataFrame, kind: pd.Series, signed: pd.Series) -> Iterator[Violation]:
    scale = queries["beta_full_cone_upper"]
    for larger, smaller in ORDER:
        inside = signed if smaller == "hf_" else signed | True
        yield from _at_least(queries, f"beta_{larger}span", f"beta_{smaller}span", scale)
        yield from _at_least(queries[inside], f"beta_{larger}cone_upper", f"beta_{smaller}cone_lower", scale[inside])
    for whose in ("", "full_", "plain_", "hf_"):
        yield from _at_least(queries, f"beta_{whose}cone_upper", f"beta_{whose}span", scale)
        yield from _at_least(queries, f"beta_{whose}cone_upper", f"beta_{whose}cone_lower", scale)
    for name in EFFECTIVITIES:
        below = queries[name] < 1.0
        if below.any():
            yield Violation(f"{name} ≥ 1", int(below.sum()), float(1.0 - queries[name].min()))
    online, of_online = queries[kind == Kind.PER_PARAMETER], scale[kind == Kind.PER_PARAMETER]
    for larger, smaller in (("span", "full_span"), ("cone_upper", "full_cone_lower")):
        yield from _at_least(online, f"beta_{larger}", f"beta_{smaller}", of_online)


def _at_least(rows: pd.DataFrame, larger: str, smaller: str, scale: pd.Series) -> Iterator[Violation]:
    missing = rows[smaller] * (1.0 - RELATIVE) - ABSOLUTE * scale - rows[larger]
    broken = ~(missing <= 0.0) & np.isfinite(rows[smaller])  # a constant that is not a number breaks it too
    if broken.any():
        yield Violation(f"{larger} ≥ {smaller}", int(broken.sum()), float(missing[broken].max()))
