"""Candidates of greedy training: coarse grids before a sequence that fills the box."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from vibench import Array, ParameterBox
from vibench_strategies.samplings.sobol import Sobol

LEVELS = 3, 5
"""Points per parameter of the grids: the second one refines the first one."""


def nested_candidates(box: ParameterBox, count: int, seed: int) -> tuple[Array, tuple[int, int], list[int]]:
    """Different parameters (P×d), P ≤ `count`: the middle of the box, grids of at most half of them, Sobol points.

    Returned with how many there are up to the end of the coarse grid, or of the middle where there is none, and of all
    grids; and with the order in which all but the middle are taken, from its end: of each part at random, grids first.
    """
    grids = [box.grid(*[n] * box.dim) for n in LEVELS if n**box.dim <= count // 2]
    parts = [(box.lower + (box.upper - box.lower) / 2.0)[None], *grids, Sobol(count, seed).parameters(box)]
    mus = np.vstack(parts)
    kept = np.sort(np.unique(mus, axis=0, return_index=True)[1])[:count]
    ends = [int(np.count_nonzero(kept < end)) for end in np.cumsum([len(part) for part in parts])]
    rng, order = np.random.default_rng(seed), list[int]()
    for begin, end in pairwise(ends):
        order = [*(begin + rng.permutation(end - begin)), *order]
    return mus[kept], (ends[min(len(grids), 1)], ends[-2]), order
