"""A Latin hypercube."""

from __future__ import annotations

import numpy as np

from vibench import Array
from vibench_strategies.samplings.drawn import Drawn


class LatinHypercube(Drawn):
    """Latin hypercube (McKay, Beckman and Conover 1979): every parameter has one value in each of `size` intervals.

    The seed is that of the permutations. The intervals of a parameter in `log` are equal on the logarithmic scale.
    """

    def drawn(self, dim: int) -> Array:
        """The points of one hypercube."""
        from scipy.stats import qmc  # noqa: PLC0415  slow, see `sobol`

        return np.asarray(qmc.LatinHypercube(dim, rng=np.random.default_rng(self.seed)).random(self.size))
