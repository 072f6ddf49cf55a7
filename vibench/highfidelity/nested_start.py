"""Initial active sets of the high-fidelity solver from solutions on a coarser mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import KDTree

from vibench.arrays import Array, Mask
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.problem import Problem
from vibench.interfaces.validation import checked_assembly


class NestedStart:
    """The contact set of a problem on a coarser mesh, at the constraints of a finer one.

    The edge of a contact set moves by about one row of nodes in an iteration of the active set method. From the
    interpolated set it has to move by as many as there are on a coarse cell, however fine the mesh. A coarse problem
    with a `start` of its own makes a hierarchy: the iterations of a solution no longer grow with its mesh
    (nested iteration, Hackbusch 1985).

    Nothing is remembered from one parameter to the next: a start depends on the parameter alone.

    Parameters
    ----------
    coarse
        The problem on the coarser mesh, for the same parameters.
    coarse_points, points
        Places of the constraints (dim×M) and (dim×m), one for each row of B, on one reference domain.
    """

    def __init__(self, coarse: Problem, coarse_points: Array, points: Array) -> None:
        self._coarse = coarse
        self._nearest = np.asarray(KDTree(np.atleast_2d(coarse_points).T).query(np.atleast_2d(points).T)[1])
        self._solver: HighFidelitySolver | None = None

    def __call__(self, mu: Array) -> Mask:
        """The initial active set (m,) at mu (d,).

        Raises
        ------
        NumericalError
            If the coarse problem has no solution there.
        """
        if self._solver is None:
            self._solver = HighFidelitySolver(self._coarse)
        found = self._solver.solve_assembled(mu, checked_assembly(self._coarse, mu))
        return np.asarray((found.lam > 0.0)[self._nearest])

    def __getstate__(self) -> dict[str, Any]:
        """All but the solver, whose factorisations cannot be copied to another process."""
        return self.__dict__ | {"_solver": None}
