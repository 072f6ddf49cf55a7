"""Break-even: the number of queries at which the total costs of two models are equal (paper, Tables 1 and 2)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from vibench.interfaces.strategies import Kind
from vibench.results.columns import KEYS, THRESHOLDS


class Meaning(StrEnum):
    """When the second model, b, is cheaper in total than the first, a."""

    FROM = "from"
    UNTIL = "until"
    NEVER = "never"
    AT_ONCE = "at once"


@dataclass(frozen=True)
class BreakEven:
    """Number n* of queries, `None` where the total costs are never equal, and on which side of it b is cheaper."""

    number: float | None
    meaning: Meaning

    def __str__(self) -> str:
        return self.meaning.value if self.number is None else f"{self.meaning.value} {self.number:.0f}"


def break_even(offline_a: float, online_a: float, offline_b: float, online_b: float) -> BreakEven:
    """Break-even of b against a, from their offline seconds and their seconds per query.

    n* = (offline_b − offline_a) / (online_a − online_b). If b costs more offline, it is cheaper from n* queries on if
    its queries are faster, never otherwise. If b costs less offline, it is cheaper until n* queries if its queries are
    slower, at once otherwise.
    """
    dearer, faster = offline_b - offline_a, online_a - online_b
    if dearer <= 0.0 and faster >= 0.0:
        return BreakEven(None, Meaning.AT_ONCE)
    if dearer >= 0.0 and faster <= 0.0:
        return BreakEven(None, Meaning.NEVER)
    return BreakEven(dearer / faster, Meaning.FROM if dearer > 0.0 else Meaning.UNTIL)


HIGH_FIDELITY = "high-fidelity"
"""Value of `primal_a` where a is the high-fidelity model."""

_SHARED = tuple(name for name in THRESHOLDS if name in KEYS)


def break_even_rows(cells: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the thresholds table from rows of the cells table.

    Every per-parameter enrichment (a) is compared with every fixed one (b) of the same problem, cone, tolerances and
    solver, if one machine measured both; the high-fidelity model (a, whose offline phase is its set-up) with every
    strategy (b). Cells without an ok query are left out.
    """
    timed = [cell for cell in cells if cell["online_s"] is not None]
    rows = []
    for b in timed:
        model = {"primal": HIGH_FIDELITY, "primal_tol": None, "assembly": ""}
        rows.append(_row(model | {"offline_s": b["hf_setup_s"], "online_s": b["hf_s"]}, b))
        if b["enrichment_kind"] == Kind.FIXED:
            others = (a for a in timed if a["enrichment_kind"] == Kind.PER_PARAMETER)
            rows += [_row(a, b) for a in others if all(a[name] == b[name] for name in (*_SHARED, "machine"))]
    return rows


def _row(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
    found = break_even(a["offline_s"], a["online_s"], b["offline_s"], b["online_s"])
    row = {name: b[name] for name in _SHARED}
    for side, cell in (("a", a), ("b", b)):
        row |= {f"{name}_{side}": cell[name] for name in ("primal", "primal_tol", "assembly")}
        row |= {f"{phase}_{side}_s": cell[f"{phase}_s"] for phase in ("offline", "online")}
    return row | {"benefit_threshold": found.number, "meaning": found.meaning.value}
