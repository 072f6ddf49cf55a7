"""Weak greedy training: solve where the error bound of the model of all solutions so far is largest."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt

from vibench import AdaptiveSampling, Array, ParameterBox, Trainer
from vibench_strategies.samplings.candidates import AMONG, Candidates

WEAK = 0.5
"""The worst bound is at least this share of all known ones, most of which are those of earlier models."""


class Greedy(AdaptiveSampling):
    """Weak greedy training (Haasdonk, Salomon and Wohlmuth 2012) over random subsets (Hesthaven, Stamm, Zhang 2014).

    Candidates are ranked by estimates; what is solved, and what ends it, has been bounded.
    The first candidates are grids: multipliers of nested contacts on one axis of the box leave thin differences, of
    which cones are made. `drawn` new candidates are evaluated for every solution, those that are farthest from all
    solutions and from each other among `AMONG` times as many: bounds grow away from solutions. It ends when all known
    bounds, and those of `checked` random candidates in a row, meet the tolerance: with 95 % confidence fewer than 3 in
    `checked` do not, or with `most`.
    """

    def __init__(
        self,
        candidates: Annotated[int, Ge(2), Le(1_000_000)],
        tolerance: Annotated[float, Gt(0.0), Lt(1.0)],
        seed: Annotated[int, Ge(0), Lt(2**63)] = 0,
        drawn: Annotated[int, Ge(1)] = 3,
        checked: Annotated[int, Ge(1)] = 100,
        most: Annotated[int, Ge(1)] = 1000,
    ) -> None:
        self.candidates, self.tolerance, self.seed = candidates, tolerance, seed
        self.drawn, self.checked, self.most = drawn, checked, most

    def parameters(self, box: ParameterBox) -> Array:
        """The candidates: the middle of the box, grids, each in at most half of them, then the sequence."""
        return Candidates(box, self.candidates, self.seed).mus

    def train(self, box: ParameterBox, trainer: Trainer) -> None:
        """Solve in the middle of the box, then where the bound is largest."""
        candidates = Candidates(box, self.candidates, self.seed)
        mus, solved, bounds = candidates.mus, [0], dict[int, float]()

        def judge(k: int) -> bool:
            """Take the estimate if it is above the tolerance; whether it is a bound, which alone can meet that."""
            estimate = trainer.estimate(mus[k])
            is_bound = estimate is None or estimate <= self.tolerance
            bounds[k] = trainer.bound(mus[k]) if estimate is None or is_bound else estimate
            return is_bound

        def far(count: int) -> list[int]:
            return candidates.draw_far(count, AMONG * self.drawn, solved)

        trainer.solve(mus[0])
        passed, is_random, new = 0, False, far(candidates.coarse + self.drawn)
        while len(solved) < self.most:
            for k in new:
                judge(k)
                passed = 0 if bounds[k] > self.tolerance else passed + int(is_random)
            if not bounds:
                return
            k, new = max(bounds, key=bounds.__getitem__), []
            is_bound = judge(k)  # of the present model
            if bounds[k] > self.tolerance and bounds[k] >= WEAK * max(bounds.values()):
                bounds[k] = bounds[k] if is_bound else trainer.bound(mus[k])
                if bounds[k] > self.tolerance:
                    trainer.solve(mus[k], bounds.pop(k))
                    solved.append(k)
                    passed, is_random, new = 0, False, far(self.drawn)
            elif max(bounds.values()) <= self.tolerance:
                if passed >= self.checked or not candidates:
                    return
                new, is_random = candidates.draw(self.drawn)
