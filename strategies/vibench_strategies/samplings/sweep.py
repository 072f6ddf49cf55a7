"""A straight path through the box."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from vibench import Array, ParameterBox, RequestError, Sampling


class Sweep(Sampling):
    """Equidistant points on a straight path, in the order of the path.

    Parameters
    ----------
    size
        Number of points.
    parameter
        Name of the parameter that goes from its lower to its upper bound, the others being half-way between theirs; by
        default all go from their lower bounds to their upper ones.
    log
        Names of the parameters on a logarithmic scale.
    """

    ordered = True

    def __init__(
        self,
        size: Annotated[int, Ge(1), Le(100_000)],
        parameter: str = "",
        log: list[str] = [],  # noqa: B006  never changed
    ) -> None:
        self.size, self.parameter, self.log = size, parameter, log

    def parameters(self, box: ParameterBox) -> Array:
        """The points from the beginning of the path to its end."""
        places = np.full((self.size, box.dim), 0.5)
        moving = [box.index(self.parameter)] if self.parameter else range(box.dim)
        for i in moving:
            if not box.upper[i] > box.lower[i]:
                raise RequestError(f"'{box.names[i]}' has one value only; there is no path along it")
            places[:, i] = np.linspace(0.0, 1.0, self.size)
        return box.from_unit(places, self.log)
