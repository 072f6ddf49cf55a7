"""Points of a scrambled Sobol sequence."""

from __future__ import annotations

import numpy as np
from scipy.stats import qmc

from vibench import Array
from vibench_strategies.samplings.drawn import Drawn


class Sobol(Drawn):
    """The first points of a Sobol sequence with Owen's scrambling (Owen 1998); balanced where `size` is a power of two.

    The seed is that of the scrambling.
    """

    def drawn(self, dim: int) -> Array:
        """The points in the order of the sequence."""
        sequence = qmc.Sobol(dim, rng=np.random.default_rng(self.seed))
        # Any other number of points at once is a warning; the first ones of the next power are the same.
        return np.asarray(sequence.random_base2((self.size - 1).bit_length())[: self.size])
