"""Weak greedy training: solve where the error bound of the model of all solutions so far is worst."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from vibench import AdaptiveSampling, Array, ParameterBox, Trainer
from vibench_strategies.samplings.sobol import Sobol

WEAK = 0.8
"""The worst bound is at least this share of all known ones, which are those of earlier models."""


class Greedy(AdaptiveSampling):
    """Weak greedy training (Haasdonk, Salomon and Wohlmuth 2012) with a saturated pool (Hesthaven, Stamm, Zhang 2014).

    The candidates are a Sobol sequence; a pool of those whose relative bound exceeds the tolerance is filled at random.
    It ends when none is left and `checked` candidates in a row met the tolerance: with 95 % confidence fewer than 3 in
    `checked` do not. `most` bounds the number of solutions.
    """

    def __init__(
        self,
        candidates: Annotated[int, Ge(2), Le(1_000_000)],
        tolerance: Annotated[float, Gt(0.0), Lt(1.0)],
        seed: Annotated[int, Ge(0), Lt(2**63)] = 0,
        pool: Annotated[int, Ge(1)] = 32,
        checked: Annotated[int, Ge(1)] = 100,
        most: Annotated[int, Ge(1)] = 1000,
    ) -> None:
        self.candidates, self.tolerance, self.seed = candidates, tolerance, seed
        self.pool, self.checked, self.most = pool, checked, most

    def parameters(self, box: ParameterBox) -> Array:
        """The candidates."""
        return Sobol(self.candidates, self.seed).parameters(box)

    def train(self, box: ParameterBox, trainer: Trainer) -> None:
        """Solve near the middle of the box, then where the bound is worst."""
        mus, width, above = self.parameters(box), np.maximum(box.upper - box.lower, 1e-300), dict[int, float]()
        trainer.solve(mus[np.linalg.norm((mus - (box.lower + box.upper) / 2.0) / width, axis=1).argmin()])
        unseen, solved, passed = np.random.default_rng(self.seed).permutation(len(mus)).tolist(), 1, 0
        while solved < self.most:
            while len(above) < self.pool and passed < self.checked and unseen:
                if (bound := trainer.bound(mus[k := unseen.pop()])) > self.tolerance:
                    above[k], passed = bound, 0
                else:
                    passed += 1
            if not above:
                return
            k = max(above, key=above.__getitem__)
            above[k] = trainer.bound(mus[k])  # of the present model
            if above[k] <= self.tolerance:
                del above[k]
            elif above[k] >= WEAK * max(above.values()):
                trainer.solve(mus[k], above.pop(k))
                solved, passed = solved + 1, 0
