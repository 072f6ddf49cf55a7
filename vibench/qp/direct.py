"""Solvers that take dense programs without qpsolvers, whose checks and conversions cost a third of a small program.

Every program gets a solver object of its own. Updating one object in place would save 3 of 215 µs with PIQP, and OSQP,
Clarabel and PIQP would keep what they adapted to the program before (step sizes, equilibration): their answers would
depend on what the process solved before, by up to 1e-5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality

BELOW_ALL = -1e30
"""DAQP's lower bound of a constraint that has none."""


class DirectSolution(NamedTuple):
    """What a solver returns, as `qpsolvers.Solution` names it; x (n,) and z (m,) are `None` where it found nothing."""

    x: Array | None
    z: Array | None
    found: bool
    extras: Mapping[str, Any]


def _piqp(program: VariationalInequality, **settings: Any) -> DirectSolution:
    import piqp  # noqa: PLC0415  an optional solver

    solver = piqp.DenseSolver()
    for name, value in settings.items():
        setattr(solver.settings, name, value)
    solver.setup(np.asfortranarray(program.A), -program.f, G=np.asfortranarray(program.B), h_u=program.g)
    status, result = solver.solve(), solver.result
    return DirectSolution(np.array(result.x), np.array(result.z_u), status == piqp.PIQP_SOLVED, {"info": result.info})


def _daqp(program: VariationalInequality, initvals: Array | None = None, **settings: Any) -> DirectSolution:
    import daqp  # noqa: PLC0415  an optional solver

    bounds = program.g, np.full(len(program.g), BELOW_ALL), np.zeros(len(program.g), dtype=np.int32)
    x, _, outcome, info = daqp.solve(program.A, -program.f, program.B, *bounds, primal_start=initvals, **settings)
    found = outcome > 0
    return DirectSolution(x if found else None, info["lam"] if found else None, found, {})


DIRECT: Mapping[str, Callable[..., DirectSolution]] = {"piqp": _piqp, "daqp": _daqp}
"""What solves min ½ xᵀA x − fᵀx, B x ≤ g with these solvers; their settings and a start are keywords."""
