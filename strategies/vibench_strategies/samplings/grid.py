"""A regular grid in the parameter box."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, MinLen

from vibench import Array, ParameterBox, RequestError, Sampling

MOST = 100_000
"""Most points of a grid."""


class Grid(Sampling):
    """Regular grid with the corners of the box; the last parameter varies fastest.

    Parameters
    ----------
    counts
        Points per parameter. A single count is for every parameter.
    log
        Names of the parameters on a logarithmic scale.
    """

    def __init__(
        self,
        counts: Annotated[list[Annotated[int, Ge(1), Le(MOST)]], MinLen(1)],
        log: list[str] = [],  # noqa: B006  never changed
    ) -> None:
        self.counts, self.log = counts, log

    def parameters(self, box: ParameterBox) -> Array:
        """The product of the points on every axis."""
        counts = self.counts * box.dim if len(self.counts) == 1 else self.counts
        if len(counts) != box.dim:
            raise RequestError(
                f"'counts' has {len(counts)} entries for the {box.dim} parameters {', '.join(box.names)}"
            )
        total = int(np.prod(counts, dtype=float))
        if total > MOST:
            raise RequestError(f"a grid of {total} points; expected at most {MOST}")
        points, unit = box.grid(*counts), np.meshgrid(*(np.linspace(0.0, 1.0, k) for k in counts), indexing="ij")
        scaled = box.from_unit(np.stack([places.ravel() for places in unit], axis=1), self.log)
        chosen = box.logarithmic(self.log)
        points[:, chosen] = scaled[:, chosen]
        return points
