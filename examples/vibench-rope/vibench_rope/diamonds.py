"""A convex set of multipliers of one's own: pairs of rows with |λ₁| + |λ₂| ≤ c."""

from __future__ import annotations

import numpy as np

from vibench import Array, BlockKind, Blocks, Indices


class Diamonds(Blocks):
    """Pairs (b×2) of rows with |λ₁| + |λ₂| ≤ c: friction that yields along one of two axes at a time.

    The support function is σ(y) = c max(|y₁|, |y₂|). Discs of the same radii contain the diamonds.
    """

    def __init__(self, rows: Indices, radii: Array) -> None:
        super().__init__(BlockKind.OTHER, rows, radii)

    def support(self, values: Array) -> Array:
        """c max(|y₁|, |y₂|) of values (m,)."""
        return np.asarray(self.radii * np.abs(values[self.rows]).max(axis=1))

    def gauge(self, lam: Array) -> Array:
        """(|λ₁| + |λ₂|) / c of λ (m,)."""
        return np.asarray(np.abs(lam[self.rows]).sum(axis=1) / self.radii)

    def project(self, values: Array) -> Array:
        """The nearest points (b×2) of the diamonds."""
        inside, sizes = values[self.rows], np.abs(values[self.rows])
        # Both sizes shrink by half of what their sum has too much; a corner is nearest where the smaller one vanishes.
        excess = np.maximum(sizes.sum(axis=1) - self.radii, 0.0)
        corner = sizes.min(axis=1) < 0.5 * excess
        shrunk = np.maximum(sizes - np.where(corner, sizes.max(axis=1) - self.radii, 0.5 * excess)[:, None], 0.0)
        # Round-off must not leave a point outside.
        total = np.maximum(shrunk.sum(axis=1), np.asarray(self.radii))
        return np.asarray(np.copysign(shrunk * (self.radii / total * (1.0 - 4e-16))[:, None], inside))
