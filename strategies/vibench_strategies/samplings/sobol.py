"""Points of a scrambled Sobol sequence."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, Lt
from scipy.stats import qmc

from vibench import Array, ParameterBox, Sampling


class Sobol(Sampling):
    """The first points of a Sobol sequence with Owen's scrambling (Owen 1998); balanced where `size` is a power of two.

    Parameters
    ----------
    size
        Number of points.
    seed
        Seed of the scrambling; another purpose should have another one.
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
        """The points in the order of the sequence."""
        sequence = qmc.Sobol(box.dim, rng=np.random.default_rng(self.seed))
        # Any other number of points at once is a warning; the first ones of the next power are the same.
        return box.from_unit(sequence.random_base2((self.size - 1).bit_length())[: self.size], self.log)
