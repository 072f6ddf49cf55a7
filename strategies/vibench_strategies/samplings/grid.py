"""A regular grid in the parameter box, or around its middle."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le, MinLen

from vibench import Array, ParameterBox, RequestError, Sampling

MOST = 100_000
"""Most points of a grid."""


class Grid(Sampling):
    """Regular grid with the corners of the box, or of a part of it; the last parameter varies fastest.

    Parameters
    ----------
    counts
        Points per parameter. A single count is for every parameter.
    log
        Names of the parameters on a logarithmic scale.
    share
        Share of the width of every parameter, on its scale, that the grid spans around the middle of the box: trained
        on less than all of it, models are asked outside of where they were trained.
    """

    def __init__(
        self,
        counts: Annotated[list[Annotated[int, Ge(1), Le(MOST)]], MinLen(1)],
        log: list[str] = [],  # noqa: B006  never changed
        share: Annotated[float, Gt(0.0), Le(1.0)] = 1.0,
    ) -> None:
        self.counts, self.log, self.share = counts, log, share

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
        low, high = 0.5 * (1.0 - self.share), 0.5 * (1.0 + self.share)
        points, unit = box.grid(*counts), np.meshgrid(*(np.linspace(low, high, k) for k in counts), indexing="ij")
        scaled = box.from_unit(np.stack([places.ravel() for places in unit], axis=1), self.log)
        chosen = box.logarithmic(self.log) if self.share == 1.0 else slice(None)
        points[:, chosen] = scaled[:, chosen]
        return points
