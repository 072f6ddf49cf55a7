"""Initial active sets of the high-fidelity solver from solutions on a coarser mesh."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from vibench.arrays import Array, Indices
from vibench.interfaces.problem import Problem


class NestedStart:
    """A problem on a coarser mesh, whose contact set is the initial one at the constraints of a finer mesh.

    The edge of a contact set moves by about one row of nodes in an iteration of the active set method. From the
    interpolated set it has to move by as many as there are on a coarse cell, however fine the mesh. A coarse problem
    with a `start` of its own makes a hierarchy: the iterations of a solution no longer grow with its mesh
    (nested iteration, Hackbusch 1985).

    Parameters
    ----------
    coarse
        The problem on the coarser mesh, for the same parameters.
    coarse_points, points
        Places of the constraints (dim×M) and (dim×m), one for each row of B, on one reference domain.
    """

    def __init__(self, coarse: Problem, coarse_points: Array, points: Array) -> None:
        self.coarse, self._coarse_points, self._points = coarse, np.atleast_2d(coarse_points), np.atleast_2d(points)

    @cached_property
    def nearest(self) -> Indices:
        """The nearest coarse constraint of every fine one (m,)."""
        return np.asarray(KDTree(self._coarse_points.T).query(self._points.T)[1])
