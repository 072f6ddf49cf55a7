"""What rounds of timing measure, and the columns of rounds, cells and queries that are made of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean, median

import numpy as np

from vibench.arrays import Array
from vibench.results.paired_timing import blocks_of, mean_seconds
from vibench.stages.base import Row
from vibench.timing import DISTURBED, Seconds

CELL_SECONDS = (
    "online_s", "online_q1_s", "online_q3_s", "online_wall_s", "online_assemble_s", "online_solve_s",
    "online_certify_s", "slowdown", "disturbed",
)  # fmt: skip
"""Columns of a cell that follow from its rounds."""


@dataclass(frozen=True)
class TimedRound:
    """One round of one cell: seconds of its queries by their number, and how slow the machine was beside them."""

    assemble: Mapping[int, Seconds]
    """Seconds of the assembly; in full, of some of the queries, which count for all."""
    solve: Mapping[int, Seconds]
    """Seconds of the solver."""
    slowdown: float
    """Slowdown of the calibration before or after it, whichever is larger."""
    certify: Mapping[int, Seconds] = field(default_factory=dict)
    """Seconds of the certificate; nothing without one."""
    beside: Seconds | None = None
    """Mean seconds of the high-fidelity solutions beside the queries, their assembly included."""

    @property
    def cpu(self) -> float:
        """CPU seconds of a query, mean over those of the round."""
        return float(round_columns(self)["total_s"])

    @property
    def beside_cpu(self) -> float:
        """CPU seconds of a high-fidelity solution; NaN without one."""
        return np.nan if self.beside is None else self.beside.cpu


@dataclass(frozen=True)
class TimedCell:
    """The rounds of one cell by their number, the machine that timed them, and why rounds are missing, or ""."""

    rounds: Mapping[int, TimedRound]
    machine: str
    lost: int = 0
    reason: str = ""


def round_columns(one: TimedRound) -> Row:
    """Seconds of the parts of a query and of the whole, means over the queries of a round."""
    return _columns(*(_of_all(fmean, parts.values()) for parts in (one.assemble, one.solve, one.certify)))


def _of_all(average: Callable[[Sequence[float]], float], parts: Iterable[Seconds]) -> Array | None:
    """Average CPU and wall seconds (2,); `None` of none."""
    every = [(seconds.cpu, seconds.wall) for seconds in parts]
    return np.array([average(column) for column in zip(*every, strict=True)]) if every else None


def _columns(assemble: Array | None, solve: Array | None, certify: Array | None) -> Row:
    """The columns that rounds and queries share, from CPU and wall seconds of the parts of a query (2,)."""
    parts = {"assemble_s": assemble, "solve_s": solve, "certify_s": certify}
    total, wall = sum((part for part in parts.values() if part is not None), np.zeros(2))
    seconds = {name: None if part is None else part[0] for name, part in parts.items()}
    return seconds | {"total_s": total, "total_wall_s": wall}


def seconds_of_cell(rows: Sequence[Row]) -> Row:
    """The columns of a cell from its rounds; empty without any.

    Seconds of a query and of a high-fidelity solution are geometric means over the blocks of medians over their rounds,
    so that their quotient is the paired one; the others are medians and quartiles over all rounds.
    """
    if not rows:
        return dict.fromkeys(CELL_SECONDS)
    total, wall, slowdown = (np.array([row[name] for row in rows]) for name in ("total_s", "total_wall_s", "slowdown"))
    certified = [row["certify_s"] for row in rows if row["certify_s"] is not None]
    low, high = np.quantile(total, (0.25, 0.75))
    online, high_fidelity = mean_seconds(blocks_of(rows).values())
    return {
        "online_s": online,
        "online_q1_s": low,
        "online_q3_s": high,
        "online_wall_s": np.median(wall),
        "online_assemble_s": np.median([row["assemble_s"] for row in rows]),
        "online_solve_s": np.median([row["solve_s"] for row in rows]),
        "online_certify_s": np.median(certified) if certified else None,
        "slowdown": np.median(slowdown),
        "disturbed": int(np.median(slowdown) > DISTURBED),
    } | ({} if high_fidelity is None else {"hf_s": high_fidelity})


def seconds_of_queries(rounds: Sequence[TimedRound]) -> dict[int, Row]:
    """The columns of the queries that were timed: medians over the rounds."""
    rows = {}
    for k in sorted({k for one in rounds for k in one.solve}):
        # In full, a query is not assembled in every round: the other queries' seconds stand for its own.
        assembled = [one.assemble[k] if k in one.assemble else next(iter(one.assemble.values())) for one in rounds]
        solved = [one.solve[k] for one in rounds if k in one.solve]
        certified = [one.certify[k] for one in rounds if k in one.certify]
        rows[k] = _columns(*(_of_all(median, parts) for parts in (assembled, solved, certified)))
    return rows
