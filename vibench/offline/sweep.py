"""High-fidelity solutions at some parameters, one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.problem import Problem


@dataclass(frozen=True)
class Snapshots:
    """High-fidelity solutions at some parameters.

    Attributes
    ----------
    mu
        Parameters (P×d).
    u, lam
        Columns u(mu) (n×P) and λ(mu) (m×P).
    """

    mu: Array
    u: Array
    lam: Array


def high_fidelity_sweep(problem: Problem, mus: Array) -> Snapshots:
    """High-fidelity solutions of a problem at parameters (P×d), one after the other."""
    solver = HighFidelitySolver(problem)
    solutions = [solver.solve(mu) for mu in mus]
    return Snapshots(mus, np.column_stack([s.u for s in solutions]), np.column_stack([s.lam for s in solutions]))
