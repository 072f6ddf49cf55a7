"""The elastic rope over an obstacle, after Haasdonk, Salomon and Wohlmuth (2012)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Le

from vibench import Array, Indices, InnerProduct, ParameterBox, Problem, Sampler, VariationalInequality

FIRM = 0.15
"""Elasticity ν₀ of the right half [N]."""


class Rope(Problem):
    """A rope between (0, 0) and (1, 0) over an obstacle with two hills; its left half has the elasticity mu_1.

    −(ν u')' = −1 + λ with ν = mu_1 on (0, ½) and ν₀ on (½, 1), under u ≥ h = −0.2 (sin πx − sin 3πx) − ½ + mu_2 x,
    λ ≥ 0 and λ (u − h) = 0. P1 displacements; multipliers in the basis dual to the hat functions, so that u ≥ h is
    imposed at the nodes.

    Parameters
    ----------
    half
        Number of elements per half.
    """

    parameters = ParameterBox(
        names=("elasticity", "tilt"), lower=np.array([0.05, -0.05]), upper=np.array([0.25, 0.5]), units=("N", "1")
    )
    constant: ClassVar[frozenset[str]] = frozenset({"f", "B"})
    entrywise: ClassVar[frozenset[str]] = frozenset({"A", "g"})

    def __init__(self, half: Annotated[int, Ge(2), Le(200)] = 100) -> None:
        self.step, nodes = 0.5 / half, 2 * half - 1
        self.x: Array = np.asarray(self.step * np.arange(1, nodes + 1), np.float64)
        difference = sp.diags_array([1.0, -1.0], offsets=[0, -1], shape=(nodes + 1, nodes)).tocsr()
        self._left, self._right = (part.T @ part / self.step for part in (difference[:half], difference[half:]))
        lumped = sp.diags_array(np.full(nodes, self.step)).tocsr()
        self._load, self._coupling = np.full(nodes, -self.step), -lumped  # the minus turns u ≥ h into B u ≤ g
        self.V, self.W = InnerProduct(self._left + self._right), InnerProduct(lumped)

    def training_set(self) -> Array:
        """The 10×10 grid."""
        return self.parameters.grid(10, 10)

    def obstacle(self, mu: Array, x: Array) -> Array:
        """Height h [m] of the obstacle at x, any shape."""
        return np.asarray(-0.2 * (np.sin(np.pi * x) - np.sin(3.0 * np.pi * x)) - 0.5 + mu[1] * x)

    def assemble(self, mu: Array) -> VariationalInequality:
        """A = mu_1 times the stiffness of the left half plus ν₀ times that of the right one; −Δx u ≤ −Δx h."""
        A = mu[0] * self._left + FIRM * self._right
        return VariationalInequality(A, self._load, self._coupling, -self.step * self.obstacle(mu, self.x))

    def sampler(self, wanted: Mapping[str, tuple[Indices, Indices]]) -> Sampler:
        """Entries of A and g."""
        places = wanted.get("A", (np.zeros(0, np.intp), np.zeros(0, np.intp)))
        left, right = (np.asarray(part[places]).ravel() for part in (self._left, self._right))
        x = self.x[wanted["g"][0]] if "g" in wanted else np.zeros(0)

        def sample(mu: Array) -> Mapping[str, Array]:
            entries = {"A": mu[0] * left + FIRM * right, "g": -self.step * self.obstacle(mu, x)}
            return {name: entries[name] for name in wanted}

        return sample
