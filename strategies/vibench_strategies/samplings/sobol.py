"""Points of a scrambled Sobol sequence."""

from __future__ import annotations

import numpy as np

from vibench import Array
from vibench_strategies.samplings.drawn import Drawn


class Sobol(Drawn):
    """The first points of a Sobol sequence (Sobol' 1967), scrambled; balanced where `size` is a power of two.

    SciPy scrambles by random lower triangular matrices and a random digital shift (Matoušek 1998); the seed is theirs.
    """

    def drawn(self, dim: int) -> Array:
        """The points in the order of the sequence."""
        # Whoever lists plugins or reads a study imports this module, and scipy.stats takes half a second.
        from scipy.stats import qmc  # noqa: PLC0415

        sequence = qmc.Sobol(dim, rng=np.random.default_rng(self.seed))
        # Any other number of points at once is a warning; the first ones of the next power are the same.
        return np.asarray(sequence.random_base2((self.size - 1).bit_length())[: self.size])
