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

FAR_BOUND = 1e30
"""DAQP's bound of what has none on this side."""


class DirectSolution(NamedTuple):
    """What a solver returns, as `qpsolvers.Solution` names it; x (n,) and z (m,) are `None` where it found nothing."""

    x: Array | None
    z: Array | None
    found: bool
    extras: Mapping[str, Any]


def _piqp(program: VariationalInequality, bounds: bool = False, **settings: Any) -> DirectSolution:
    import piqp  # noqa: PLC0415  an optional solver

    solver = piqp.DenseSolver()
    for name, value in settings.items():
        setattr(solver.settings, name, value)
    if bounds:
        solver.setup(np.asfortranarray(program.A), -program.f, x_l=-program.g)
    else:
        solver.setup(np.asfortranarray(program.A), -program.f, G=np.asfortranarray(program.B), h_u=program.g)
    status, result = solver.solve(), solver.result
    z = np.array(result.z_bl if bounds else result.z_u)
    return DirectSolution(np.array(result.x), z, status == piqp.PIQP_SOLVED, {"info": result.info})


def _daqp(
    program: VariationalInequality, bounds: bool = False, initvals: Array | None = None, **settings: Any
) -> DirectSolution:
    import daqp  # noqa: PLC0415  an optional solver

    B, lower, upper = program.B, np.full(len(program.g), -FAR_BOUND), program.g
    if bounds:  # of a program without other constraints
        B, lower, upper = np.zeros((0, len(program.g))), -program.g, np.full(len(program.g), FAR_BOUND)
    kinds = np.zeros(len(program.g), dtype=np.int32)
    x, _, outcome, info = daqp.solve(program.A, -program.f, B, upper, lower, kinds, primal_start=initvals, **settings)
    if outcome <= 0:
        return DirectSolution(None, None, found=False, extras={})
    return DirectSolution(x, -info["lam"] if bounds else info["lam"], found=True, extras={})


DIRECT: Mapping[str, Callable[..., DirectSolution]] = {"piqp": _piqp, "daqp": _daqp}
"""What solves min ½ xᵀA x − fᵀx, B x ≤ g with these solvers; their settings and a start are keywords.

Where `bounds` is said B is minus the identity: bounds take these solvers less time than rows.
"""
