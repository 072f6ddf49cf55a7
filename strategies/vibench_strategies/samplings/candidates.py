"""Candidates of greedy training: coarse grids before a sequence that fills the box."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from vibench import ParameterBox
from vibench_strategies.samplings.sobol import Sobol

LEVELS = 3, 5
"""Points per parameter of the grids: the second one refines the first one."""

AMONG = 8
"""Candidates that are drawn are the farthest ones among so many times as many."""


class Candidates:
    """The middle of the box, grids of at most half of all candidates, and Sobol points; grids are drawn first.

    Attributes
    ----------
    mus
        Different parameters (P×d), P at most `count`; the first one is the middle, which is not drawn.
    coarse
        How many of them are on the coarse grid, the middle left out; none where there is no grid.
    """

    def __init__(self, box: ParameterBox, count: int, seed: int) -> None:
        grids = [box.grid(*[n] * box.dim) for n in LEVELS if n**box.dim <= count // 2]
        parts = [(box.lower + (box.upper - box.lower) / 2.0)[None], *grids, Sobol(count, seed).parameters(box)]
        mus = np.vstack(parts)
        kept = np.sort(np.unique(mus, axis=0, return_index=True)[1])[:count]
        ends = [int(np.count_nonzero(kept < end)) for end in np.cumsum([len(part) for part in parts])]
        rng = np.random.default_rng(seed)
        self.mus = mus[kept]
        self._places = box.to_unit(self.mus)
        self._unseen = [(begin + rng.permutation(end - begin)).tolist() for begin, end in pairwise(ends)]
        self.coarse = len(self._unseen[0]) if grids else 0

    def __bool__(self) -> bool:
        """Whether there are any that were not drawn."""
        return any(self._unseen)

    def draw_far(self, count: int, among: int, known: Sequence[int]) -> list[int]:
        """Numbers of candidates far from known ones and each other: the farthest of some, one after the other."""
        drawn = list[int]()
        for part in self._unseen:
            while part and len(drawn) < count:
                near, turn = self._places[[*known, *drawn]], part[-among:]
                away = np.linalg.norm(self._places[turn, None] - near, axis=2).min(axis=1)
                drawn.append(part.pop(int(np.argmax(away)) - len(turn)))
        return drawn

    def draw(self, count: int) -> tuple[list[int], bool]:
        """Numbers of candidates, and whether they are random: from the end of the order that `draw_far` leaves."""
        part = next(filter(None, self._unseen))
        return [part.pop(0) for _ in range(min(count, len(part)))], part is self._unseen[-1]
