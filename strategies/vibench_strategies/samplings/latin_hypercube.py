"""A Latin hypercube."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, Lt
from scipy.stats import qmc

from vibench import Array, ParameterBox, Sampling


class LatinHypercube(Sampling):
    """Latin hypercube (McKay, Beckman and Conover 1979): every parameter has one value in each of `size` intervals.

    Parameters
    ----------
    size
        Number of points.
    seed
        Seed of the permutations; another purpose should have another one.
    log
        Names of the parameters on a logarithmic scale, whose intervals are equal there.
    """

    def __init__(
        self,
        size: Annotated[int, Ge(1), Le(100_000)],
        seed: Annotated[int, Ge(0), Lt(2**63)],
        log: list[str] = [],  # noqa: B006  never changed
    ) -> None:
        self.size, self.seed, self.log = size, seed, log

    def parameters(self, box: ParameterBox) -> Array:
        """The points of one hypercube."""
        drawn = qmc.LatinHypercube(box.dim, rng=np.random.default_rng(self.seed)).random(self.size)
        return box.from_unit(drawn, self.log)
