"""Independent uniformly distributed parameters."""

from __future__ import annotations

import numpy as np

from vibench import Array
from vibench_strategies.samplings.drawn import Drawn


class Random(Drawn):
    """Independent points, uniformly distributed in the box."""

    def drawn(self, dim: int) -> Array:
        """Independent points."""
        return np.random.default_rng(self.seed).random((self.size, dim))
