"""Numbers that no table of a run has, computed from the problems: snapshots, cones, constants of b, the pressure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from study import DUAL

from vibench.arrays import Array
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces.problem import Problem
from vibench.interfaces.strategies import Cone, Stop
from vibench.reduction.cones import project_on_cone
from vibench.reduction.pod import POD, pod
from vibench.reduction.supremizers import isometric_supremizers, projected_supremizers
from vibench.study import registry
from vibench_problems.hertz import Hertz
from vibench_problems.line_contact import measured, theory

RANK = 1e-10
"""Singular values below this share of the largest do not count for a dimension."""


@dataclass(frozen=True)
class Snapshots:
    """High-fidelity solutions u (n×P) and λ (m×P) of a problem at its training parameters (P×d)."""

    problem: Problem
    training: Array
    u: Array
    lam: Array

    @classmethod
    def of(cls, problem: Problem) -> Snapshots:
        """Solve at every training parameter."""
        training, solver = problem.training_set(), HighFidelitySolver(problem)
        found = [solver.solve(mu) for mu in training]
        return cls(problem, training, np.column_stack([s.u for s in found]), np.column_stack([s.lam for s in found]))

    def cone(self, stop: Stop, dual: str = DUAL) -> Cone:
        """Cone of a dual strategy."""
        return registry.create("dual strategy", dual, {}).reduce(self.lam, self.problem.W, stop)

    def pod(self, size: int) -> POD:
        """The first modes, with the error for every number of modes."""
        return pod(self.u, self.problem.V, Stop(size=size))

    def modes(self, tolerance: float) -> int | None:
        """Modes of the POD for a tolerance."""
        return Stop(tolerance=tolerance).first_reached(self.errors)

    @cached_property
    def errors(self) -> Array:
        """Relative tails of the POD."""
        return self.pod(1).errors

    def supremizer_dimension(self, chi: Array) -> int:
        """Dimension of the sum of the spaces S_R(µ) over the training set, equation (20)."""
        loads = np.hstack([np.asarray(self.problem.constraint(mu)[0].T @ chi) for mu in self.training])
        loads = loads[np.any(loads != 0.0, axis=1)]
        sizes = np.linalg.svd(loads, compute_uv=False)
        return int(np.count_nonzero(sizes > RANK * sizes[0]))


def singular_values(problem: Problem, mu: Array, eta: Array | None = None) -> Array:
    """Singular values of b(mu) on V and the span of multipliers η (m×k), by default W; the extreme ones are c and β."""
    B = problem.constraint(mu)[0]
    basis = problem.W.unwhiten(np.eye(problem.W.dim)) if eta is None else problem.W.orthonormalise(eta)
    image = isometric_supremizers(problem.V, [B], basis.shape[1])
    return np.linalg.svd(image(B, basis), compute_uv=False)


def shares_without_enrichment(snapshots: Snapshots, modes: int, size: int, mus: Array) -> Array:
    """β_dec / β_HF over the span at parameters (k×d), for prescribed N and R."""
    problem = snapshots.problem
    Z, basis = snapshots.pod(modes).basis, problem.W.orthonormalise(snapshots.cone(Stop(size=size)).generators)
    shares = []
    for mu in mus:
        plain = np.linalg.svd(projected_supremizers(Z, problem.constraint(mu)[0], basis), compute_uv=False)
        shares.append(plain[-1] / singular_values(problem, mu)[-1])
    return np.array(shares)


def generator_lost(snapshots: Snapshots, size: int) -> float:
    """Largest distance of a generator of cpg from the cone of mcpg of the same size (Figure 1 for size 2)."""
    rays = snapshots.cone(Stop(size=size)).rays
    given = snapshots.cone(Stop(size=size), "cpg").generators
    return max(project_on_cone(rays, nu, snapshots.problem.W).distance for nu in given.T)


@dataclass(frozen=True)
class Pressure:
    """The contact at one radius.

    Attributes
    ----------
    half_width, peak
        a [m] and p₀ [Pa] of the elliptic pressure fitted to λ.
    width_difference, peak_difference
        Their relative differences from the theory of line contact at the same load.
    oscillation
        Largest distance of λ from the ellipse within 0.8 a, relative to p₀.
    violation
        Largest (B u − g)₊ over the macro length, relative to a.
    """

    half_width: float
    peak: float
    width_difference: float
    peak_difference: float
    oscillation: float
    violation: float

    @classmethod
    def at(cls, problem: Hertz, mu: Array, solution: HighFidelitySolution) -> Pressure:
        """Measure it on a high-fidelity solution."""
        fit, exact = measured(problem, mu, solution.lam), theory(problem, mu, solution.u)
        x = problem.points(mu)[0][0, problem.slave.zone[1::2]]
        inner = x < 0.8 * fit.half_width
        ellipse = fit.peak * np.sqrt(1.0 - (x[inner] / fit.half_width) ** 2)
        B, g = problem.constraint(mu)
        gap = float(((B @ solution.u - g) / problem.macro_lengths).max())
        return cls(
            fit.half_width,
            fit.peak,
            *fit.differences(exact),
            float(np.abs(solution.lam[inner] - ellipse).max()) / fit.peak,
            max(gap, 0.0) / fit.half_width,
        )


def pressures(problem: Hertz, radii: tuple[float, ...]) -> list[Pressure]:
    """The contact at several radii."""
    solver = HighFidelitySolver(problem)
    return [Pressure.at(problem, mu, solver.solve(mu)) for mu in np.array(radii)[:, None]]
