"""Break-even: the number of queries at which the total costs of two models are equal (paper, Tables 1 and 2)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from vibench.arrays import Array, Indices
from vibench.errors import requested
from vibench.interfaces.strategies import Kind
from vibench.results.columns import KEYS, THRESHOLDS
from vibench.study.cells import CERTIFIED

DRAWS = 2000
"""Resamples of the rounds that an interval is taken from."""

TAIL = 0.025
"""Probability left out on each side of an interval."""

FEWEST_ROUNDS = 6
"""With fewer rounds no sign is significant at 95 %: all of five have the same one with probability 2 / 2⁵ by chance."""


class Meaning(StrEnum):
    """When the second model, b, is cheaper in total than the first, a."""

    FROM = "from"
    UNTIL = "until"
    NEVER = "never"
    AT_ONCE = "at once"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class BreakEven:
    """Number n* of queries, `None` where the total costs are never equal, and on which side of it b is cheaper.

    `low` and `high` are the ends of the 95 % interval of n*, where seconds were measured in rounds.
    """

    number: float | None
    meaning: Meaning
    low: float | None = None
    high: float | None = None

    def overlaps(self, other: BreakEven) -> bool:
        """Whether both mean the same, and their intervals have a number in common."""
        if self.low is None or self.high is None or other.low is None or other.high is None:
            return False
        return self.meaning == other.meaning and self.low <= other.high and other.low <= self.high

    def __str__(self) -> str:
        return self.meaning.value if self.number is None else f"{self.meaning.value} {self.number:.0f}"


@requested
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


@dataclass(frozen=True)
class Costs:
    """Seconds offline and per query of a model: measured, and resampled (`DRAWS`,) as they might have been measured."""

    offline: float
    online: float
    offline_draws: Array
    online_draws: Array


def resampled_break_even(a: Costs, b: Costs) -> BreakEven:
    """Break-even of b against a with its interval; undecided where the resamples do not agree on its meaning."""
    dearer, faster = b.offline_draws - a.offline_draws, a.online_draws - b.online_draws
    drawn = {
        Meaning.AT_ONCE: (dearer <= 0.0) & (faster >= 0.0),
        Meaning.FROM: (dearer > 0.0) & (faster > 0.0),
        Meaning.UNTIL: (dearer < 0.0) & (faster < 0.0),
    }
    drawn[Meaning.NEVER] = ~np.any(list(drawn.values()), axis=0)
    measured = break_even(a.offline, a.online, b.offline, b.online)
    equal = drawn[Meaning.FROM] | drawn[Meaning.UNTIL]
    low, high = np.quantile(dearer[equal] / faster[equal], (TAIL, 1.0 - TAIL)) if equal.any() else (None, None)
    if np.mean(drawn[measured.meaning]) < 1.0 - TAIL:
        return BreakEven(None, Meaning.UNDECIDED, low)
    return measured if measured.number is None else BreakEven(measured.number, measured.meaning, low, high)


UNDECIDED = BreakEven(None, Meaning.UNDECIDED)

STRATEGY = ("primal", "primal_options", "primal_tol")

HIGH_FIDELITY = "high-fidelity"
"""Value of `primal_a` where a is the high-fidelity model."""

SHARED_PHASES = ("offline_snapshots_s", "offline_pod_s", "offline_cone_s")
"""Offline phases that compared cells have in common; measured once for both, they do not differ between them."""

MODEL_PHASES = (*SHARED_PHASES, "offline_enrichment_s", "offline_assembly_s")
"""Offline phases that cells of the same model have in common, with certificates and without."""

NORMAL_95 = 1.96
"""Half the width of the 95 % interval of a normal distribution, in standard deviations."""

VALIDATION = ("validation", "validation_options")
"""Columns that name the validation set: seconds of a query are means over its queries."""

_SHARED = tuple(name for name in THRESHOLDS if name in KEYS)


def break_even_rows(
    cells: Iterable[Mapping[str, Any]], timings: Iterable[Mapping[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Rows of the thresholds table from rows of the tables of cells and timings.

    Every per-parameter enrichment (a) is compared with every fixed one (b) of the same problem, cone, tolerances and
    solver, if one machine measured both and both or none have certificates; every reduced cell (a) with that of the
    same model with certificates (b); the high-fidelity model (a, whose offline phase is its set-up) with every strategy
    (b). Cells without an ok query are left out.
    """
    timed, resampling = [cell for cell in cells if cell["online_s"] is not None], _Resampling(timings)
    alike: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for cell in timed:
        alike.setdefault(_alike(cell), []).append(cell)
    for b in timed:
        model = {"cell": None, "primal": HIGH_FIDELITY, "primal_tol": None, "assembly": ""}
        model |= {"offline_s": b["hf_setup_s"], "online_s": b["hf_s"]}
        yield _row(model, b, resampling.against_high_fidelity(b))
        yield from (_row(a, b, resampling.between(a, b)) for a in alike[_alike(b)] if _compared(a, b))


def _alike(cell: Mapping[str, Any]) -> tuple[Any, ...]:
    """What cells that are compared have in common."""
    return tuple(cell[name] for name in (*_SHARED, *VALIDATION, "machine"))


def _compared(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Whether b is an alternative to a: fixed to per-parameter enrichment, or the same with certificates to without."""
    if (a["assembly"] == CERTIFIED) == (b["assembly"] == CERTIFIED):
        return bool(a["enrichment_kind"] == Kind.PER_PARAMETER and b["enrichment_kind"] == Kind.FIXED)
    return a["assembly"] == "reduced" and all(a[name] == b[name] for name in STRATEGY)


class _Resampling:
    """Seconds as they might have been measured.

    Of a query: the median over rounds drawn with replacement, the same ones for both models, since what disturbs a
    round disturbs both. Of what is measured once, an offline phase or the high-fidelity model: the measured seconds
    with the slowdown of another time of the run.
    """

    def __init__(self, timings: Iterable[Mapping[str, Any]]) -> None:
        self._rounds: dict[str, dict[int, float]] = {}
        slowdowns = []
        for row in timings:
            self._rounds.setdefault(row["cell"], {})[row["round"]] = row["total_s"]
            slowdowns.append(row["slowdown"])
        self._slowdowns = np.array(slowdowns) / np.median(slowdowns) if slowdowns else np.ones(1)

    def between(self, a: Mapping[str, Any], b: Mapping[str, Any]) -> BreakEven:
        """Break-even of two cells, whose snapshots, POD and cone are the same."""
        rng = np.random.default_rng(0)
        common = sorted(self._rounds.get(a["cell"], {}).keys() & self._rounds.get(b["cell"], {}).keys())
        phases = MODEL_PHASES if b["assembly"] == CERTIFIED != a["assembly"] else SHARED_PHASES
        shared = sum(a[name] for name in phases if a[name] == b[name])
        which = rng.integers(max(len(common), 1), size=(DRAWS, len(common)))
        costs = [self._costs(cell, common, which, shared, rng) for cell in (a, b)]
        return resampled_break_even(*costs) if len(common) >= FEWEST_ROUNDS else UNDECIDED

    def against_high_fidelity(self, b: Mapping[str, Any]) -> BreakEven:
        """Break-even of a cell against the high-fidelity model, whose set-up is part of the cell's snapshots."""
        rng = np.random.default_rng(0)
        rounds = sorted(self._rounds.get(b["cell"], {}))
        which = rng.integers(max(len(rounds), 1), size=(DRAWS, len(rounds)))
        cell = self._costs(b, rounds, which, b["hf_setup_s"], rng)
        spread = np.log(b["hf_high_s"] / b["hf_low_s"]) / (2.0 * NORMAL_95)
        online = b["hf_s"] * self._slowdown(rng) * np.exp(spread * rng.standard_normal(DRAWS))
        model = Costs(b["hf_setup_s"], b["hf_s"], np.full(DRAWS, b["hf_setup_s"]), online)
        return resampled_break_even(model, cell) if len(rounds) >= FEWEST_ROUNDS else UNDECIDED

    def _costs(
        self, cell: Mapping[str, Any], rounds: list[int], which: Indices, shared: float, rng: np.random.Generator
    ) -> Costs:
        """Costs of a cell; offline seconds that both models `shared` do not differ between them."""
        seconds = np.array([self._rounds[cell["cell"]][number] for number in rounds])
        online = np.median(seconds[which], axis=1) if len(seconds) else np.zeros(DRAWS)
        offline = shared + (cell["offline_s"] - shared) * self._slowdown(rng)
        return Costs(cell["offline_s"], cell["online_s"], offline, online)

    def _slowdown(self, rng: np.random.Generator) -> Array:
        return rng.choice(self._slowdowns, DRAWS)


def _row(a: Mapping[str, Any], b: Mapping[str, Any], result: BreakEven) -> dict[str, Any]:
    row = {name: b[name] for name in _SHARED}
    for side, cell in (("a", a), ("b", b)):
        row |= {f"{name}_{side}": cell[name] for name in ("cell", "primal", "primal_tol", "assembly")}
        row |= {f"{phase}_{side}_s": cell[f"{phase}_s"] for phase in ("offline", "online")}
    numbers = {"benefit_threshold": result.number, "threshold_low": result.low, "threshold_high": result.high}
    return row | numbers | {"meaning": result.meaning.value}
