"""Jumps of a parametrised value along a line, found by bisection."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count

from vibench.testing.comparisons import Members, difference, peak

JUMP = 1e-3
"""Smallest jump that is looked for, relative to the largest entry of a member."""

WIDTH = 2.0**-30
"""Share of a line on which a jump has to take place; what changes there by `JUMP` has a slope of 1e6 at least."""

PIECES = 4
"""Pieces of the line looked at first."""

BUDGET = 130
"""Values asked for on one line at most: a kink is bisected, too, until it proves to be continuous."""


@dataclass(frozen=True)
class Jump:
    """A member that jumps between two points 0 ≤ left < right ≤ 1 of a line, and by what."""

    member: str
    left: float
    right: float
    what: str


@dataclass(frozen=True, order=True)
class _Piece:
    """A piece of the line; first comes what is farthest from linear, relative to the largest entries."""

    order: tuple[float, int]
    left: float = field(compare=False)
    right: float = field(compare=False)
    values: tuple[Members, Members, Members] = field(compare=False)
    member: str = field(compare=False)


def find_jump(evaluate: Callable[[float], Members], scales: dict[str, float]) -> Jump | None:
    """The jump of some members on the line t ∈ [0, 1], `None` if every one met on the way proved continuous.

    The piece on which the middle is farthest from the mean of both ends is halved again and again. Where a member is
    smooth that distance falls by 4 each time, at a kink by 2, at a jump it is half the jump for ever.

    Parameters
    ----------
    evaluate
        Members at t; those named in `scales` are looked at.
    scales
        Largest modulus of every member, positive.
    """
    numbers = count()

    def piece(left: float, right: float, first: Members, last: Members) -> _Piece:
        middle = evaluate(0.5 * (left + right))
        bends = {name: peak(middle[name] - 0.5 * (first[name] + last[name])) / scale for name, scale in scales.items()}
        member = max(bends, key=lambda name: bends[name])
        return _Piece((-bends[member], next(numbers)), left, right, (first, middle, last), member)

    knots = [k / PIECES for k in range(PIECES + 1)]
    values = [evaluate(t) for t in knots]
    pieces = [piece(knots[k], knots[k + 1], values[k], values[k + 1]) for k in range(PIECES)]
    heapq.heapify(pieces)
    for _ in range((BUDGET - 2 * PIECES - 1) // 2):
        worst = heapq.heappop(pieces)
        if -worst.order[0] < 0.5 * JUMP:
            return None
        first, middle, last = worst.values
        if worst.right - worst.left <= WIDTH:
            what = difference(first[worst.member], last[worst.member])
            return Jump(worst.member, worst.left, worst.right, what)
        half = 0.5 * (worst.left + worst.right)
        heapq.heappush(pieces, piece(worst.left, half, first, middle))
        heapq.heappush(pieces, piece(half, worst.right, middle, last))
    return None
