"""Loadings in steps."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, Lt

from vibench import Array, ParameterBox, Sampling


class LoadSteps(Sampling):
    """One parameter rises in equal steps from its lower to its upper bound, again and again; others change in between.

    Parameters
    ----------
    parameter
        Name of the parameter that rises, such as a load.
    loadings
        How often it rises. The other parameters are drawn anew for each loading, uniformly in the box.
    steps
        Points of a loading, both bounds included.
    seed
        Seed of the other parameters.
    """

    ordered = True

    def __init__(
        self,
        parameter: str,
        loadings: Annotated[int, Ge(1), Le(10_000)],
        seed: Annotated[int, Ge(0), Lt(2**63)],
        steps: Annotated[int, Ge(2), Le(10_000)] = 10,
    ) -> None:
        self.parameter, self.loadings, self.seed, self.steps = parameter, loadings, seed, steps

    def parameters(self, box: ParameterBox) -> Array:
        """The points of one loading after the other (loadings · steps × d)."""
        places = np.random.default_rng(self.seed).random((self.loadings, box.dim)).repeat(self.steps, axis=0)
        places[:, box.index(self.parameter)] = np.tile(np.linspace(0.0, 1.0, self.steps), self.loadings)
        return box.from_unit(places)
