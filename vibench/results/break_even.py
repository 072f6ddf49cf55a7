"""Benefit thresholds: from how many queries on one way of reducing pays against another (paper, Tables 1 and 2)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from vibench.interfaces.strategies import Kind
from vibench.results.columns import KEYS, THRESHOLDS


class Meaning(StrEnum):
    """What a threshold says."""

    FROM = "from"
    UNTIL = "until"
    NEVER = "never"
    AT_ONCE = "at once"


@dataclass(frozen=True)
class BreakEven:
    """Number of queries n* (`None` where there is none) and what it means for way b against way a."""

    number: float | None
    meaning: Meaning

    def __str__(self) -> str:
        return self.meaning.value if self.number is None else f"{self.meaning.value} {self.number:.0f}"


def break_even(offline_a: float, online_a: float, offline_b: float, online_b: float) -> BreakEven:
    """When b, with its offline seconds and its seconds per query, is cheaper than a in total.

    n* = (offline_b − offline_a) / (online_a − online_b). Offline dearer and queries faster: from n* queries on.
    Offline dearer and queries no faster: never. Offline cheaper and queries no slower: at once. Offline cheaper but
    queries slower: until n*.
    """
    dearer, faster = offline_b - offline_a, online_a - online_b
    if dearer <= 0.0 and faster >= 0.0:
        return BreakEven(None, Meaning.AT_ONCE)
    if dearer >= 0.0 and faster <= 0.0:
        return BreakEven(None, Meaning.NEVER)
    return BreakEven(dearer / faster, Meaning.FROM if dearer > 0.0 else Meaning.UNTIL)


HIGH_FIDELITY = "high-fidelity"
"""What `primal_a` says where a reduced model is compared with the high-fidelity one."""

_SHARED = tuple(name for name in THRESHOLDS if name in KEYS)


def break_even_rows(cells: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the thresholds table from rows of the cells table.

    Every per-parameter enrichment (a) against every fixed one (b) with the same problem, cone, tolerances and solver,
    and the high-fidelity model (a, nothing offline) against every strategy (b). Cells without an ok query are left out.
    """
    timed = [cell for cell in cells if cell["online_s"] is not None]
    rows = []
    for b in timed:
        rows.append(_row(None, b))
        if b["enrichment_kind"] == Kind.FIXED:
            shared = _comparable(b)
            rows += [
                _row(a, b) for a in timed if a["enrichment_kind"] == Kind.PER_PARAMETER and _comparable(a) == shared
            ]
    return rows


def _comparable(cell: Mapping[str, Any]) -> tuple[Any, ...]:
    """What two cells must share: all but the enrichment, and the machine that measured their seconds."""
    return tuple(cell[name] for name in (*_SHARED, "machine"))


def _row(a: Mapping[str, Any] | None, b: Mapping[str, Any]) -> dict[str, Any]:
    first = a or {"primal": HIGH_FIDELITY, "primal_tol": None, "assembly": "", "offline_s": 0.0, "online_s": b["hf_s"]}
    found = break_even(first["offline_s"], first["online_s"], b["offline_s"], b["online_s"])
    row = {name: b[name] for name in _SHARED}
    for side, cell in (("a", first), ("b", b)):
        row |= {f"{name}_{side}": cell[name] for name in ("primal", "primal_tol", "assembly")}
        row |= {f"{phase}_{side}_s": cell[f"{phase}_s"] for phase in ("offline", "online")}
    return row | {"benefit_threshold": found.number, "meaning": found.meaning.value}
