"""A random walk in the box."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from vibench import Array
from vibench_strategies.samplings.drawn import Drawn


class RandomWalk(Drawn):
    """Random walk with normal steps, from the middle of the box, reflected at its faces.

    Parameters
    ----------
    size
        Number of points.
    seed
        Seed of the steps; another purpose should have another one.
    step
        Standard deviation of a step in every direction, relative to the width of the box.
    log
        Names of the parameters on a logarithmic scale.
    """

    ordered = True

    def __init__(
        self,
        size: Annotated[int, Ge(1), Le(100_000)],
        seed: Annotated[int, Ge(0), Lt(2**63)],
        step: Annotated[float, Gt(0.0), Le(1.0)] = 0.05,
        log: list[str] = [],  # noqa: B006  never changed
    ) -> None:
        super().__init__(size, seed, log)
        self.step = step

    def drawn(self, dim: int) -> Array:
        """The walk in the unit cube: that in the whole space, folded."""
        steps = self.step * np.random.default_rng(self.seed).standard_normal((self.size, dim))
        steps[0] = 0.5
        return np.asarray(1.0 - np.abs(1.0 - np.mod(np.cumsum(steps, axis=0), 2.0)))
