"""Seconds of models that were timed in the same rounds: their ratios, and where those of another run would lie.

Rounds, their blocks and paces are explained in docs/measurement.md. Whatever slows down a whole round leaves ratios as
they are, and what hits one model in one round is an outlier. Blocks are independent, as what differs between processes
differs between them. The interval of a ratio is that of a mean over blocks: Student's, its variance moderated by those
of all models of the run (Smyth 2004, "Linear models and empirical Bayes methods for assessing differential expression",
section 6), since a model has few blocks of its own. The variance of `CONDITIONS` is added: what else uses the core and
its caches changes ratios in all blocks alike.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.special import digamma, polygamma, stdtrit

from vibench.arrays import Array
from vibench.results.schema import Row

# Standard deviation of the logarithm of a ratio between cold runs beyond the scatter of their blocks, measured in runs
# under different loads (docs/measurement.md).
CONDITIONS = 0.05

# Draws of seconds that other runs might measure, from which intervals are taken.
DRAWS = 2000


class MeanEstimate(NamedTuple):
    """A mean with its standard error and the degrees of freedom of that error."""

    mean: float
    error: float
    freedom: float

    def interval(self, tail: float) -> tuple[float, float]:
        """Interval of Student's distribution without the probability `tail` on each side."""
        half = self.error * float(stdtrit(self.freedom, 1.0 - tail))
        return self.mean - half, self.mean + half

    def draws(self, rng: np.random.Generator) -> Array:
        """Means (`DRAWS`,) that other runs might measure."""
        # These are logarithms, and with one degree of freedom some draws lie where exponentials overflow.
        return self.mean + np.clip(self.error * rng.standard_t(self.freedom, DRAWS), -50.0, 50.0)

    def minus(self, other: MeanEstimate) -> MeanEstimate:
        """Difference of independent means with the degrees of freedom of Welch and Satterthwaite."""
        mine, others = self.error**2, other.error**2
        spread = mine**2 / self.freedom + others**2 / other.freedom
        freedom = (mine + others) ** 2 / spread if spread else math.inf
        # With a thousand degrees of freedom a variance counts as known; infinitely many would be NaN in differences.
        return MeanEstimate(self.mean - other.mean, math.sqrt(mine + others), min(freedom, 1e3))

    def of_other_runs(self) -> MeanEstimate:
        """The estimate for other cold runs, which differ by `CONDITIONS` beyond their blocks."""
        return self.minus(MeanEstimate(0.0, CONDITIONS, 1e3))


@dataclass
class CommonVariance:
    """The distribution of the variances of many models, each measured in a few blocks (Smyth 2004, section 6)."""

    # by model: the unbiased logarithm of its variance over blocks, its square, and the variance of that logarithm
    _scatters: dict[str, Array] = field(default_factory=dict)
    _sums: Array = field(default_factory=lambda: np.zeros(3))

    def add(self, name: str, values: Sequence[float]) -> None:
        """Add a model's values, one for each of its blocks, in place of earlier ones of that name."""
        if name in self._scatters:
            self._sums -= self._scatters.pop(name)
        if len(values) >= 2:
            half = (len(values) - 1.0) / 2.0
            log = math.log(_variance(values)) - float(digamma(half)) + math.log(half)
            self._scatters[name] = np.array([log, log**2, float(polygamma(1, half))])
            self._sums += self._scatters[name]

    def prior(self, blocks: int) -> tuple[float, float]:
        """A typical variance and its degrees of freedom: at most as many as there are independent `blocks`, or 0."""
        count = len(self._scatters)
        # Cells of a group share much of their scatter: four of them count as one degree of freedom.
        most = min(float(blocks), count / 4.0)
        if most < 1.0:
            return 0.0, 0.0
        mean, squares, noise = self._sums / count
        excess = (squares - mean**2) * count / (count - 1.0) - noise
        # Scatter that noise explains up to a thousand degrees of freedom: the variances count as equal.
        if excess <= polygamma(1, 500.0):
            return math.exp(mean), min(most, 1e3)
        # Newton's method for the argument at which the trigamma function is the excess (Smyth 2004, appendix).
        half = 0.5 + 1.0 / excess
        for _ in range(50):
            trigamma = float(polygamma(1, half))
            step = trigamma * (1.0 - trigamma / excess) / float(polygamma(2, half))
            half += step
            if abs(step) < 1e-9 * half:
                break
        return math.exp(mean + float(digamma(half)) - math.log(half)), min(most, 2.0 * half)


def _variance(values: Sequence[float]) -> float:
    # Equal numbers have a variance of round-off, whose logarithm must exist.
    return max(float(np.var(values, ddof=1)), 1e-18)


def paces(seconds: Array) -> Array:
    """Factors (R,) by which the rounds of a block were slower than its typical one, from seconds (C×R) of its models.

    The factor is the median over the models of the deviation from their own median; NaN where a round is missing.
    """
    with np.errstate(all="ignore"):
        logarithms = np.log(seconds)
    own = np.array([_median(row) for row in logarithms])
    return np.exp([_median(column) for column in (logarithms - own[:, None]).T])


def beside(seconds: Array, pace: Array) -> float:
    """Seconds of a high-fidelity solution in a block, at its typical pace; NaN without any.

    `seconds` (C×R) are those beside the queries of every model in every round, NaN where there are none.
    """
    with np.errstate(all="ignore"):
        own = np.array([_median(row) for row in np.log(seconds / pace)])
    return float(np.exp(np.mean(own[np.isfinite(own)]))) if np.isfinite(own).any() else math.nan


def _median(values: Array) -> float:
    """Median of the finite values; NaN without any."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if len(there) else math.nan


class Block(NamedTuple):
    """Logarithms of the seconds of a query in one block, and of their ratio to those of a high-fidelity solution."""

    online: float
    ratio: float


def blocks_of(rounds: Iterable[Row]) -> dict[str, Block]:
    """The blocks of a cell by their names, from its rows of the timings table."""
    by_block: dict[str, list[tuple[float, float]]] = {}
    for row in rounds:
        high_fidelity = math.nan if row["hf_s"] is None else row["hf_s"]
        measured = row["total_s"] / row["pace"], row["total_s"] / high_fidelity
        by_block.setdefault(row["block"], []).append(measured)
    with np.errstate(all="ignore"):
        return {name: Block(*map(_median, np.log(np.array(rows)).T)) for name, rows in by_block.items()}


def mean_seconds(blocks: Iterable[Block]) -> tuple[float, float | None]:
    """Seconds of a query and of a high-fidelity solution (or `None`), over the blocks with both, else over all."""
    every = np.array(list(blocks))
    paired = every[np.isfinite(every[:, 1])]
    online, ratio = np.exp((paired if len(paired) else every).mean(axis=0))
    return float(online), float(online / ratio) if len(paired) else None


class PairedTiming:
    """Seconds of the cells of a run, from rows of its timings table."""

    def __init__(self, timings: Iterable[Row] = ()) -> None:
        self._blocks: dict[str, dict[str, Block]] = {}
        self._rounds: dict[str, Counter[str]] = {}
        self._ratios, self._levels = CommonVariance(), CommonVariance()
        # Every group has a first block; the others are the independent ones that a common variance rests on.
        self._names: set[str] = set()
        self._first: set[str] = set()
        by_cell: dict[str, list[Row]] = {}
        for row in timings:
            by_cell.setdefault(row["cell"], []).append(row)
        for cell, rounds in by_cell.items():
            self.add(cell, rounds)

    def add(self, cell: str, rounds: Sequence[Row]) -> None:
        """Add all rounds of a cell, rows of the timings table, in place of earlier ones."""
        blocks = self._blocks[cell] = blocks_of(rounds)
        self._rounds[cell] = Counter(row["block"] for row in rounds)
        self._names.update(blocks)
        self._first.update(list(blocks)[:1])
        self._ratios.add(cell, [b.ratio for b in blocks.values() if math.isfinite(b.ratio)])
        self._levels.add(cell, [b.online for b in blocks.values()])

    def rounds(self, a: str | None, b: str) -> int:
        """Number of rounds of b in the blocks shared with a; in all where it shares none, or without a."""
        mine = self._blocks.get(b, {})
        return sum(self._rounds[b][name] for name in mine.keys() & self._blocks.get(a or b, {}) or mine)

    def ratio(self, a: str | None, b: str) -> MeanEstimate | None:
        """The logarithm of the seconds of a query of b over those of a, or of the high-fidelity model without a.

        Cells of different groups are compared by their ratios to the high-fidelity model. `None` with fewer than two
        blocks.
        """
        within = self.ratio_within(a, b)
        return None if within is None else within.of_other_runs()

    def ratio_within(self, a: str | None, b: str) -> MeanEstimate | None:
        """`ratio` as further blocks of this run would measure it."""
        mine = self._blocks.get(b, {})
        if a is None:
            return self._estimate(self._ratios, [x.ratio for x in mine.values() if math.isfinite(x.ratio)])
        others = self._blocks.get(a, {})
        common = [(x, others[name]) for name, x in mine.items() if name in others]
        if common:
            return self._estimate(self._ratios, [x.online - y.online for x, y in common])
        apart = self.ratio_within(None, b), self.ratio_within(None, a)
        return None if apart[0] is None or apart[1] is None else apart[0].minus(apart[1])

    def level(self, a: str | None, b: str) -> MeanEstimate | None:
        """Logarithm of the seconds of a query of a, or of the high-fidelity model, in the blocks shared with b.

        If they share none, all blocks of a count. The estimate is for further blocks of this run: offline seconds come
        from other moments, so that callers add `CONDITIONS` where they compare both.
        """
        mine = self._blocks.get(b, {})
        if a is None:
            values = [x.online - x.ratio for x in mine.values() if math.isfinite(x.ratio)]
        else:
            others = self._blocks.get(a, {})
            values = [x.online for name, x in others.items() if name in mine] or [x.online for x in others.values()]
        return self._estimate(self._levels, values)

    def draws(self, a: str | None, b: str, rng: np.random.Generator) -> tuple[Array, Array]:
        """Seconds (`DRAWS`,) of a query of a, and quotients b over a, in other runs; NaN without two blocks of both."""
        level, ratio = self.level(a, b), self.ratio_within(a, b)
        if level is None or ratio is None:
            return np.full(DRAWS, np.nan), np.full(DRAWS, np.nan)
        # One draw for both: conditions that slow down a make the quotient b over a smaller.
        conditions = CONDITIONS * rng.standard_normal(DRAWS)
        return np.exp(level.draws(rng) + conditions), np.exp(ratio.draws(rng) - conditions)

    def _estimate(self, common: CommonVariance, values: Sequence[float]) -> MeanEstimate | None:
        count = len(values)
        if count < 2:
            return None
        typical, degrees = common.prior(len(self._names) - len(self._first))
        own = count - 1.0
        variance = (degrees * typical + own * _variance(values)) / (degrees + own)
        return MeanEstimate(float(np.mean(values)), math.sqrt(variance / count), degrees + own)
