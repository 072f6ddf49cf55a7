"""Errors of reduced solutions against high-fidelity ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.qp.scaling import ratio


@dataclass(frozen=True)
class Reference:
    """High-fidelity solutions, columns of u (n×P) and λ (m×P), and the floors of the relative errors.

    The floors are 1e-12 of the largest training norms: below them a solution counts as zero.
    """

    u: Array
    lam: Array
    floor_u: float
    floor_lam: float

    def at(self, numbers: Sequence[int]) -> Reference:
        """The solutions at some of the parameters."""
        return Reference(self.u[:, numbers], self.lam[:, numbers], self.floor_u, self.floor_lam)


@dataclass(frozen=True)
class Errors:
    """Errors of one reduced solution against the high-fidelity one at the same parameter, named as in the results.

    Attributes
    ----------
    error_u, error_lambda, error_energy
        Relative, in the norms of V, of W and of A(mu).
    error_u_absolute, error_lambda_absolute
        The first two without the division.
    violation
        Largest (B u_N − g)₊, each row over the integral of its multiplier function [unit of u].
    complementarity
        λᵀ(B u_N − g) with the high-fidelity multiplier; with λ_N it would only repeat the gap of the QP solver.
    """

    error_u: float
    error_lambda: float
    error_energy: float
    error_u_absolute: float
    error_lambda_absolute: float
    violation: float
    complementarity: float


def relative_to(problem: Problem, reference: Reference) -> tuple[Array, Array]:
    """Denominators of the relative errors (P,): the norms of the solutions in V and in W, not below the floors."""
    norm_u = np.maximum(problem.V.norm(reference.u), reference.floor_u)
    return norm_u, np.maximum(problem.W.norm(reference.lam), reference.floor_lam)


def errors(
    problem: Problem, vis: Sequence[VariationalInequality], reference: Reference, u: Array, lam: Array
) -> list[Errors]:
    """Errors of reduced u (n×P) and λ (m×P), column by column at the parameters of `vis`."""
    V, W = problem.V, problem.W
    du, dlam = u - reference.u, lam - reference.lam
    norm_u, norm_lam = relative_to(problem, reference)
    error_u, error_lam, integrals = V.norm(du), W.norm(dlam), problem.multiplier_integrals()
    excesses = [vi.B @ u[:, k] - vi.g for k, vi in enumerate(vis)]
    return [
        Errors(
            error_u=ratio(float(error_u[k]), float(norm_u[k])),
            error_lambda=ratio(float(error_lam[k]), float(norm_lam[k])),
            error_energy=ratio(_energy(vi, du[:, k]), _energy(vi, reference.u[:, k])),
            error_u_absolute=float(error_u[k]),
            error_lambda_absolute=float(error_lam[k]),
            violation=float(np.max(excesses[k] / integrals, initial=0.0)),
            complementarity=float(reference.lam[:, k] @ excesses[k]),
        )
        for k, vi in enumerate(vis)
    ]


def _energy(vi: VariationalInequality, u: Array) -> float:
    return float(np.sqrt(max(float(u @ (vi.A @ u)), 0.0)))
