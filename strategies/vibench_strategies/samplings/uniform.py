"""Independent uniformly distributed parameters."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, Lt

from vibench import Array, ParameterBox, Sampling


class Random(Sampling):
    """Independent points, uniformly distributed in the box.

    Parameters
    ----------
    size
        Number of points.
    seed
        Seed of the generator; another purpose should have another one.
    log
        Names of the parameters on a logarithmic scale.
    """

    def __init__(
        self,
        size: Annotated[int, Ge(1), Le(100_000)],
        seed: Annotated[int, Ge(0), Lt(2**63)],
        log: list[str] = [],  # noqa: B006  never changed
    ) -> None:
        self.size, self.seed, self.log = size, seed, log

    def parameters(self, box: ParameterBox) -> Array:
        """The points in the order in which they are drawn."""
        return box.from_unit(np.random.default_rng(self.seed).random((self.size, box.dim)), self.log)
