"""Supremizers T(mu)η = X_V⁻¹ B(mu)ᵀη (paper, equation (15)) and the space that contains all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.linalg import remove
from vibench.space import InnerProduct

PROPORTIONAL_RTOL = 1e-12
"""Two constraint matrices count as proportional when they differ by less than this, relative to their norm."""


def supremizers(V: InnerProduct, B: SparseMatrix, eta: Array) -> Array:
    """T(mu)η = X_V⁻¹ Bᵀη (n×k) for B (m×n) and multipliers η (m×k)."""
    return V.riesz(np.asarray(B.T @ eta))


def proportionality(B: SparseMatrix, reference: SparseMatrix) -> float | None:
    """C with B = c·reference up to round-off, or `None`; c ≠ 0."""
    norm = sp.linalg.norm(B)
    square = float(reference.multiply(reference).sum())
    if norm == 0.0 or square == 0.0:
        return None
    factor = float(B.multiply(reference).sum()) / square
    return factor if factor and sp.linalg.norm(B - factor * reference) <= PROPORTIONAL_RTOL * norm else None


@dataclass(frozen=True)
class ConstraintClasses:
    """Constraint matrices B(mu_p) sorted into classes of proportional ones, which share their supremizer space.

    Attributes
    ----------
    representatives
        One matrix per class, the first met.
    members
        Class of every p (P,).
    factors
        c_p (P,) with B(mu_p) = c_p · representatives[members[p]].
    """

    representatives: tuple[SparseMatrix, ...]
    members: Indices
    factors: Array


def constraint_classes(matrices: Sequence[SparseMatrix]) -> ConstraintClasses:
    """Sort matrices into classes of proportional ones."""
    representatives: list[SparseMatrix] = []
    members, factors = [], []
    for matrix in matrices:
        for k, representative in enumerate(representatives):
            factor = proportionality(matrix, representative)
            if factor is not None:
                members.append(k)
                factors.append(factor)
                break
        else:
            members.append(len(representatives))
            factors.append(1.0)
            representatives.append(matrix)
    return ConstraintClasses(tuple(representatives), np.array(members, dtype=np.intp), np.array(factors))


class SupremizerCoordinates:
    """Coordinates in the Euclidean space V_N + X_V⁻¹E, E the degrees of freedom that some B(mu) touches.

    Every supremizer of every parameter lies in it, so greedy algorithms over supremizers run on arrays of dimension
    N + dim E at most instead of n.

    Parameters
    ----------
    V
        Inner product of the primal space.
    basis
        V-orthonormal basis of V_N (n×N).
    matrices
        The constraint matrices (m×n) whose supremizers will be asked for.
    """

    def __init__(self, V: InnerProduct, basis: Array, matrices: Sequence[SparseMatrix]) -> None:
        self._V = V
        touched = np.zeros(V.dim, dtype=bool)
        for matrix in matrices:
            touched[np.unique(sp.csr_array(matrix).indices)] = True
        self._touched = np.flatnonzero(touched)
        unit = np.zeros((V.dim, len(self._touched)))
        unit[self._touched, np.arange(len(self._touched))] = 1.0
        representers = V.whiten_functional(unit)
        fixed = V.whiten(basis)
        q, r = scipy.linalg.qr(remove(fixed, representers), mode="economic")
        self._whitened = np.hstack([fixed, q])
        self._representers = np.vstack([fixed.T @ representers, r])
        self.plain = np.eye(self._whitened.shape[1], fixed.shape[1])

    def supremizers(self, B: SparseMatrix, eta: Array) -> Array:
        """Coordinates (d×k) of T(mu)η, η (m×k); those of V_N itself are `plain` (d×N), the first N unit vectors."""
        return np.asarray(self._representers @ np.asarray(B.T @ eta)[self._touched])

    def vectors(self, coordinates: Array) -> Array:
        """Vectors (n×k) with these coordinates (d×k)."""
        return self._V.unwhiten(self._whitened @ coordinates)
