"""Search for a jump of A, f, B or g along a line in the parameter domain, by bisection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from vibench.testing.comparisons import Arrays, peak

JUMP = 1e-3
"""Smallest jump that is found, relative to the largest entry of the array."""

WIDTH = 2.0**-30
"""Length in t that localises a jump; a continuous array that changes by `JUMP` over it has a slope of at least 1e6."""

PIECES = 4
"""Number of initial pieces."""

BUDGET = 130
"""Largest number of evaluations on one line; a kink is bisected, too, until its deviation is below `JUMP`."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece 0 ≤ left < right ≤ 1 of the line, with the arrays at its left end, in its middle and at its right end.

    The deviation is that of the middle from the mean of both ends, relative to the largest entry, of the array `name`
    that deviates most.
    """

    left: float
    right: float
    values: tuple[Arrays, Arrays, Arrays]
    name: str
    deviation: float


def find_jump(evaluate: Callable[[float], Arrays], scales: dict[str, float]) -> Piece | None:
    """A piece of length `WIDTH` at most on which an array jumps, `None` if no jump is found.

    The piece with the largest deviation is halved again and again. The deviation of a smooth array falls by 4 each
    time, that at a kink by 2; at a jump it stays half the jump. `evaluate` returns the arrays at t ∈ [0, 1]; `scales`
    names those that are examined, with their largest modulus.
    """

    def piece(left: float, right: float, first: Arrays, last: Arrays) -> Piece:
        middle = evaluate(0.5 * (left + right))
        deviations = {name: peak(middle[name] - 0.5 * (first[name] + last[name])) / scales[name] for name in scales}
        name = max(deviations, key=lambda name: deviations[name])
        return Piece(left, right, (first, middle, last), name, deviations[name])

    knots = [(k / PIECES, evaluate(k / PIECES)) for k in range(PIECES + 1)]
    pieces = [piece(left, right, first, last) for (left, first), (right, last) in pairwise(knots)]
    for _ in range((BUDGET - 2 * PIECES - 1) // 2):
        worst = max(pieces, key=lambda each: each.deviation)
        if worst.deviation < 0.5 * JUMP:
            return None
        if worst.right - worst.left <= WIDTH:
            return worst
        pieces.remove(worst)
        middle = 0.5 * (worst.left + worst.right)
        first, between, last = worst.values
        pieces += [piece(worst.left, middle, first, between), piece(middle, worst.right, between, last)]
    return None
