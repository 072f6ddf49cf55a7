"""The curves of a run that the figures of the paper show, and sentences that compare them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from vibench import Array, ProblemTables
from vibench_problems.paper.published import Pair

PLAIN, MODIFIED = "cpg", "mcpg"
"""The dual strategies of the paper."""

ROUND_OFF = 1e-9
"""Relative violation of an inequality that counts as round-off."""

ZERO = 1e-12
"""Inf-sup constants below this are zero."""


@dataclass(frozen=True)
class Curves:
    """A run of one problem of the paper, as its figures show it: full assembly, one solver."""

    tables: ProblemTables

    @cached_property
    def queries(self) -> pd.DataFrame:
        """The queries of the cells with the cones of mCPG, one row for every model and parameter."""
        known = self.tables.queries
        mine = known[(known["dual"] == MODIFIED) & (known["assembly"] == "full")]
        return mine.drop_duplicates(["primal", "primal_tol", *SIZES, "query"])

    def of(self, pair: Pair, rows: pd.DataFrame) -> pd.DataFrame:
        """The rows of a pair, by the tolerances or sizes that are prescribed for it."""
        wanted = [rows[column] == value for column, value in pair.prescribed.items()]
        return rows[np.logical_and.reduce([*wanted, *(rows[c].isna() for c in SIZES if c not in pair.prescribed)])]

    def has(self, pair: Pair) -> bool:
        """Whether the run has a model without enrichment, one with one per parameter, and PGA at both tolerances."""
        mine = self.of(pair, self.queries)
        tolerances = set(mine["primal_tol"][mine["enrichment_kind"] == "fixed"])
        return set(mine["enrichment_kind"]) >= {"none", "per-parameter"} and tolerances >= {pair.tight, pair.loose}

    def size(self, pair: Pair) -> tuple[int, int]:
        """(N, R) here."""
        first = self.of(pair, self.queries).iloc[0]
        return int(first["N"]), int(first["R"])

    def constants(self, pair: Pair, kind: str, tolerance: float | None = None) -> pd.DataFrame:
        """Queries of a model of a pair, by number: its kind of enrichment, and its tolerance if it has one."""
        mine = self.of(pair, self.queries)
        mine = mine[mine["enrichment_kind"] == kind]
        if tolerance is not None:
            mine = mine[mine["primal_tol"] == tolerance]
        return mine.sort_values("query").set_index("query")

    def error(self, stage: str, dual: str | None = None, quantity: str = "error") -> dict[int, float]:
        """The longest history of a POD or a cone, value by step; empty if there is none."""
        known = self.tables.histories
        mine = known[(known["stage"] == stage) & (known["quantity"] == quantity)]
        mine = mine if dual is None else mine[mine["dual"] == dual]
        if mine.empty:
            return {}
        return _by_step(mine[mine["artefact"] == mine.groupby("artefact")["step"].max().idxmax()])

    def growth(self, pair: Pair, quantity: str, tolerance: float) -> dict[int, float]:
        """The history of a fixed enrichment of a pair at a tolerance."""
        known = self.tables.histories
        mine = known[(known["stage"] == "enrichment") & (known["quantity"] == quantity) & (known["dual"] == MODIFIED)]
        mine = self.of(pair, mine[mine["primal_tol"] == tolerance])
        return _by_step(mine)


SIZES = ("pod_tol", "pod_size", "dual_tol", "dual_size")


def reached(curve: Mapping[int, float], tolerance: float) -> int | None:
    """First step at which a curve is at most a tolerance."""
    return next((step for step, value in curve.items() if value <= tolerance), None)


def violations(smaller: Mapping[int, float], larger: Mapping[int, float]) -> list[int]:
    """Steps of both curves at which smaller ≤ larger is violated beyond round-off."""
    return [k for k in smaller if k in larger and smaller[k] > larger[k] * (1.0 + ROUND_OFF)]


def below(smaller: Any, larger: Any) -> bool:
    """Whether smaller ≤ larger everywhere, up to round-off."""
    one, other = np.asarray(smaller, float), np.asarray(larger, float)
    return bool(np.all(one <= other * (1.0 + ROUND_OFF) + 1e-14))


Fact = tuple[Any, str]
"""Whether something agrees with the paper (`None`: it does not say), and what."""


def compared(*facts: Fact) -> str:
    """Facts that agree with the paper, that differ from it, and that it says nothing about, as sentences."""
    groups = (("Agrees", True), ("Differs", False), ("Not published", None))
    known = [(holds if holds is None else bool(holds), text) for holds, text in facts]
    told = ((title, [text for holds, text in known if holds is wanted]) for title, wanted in groups)
    return " ".join(f"{title}: {'; '.join(texts)}." for title, texts in told if texts)


def close(paper: Sequence[int], ours: Sequence[int | None], within: float) -> bool:
    """Whether all numbers agree within a relative difference."""
    return all(b is not None and abs(b - a) <= within * a for a, b in zip(paper, ours, strict=True))


def named(values: Sequence[object]) -> str:
    """Values as an enumeration."""
    return ", ".join("none" if value is None else str(value) for value in values)


def span(values: Any) -> str:
    """Smallest and largest value."""
    found: Array = np.asarray(values, float)
    low, high = (f"{end:.3g}".replace("-", "−").replace("e−", "e-") for end in (found.min(), found.max()))
    return low if low == high else f"{low} to {high}"


def positive(values: Any) -> Array:
    """Values for a logarithmic axis, without those that are zero up to round-off."""
    found = np.asarray(values, float)
    return np.where(found > ZERO, found, np.nan)


def _by_step(rows: pd.DataFrame) -> dict[int, float]:
    ordered = rows.sort_values("step")
    return dict(zip(ordered["step"].astype(int), ordered["value"].astype(float), strict=True))
