"""The elastic rope over an obstacle, after Haasdonk, Salomon and Wohlmuth (2012)."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Le

from vibench import AffineProblem, Array, InnerProduct, ParameterBox

FIRM = 0.15
"""Elasticity ν₀ of the right half [N]."""


class Rope(AffineProblem):
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

    def __init__(self, half: Annotated[int, Ge(2), Le(200)] = 100) -> None:
        self.step, nodes = 0.5 / half, 2 * half - 1
        self.x: Array = np.asarray(self.step * np.arange(1, nodes + 1), np.float64)
        difference = sp.diags_array([1.0, -1.0], offsets=[0, -1], shape=(nodes + 1, nodes)).tocsr()
        left, right = (part.T @ part / self.step for part in (difference[:half], difference[half:]))
        lumped = sp.diags_array(np.full(nodes, self.step)).tocsr()
        self.V, self.W = InnerProduct(left + right), InnerProduct(lumped)
        hills = -0.2 * (np.sin(np.pi * self.x) - np.sin(3.0 * np.pi * self.x)) - 0.5
        self.declare(
            A=[("elasticity", left), (FIRM, right)],
            f=np.full(nodes, -self.step),
            B=-lumped,  # the minus turns u ≥ h into B u ≤ g
            g=[(1.0, -self.step * hills), ("tilt", -self.step * self.x)],
        )

    def training_set(self) -> Array:
        """The 10×10 grid."""
        return self.parameters.grid(10, 10)
