"""Assessment of a query: errors and inf-sup constants. Nothing here is timed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array, SparseMatrix
from vibench.infsup import InfSup, Multipliers, inf_sup, inf_sup_on
from vibench.problem import Problem, VariationalInequality
from vibench.space import InnerProduct
from vibench.supremizer import ConstraintClasses, constraint_classes, supremizer_images


@dataclass(frozen=True)
class Reference:
    """High-fidelity solution u (n,), λ (m,) at one parameter, and the floors of the relative errors.

    The floors are 1e-12 of the largest training norms: below them a solution counts as zero.
    """

    u: Array
    lam: Array
    floor_u: float
    floor_lam: float


@dataclass(frozen=True)
class Errors:
    """How far a reduced solution is from the high-fidelity one at the same parameter.

    Attributes
    ----------
    u, lam, energy
        Relative, in the norms of V, of W and of A(mu).
    absolute_u, absolute_lam
        The first two before they are divided.
    violation
        Largest (B u_N − g)₊, each row over the integral of its multiplier function [unit of u].
    complementarity
        λᵀ(B u_N − g) with the high-fidelity multiplier.
    """

    u: float
    lam: float
    energy: float
    absolute_u: float
    absolute_lam: float
    violation: float
    complementarity: float


def errors(problem: Problem, vi: VariationalInequality, reference: Reference, u: Array, lam: Array) -> Errors:
    """Errors of a reduced u (n,) and λ (m,) at the parameter of `vi`."""
    V, W = problem.V, problem.W
    du, dlam = u - reference.u, lam - reference.lam
    norm_u = max(float(V.norm(reference.u)), reference.floor_u)
    norm_lam = max(float(W.norm(reference.lam)), reference.floor_lam)
    energy = np.sqrt(max(float(reference.u @ (vi.A @ reference.u)), 0.0))
    excess = vi.B @ u - vi.g
    error_u, error_lam = float(V.norm(du)), float(W.norm(dlam))
    return Errors(
        u=_over(error_u, norm_u),
        lam=_over(error_lam, norm_lam),
        energy=_over(np.sqrt(max(float(du @ (vi.A @ du)), 0.0)), energy),
        absolute_u=error_u,
        absolute_lam=error_lam,
        violation=float(np.max(excess / problem.multiplier_integrals(), initial=0.0)),
        complementarity=float(reference.lam @ excess),
    )


def _over(value: float, scale: float) -> float:
    return value / scale if scale > 0.0 else value


def constants_full(V: InnerProduct, matrices: Sequence[SparseMatrix], cone: Multipliers) -> list[InfSup]:
    """Constants of the whole of V at every B(mu) (m×n); matrices that are proportional share one computation."""
    classes = constraint_classes(matrices)
    image = supremizer_images(V, classes.representatives, cone.span.shape[1] + cone.chi.shape[1])
    return everywhere(
        classes, [inf_sup(image(B, cone.span), image(B, cone.chi), cone) for B in classes.representatives]
    )


def constants_on(Z: Array, matrices: Sequence[SparseMatrix], cone: Multipliers) -> list[InfSup]:
    """Constants of one primal space with V-orthonormal basis Z (n×N') at every B(mu), likewise."""
    classes = constraint_classes(matrices)
    return everywhere(classes, [inf_sup_on(Z, B, cone) for B in classes.representatives])


def everywhere(classes: ConstraintClasses, found: Sequence[InfSup]) -> list[InfSup]:
    """Constants of all matrices from those of the ones that stand for their classes."""
    return [found[k].scaled(c) for k, c in zip(classes.members, classes.factors, strict=True)]
