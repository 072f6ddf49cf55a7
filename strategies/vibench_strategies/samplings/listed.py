"""Parameters that stand in the study file."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from annotated_types import MinLen

from vibench import Array, ParameterBox, RequestError, Sampling


class Listed(Sampling):
    """The points that the study file lists.

    Parameters
    ----------
    points
        A list of values for every point; of a single parameter its values alone will do.
    """

    def __init__(self, points: Annotated[list[float | list[float]], MinLen(1)]) -> None:
        self.points = points

    def parameters(self, box: ParameterBox) -> Array:
        """The points in their order."""
        rows = [point if isinstance(point, list) else [point] for point in self.points]
        for k, row in enumerate(rows):
            if len(row) != box.dim:
                names = ", ".join(box.names)
                raise RequestError(f"point {k} has {len(row)} values, expected one for each of {names}")
        return np.array(rows, dtype=float)
