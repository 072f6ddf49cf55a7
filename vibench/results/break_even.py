"""Break-even: the number of queries at which the total costs of two models are equal (paper, Tables 1 and 2)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.strategies import Kind
from vibench.plugins.registry import default_formulation
from vibench.results.paired_timing import CONDITIONS, DRAWS, PairedTiming
from vibench.results.schema import KEYS, STORED, Row
from vibench.signatures import NotNegative, bordered
from vibench.study.cells import NO_SUCH_AXIS
from vibench.timing import Seconds

# Probability left out on each side of a 95 % interval.
TAIL = 0.025

# Value of `primal_a` where a is the high-fidelity model.
HIGH_FIDELITY = "high-fidelity"


class Meaning(StrEnum):
    """Range of queries for which the second model, b, is cheaper in total than the first, a."""

    FROM = "from"
    UNTIL = "until"
    NEVER = "never"
    AT_ONCE = "at once"
    AS_FAST = "as fast"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class BreakEven:
    """Number n* of queries, `None` where the total costs are never equal, and on which side of it b is cheaper.

    `low` and `high` are the ends of the 95 % interval of n*, where seconds were measured in rounds. Where the queries
    are as fast, within a factor of 1.25, no number is claimed. Where it is undecided, `rounds` is how many more of them
    would decide it at the present scatter, `None` where the offline seconds are too close for any to do so.
    """

    number: float | None
    meaning: Meaning
    low: float | None = None
    high: float | None = None
    rounds: int | None = None

    @bordered
    def overlaps(self, other: BreakEven) -> bool:
        """Whether both mean the same, and their intervals have a number in common."""
        if self.low is None or self.high is None or other.low is None or other.high is None:
            return False
        return self.meaning == other.meaning and self.low <= other.high and other.low <= self.high

    def __str__(self) -> str:
        return self.meaning.value if self.number is None else f"{self.meaning.value} {self.number:.0f}"


def break_even(
    offline_a: NotNegative, online_a: NotNegative, offline_b: NotNegative, online_b: NotNegative
) -> BreakEven:
    """Break-even of b against a, from their offline seconds and their seconds per query.

    The number is n* = (offline_b − offline_a) / (online_a − online_b). If b costs more offline, it is cheaper from n*
    queries on if its queries are faster, never otherwise. If b costs less offline, it is cheaper until n* queries if
    its queries are slower, at once otherwise.
    """
    dearer, faster = offline_b - offline_a, online_a - online_b
    if dearer <= 0.0 and faster >= 0.0:
        return BreakEven(None, Meaning.AT_ONCE)
    if dearer >= 0.0 and faster <= 0.0:
        return BreakEven(None, Meaning.NEVER)
    return BreakEven(dearer / faster, Meaning.FROM if dearer > 0.0 else Meaning.UNTIL)


class BreakEvenComparison(NamedTuple):
    """The break-even of a cell b against a cell a, or against the high-fidelity model where that is `None`.

    `online` are the seconds of a query of both in the blocks that they share, `gain` the 95 % interval of a over b.
    """

    a: Row | None
    b: Row
    result: BreakEven
    online: tuple[float, float]
    gain: tuple[float, float] | None


def break_even_rows(cells: Iterable[Row], timings: Iterable[Row]) -> Iterator[dict[str, Any]]:
    """Rows of the thresholds table from rows of the tables of cells and timings; see `compared`."""
    return (_row(one) for one in compared(cells, PairedTiming(timings)))


def compared(cells: Iterable[Row], paired: PairedTiming, tail: float = TAIL) -> Iterator[BreakEvenComparison]:
    """Break-even of the models that are compared, undecided where more than `tail` of the draws deny it.

    It is "as fast" where it would be undecided, but the seconds of both queries differ by a factor of less than 1.25,
    with the probability `tail` of either to be wrong.

    Every per-parameter enrichment (a) is compared with every fixed one (b) of the same problem, formulation, cone,
    tolerances and solver; every reduced cell (a) with that of the same model with certificates (b); every cell of the
    default formulation (a) with those of every other (b) that agrees with it on the axes that b has; the high-fidelity
    model (a, whose offline phase is its set-up) with every cell (b). One machine measured both, and but for the second
    of these pairs both or none have certificates. Cells without an ok query are left out.
    """
    timed, usual = [cell for cell in cells if cell["online_s"] is not None], default_formulation()
    default = [cell for cell in timed if cell["formulation"] == usual]
    indices: dict[tuple[str, ...], dict[tuple[Any, ...], list[Row]]] = {}

    def equal_to(cell: Row, columns: tuple[str, ...], among: list[Row]) -> Iterable[Any]:
        # Cells are indexed by their values in the columns: comparing every cell with all others would be quadratic.
        if (index := indices.get(columns)) is None:
            index = indices[columns] = {}
            for one in among:
                index.setdefault(tuple(one[name] for name in columns), []).append(one)
        return index.get(tuple(cell[name] for name in columns), [])

    # Seconds of a query are means over the queries of a validation set, and of a machine.
    measured = ("validation", "validation_options", "machine")
    everything = (*_shared_axes(), "formulation", "formulation_options", *measured)
    for b in timed:
        yield _comparison(paired, None, b, tail)
        yield from (_comparison(paired, a, b, tail) for a in equal_to(b, everything, timed) if _compared(a, b))
        if b["formulation"] != usual:
            axes = (*_axes(b), *measured)
            alike = (a for a in equal_to(b, axes, default) if a["bounds"] == b["bounds"])
            yield from (_comparison(paired, a, b, tail) for a in alike)


def _shared_axes() -> tuple[str, ...]:
    return tuple(name for name in STORED["thresholds"] if name in KEYS)


def _is_blank(value: object) -> bool:
    # The values of a cell that lacks an axis.
    return value in (None, NO_SUCH_AXIS, "{}")


def _axes(cell: Row) -> tuple[str, ...]:
    """The columns in which the mixed programs agree with a cell of another formulation that replaces them."""
    # A formulation may lack these axes; what it lacks may be anything in the mixed program.
    axes = (
        ("dual", "dual_options", "dual_tol", "dual_size"), ("primal", "primal_options", "primal_tol"),
        ("pod_tol", "pod_size"), ("solver",), ("accuracy",),
    )  # fmt: skip
    lacking = {name for axis in axes if all(_is_blank(cell[column]) for column in axis) for name in axis}
    return tuple(name for name in (*_shared_axes(), *axes[1]) if name not in lacking)


def _compared(a: Row, b: Row) -> bool:
    """Whether b replaces a: fixed enrichment a per-parameter one, or a certified query the same without certificate."""
    if a["bounds"] == b["bounds"]:
        return bool(a["enrichment_kind"] == Kind.PER_PARAMETER and b["enrichment_kind"] == Kind.FIXED)
    same = all(a[name] == b[name] for name in ("primal", "primal_options", "primal_tol"))
    return a["assembly"] == "reduced" and not a["bounds"] and same


def _comparison(paired: PairedTiming, a: Row | None, b: Row, tail: float) -> BreakEvenComparison:
    """Break-even of b against a with its interval; common offline phases, or the set-up, do not differ."""
    key, offline_a = (None, b["hf_setup_s"]) if a is None else (a["cell"], a["offline_s"])
    ratio, level = paired.ratio(key, b["cell"]), paired.level(key, b["cell"])
    if ratio is None or level is None:
        online = (b["hf_s"] if a is None else a["online_s"]), b["online_s"]
        return BreakEvenComparison(a, b, BreakEven(None, Meaning.UNDECIDED), online, None)
    rng = np.random.default_rng(0)
    shared = b["hf_setup_s"] if a is None else shared_offline(a, b)
    seconds, quotients = paired.draws(key, b["cell"], rng)
    online_a = float(np.exp(level.mean))
    online_b = online_a * float(np.exp(ratio.mean))
    # Seconds that other runs might measure, beside those that this run has measured.
    others = offline_draws(a, shared, rng) if a else np.full(DRAWS, offline_a)
    dearer = offline_draws(b, shared, rng) - others
    faster = seconds - seconds * quotients
    drawn = {
        Meaning.AT_ONCE: (dearer <= 0.0) & (faster >= 0.0),
        Meaning.FROM: (dearer > 0.0) & (faster > 0.0),
        Meaning.UNTIL: (dearer < 0.0) & (faster < 0.0),
    }
    drawn[Meaning.NEVER] = ~np.any(list(drawn.values()), axis=0)
    measured = break_even(offline_a, online_a, b["offline_s"], online_b)
    equal = drawn[Meaning.FROM] | drawn[Meaning.UNTIL]
    low, high = np.quantile(dearer[equal] / faster[equal], (TAIL, 1.0 - TAIL)) if equal.any() else (None, None)
    result = measured if measured.number is None else replace(measured, low=low, high=high)
    if np.mean(drawn[measured.meaning]) < 1.0 - tail:
        result = BreakEven(None, Meaning.UNDECIDED, low)
    if result.meaning is Meaning.UNDECIDED:
        # Other load of a machine changes the ratio of seconds by about a factor of 1.25, and another run would not find
        # a threshold that rests on less.
        margin = math.log(1.25)
        if all(abs(end) <= margin for end in ratio.interval(tail)):
            result = BreakEven(None, Meaning.AS_FAST)
        # More rounds decide nothing where it is only the offline seconds that do not differ enough.
        elif tail < float(np.mean(quotients < 1.0)) < 1.0 - tail:
            result = replace(result, rounds=_rounds_missing(paired, key, b["cell"], margin))
    least, most = ratio.interval(TAIL)
    return BreakEvenComparison(a, b, result, (online_a, online_b), (math.exp(-most), math.exp(-least)))


def _rounds_missing(paired: PairedTiming, a: str | None, b: str, margin: float) -> int | None:
    """Number of further rounds that would decide which of two queries is faster, or neither, at the present scatter."""
    within, done = paired.ratio_within(a, b), paired.rounds(a, b)
    if within is None:
        return None
    distance = max(abs(within.mean), margin - abs(within.mean))
    # Student's quantile for 95 % with the degrees of freedom that further rounds would lead to.
    allowed = (distance / 2.1) ** 2 - CONDITIONS**2
    needed = done * within.error**2 / allowed if allowed > 0.0 else math.inf
    # Nobody runs a million rounds: beyond, the number says only that it is hopeless.
    return max(1, math.ceil(min(needed, 1e6) - done))


def shared_offline(a: Row, b: Row) -> float:
    """Offline seconds of the phases that two cells have in common."""
    # Equal seconds were measured once for both cells, since their stage is the same.
    phases = ("snapshots", "pod", "cone", "enrichment", "assembly")
    return float(sum(a[name] for name in (f"offline_{phase}_s" for phase in phases) if a[name] == b[name]))


def scatter(runs: Iterable[Sequence[Seconds]]) -> float:
    """Standard deviation of the logarithm of offline seconds, from the runs of stages timed more than once."""
    logarithms = [np.log([one.cpu for one in some]) for some in runs if is_repeated(len(some), some[0].cpu)]
    if not logarithms:
        # A run that repeats no stage says nothing: this is what others have.
        return 0.2
    squares = sum(float(np.sum((one - one.mean()) ** 2)) for one in logarithms)
    return float(np.sqrt(squares / sum(len(one) - 1 for one in logarithms)))


def is_repeated(times: int, cpu: float) -> bool:
    # The scatter of a stage below a millisecond says nothing about that of a whole offline phase.
    return times > 1 and cpu >= 1e-3


def offline_factor(deviation: float) -> float:
    """Factor from offline seconds to the end of their 95 % interval; `deviation` is that of their logarithm."""
    return math.exp(1.96 * deviation)


def offline_draws(cell: Row, shared: float, rng: np.random.Generator) -> Array:
    """Offline seconds (`DRAWS`,) of a cell that other runs might measure; those that are `shared` do not vary."""
    low, high = cell["offline_low_s"], cell["offline_high_s"]
    # The deviation from its 95 % interval, see `offline_factor`.
    spread = scatter([]) if low is None or math.isnan(low) else math.log(high / low) / (2.0 * 1.96)
    return np.asarray(shared + (cell["offline_s"] - shared) * np.exp(spread * rng.standard_normal(DRAWS)))


def _row(one: BreakEvenComparison) -> dict[str, Any]:
    b, result = one.b, one.result
    model = {"primal": HIGH_FIDELITY, "formulation": default_formulation(), "assembly": ""}
    absent = dict.fromkeys(("cell", "primal_tol", "bounds"))
    a = one.a or {**b, **model, **absent, "offline_s": b["hf_setup_s"]}
    row = {name: a[name] if _is_blank(b[name]) else b[name] for name in _shared_axes()}
    for side, cell, online in zip("ab", (a, b), one.online, strict=True):
        own = ("cell", "formulation", "primal", "primal_tol", "assembly", "bounds")
        row |= {f"{name}_{side}": cell[name] for name in own}
        row |= {f"offline_{side}_s": cell["offline_s"], f"online_{side}_s": online}
    numbers = {"benefit_threshold": result.number, "threshold_low": result.low, "threshold_high": result.high}
    low, high = one.gain or (None, None)
    gains = {"gain": one.online[0] / one.online[1], "gain_low": low, "gain_high": high}
    return row | gains | numbers | {"meaning": result.meaning.value, "rounds_missing": result.rounds}
