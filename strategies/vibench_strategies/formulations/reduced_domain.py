"""Reduced integration domains: integrals over few elements, and the elements and weights that replace all others."""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet

import numpy as np
import scipy.linalg

from vibench import Array, Indices, Problem

SUMS, SUMS_PER_VECTOR = 800, 8
"""How many sums stand for all conditions of a cubature: far more than it takes elements or rows, whichever is more."""

STABILITY = 0.1
"""Weight of A times a random vector beside A times a snapshot: A has to stay definite where no snapshot is."""


class ReducedDomain:
    """A and f, or one of them, integrated over elements (e,) with weights, between the vectors (n×N') of a basis."""

    def __init__(
        self, problem: Problem, members: AbstractSet[str], vectors: Array, elements: Indices, weights: Array
    ) -> None:
        dofs, self._sampler = problem.element_dofs[:, elements], problem.element_sampler(elements)
        padded = np.vstack([vectors, np.zeros(vectors.shape[1])])  # the last row is that of -1
        self._local = np.ascontiguousarray(np.moveaxis(padded[dofs], 0, 1))
        self._members, self._weights = members, weights

    def at(self, mu: Array) -> dict[str, Array]:
        """The members at mu (d,) by name, A (N'×N') and f (N',)."""
        sampled, found = self._sampler(mu), dict[str, Array]()
        if "A" in self._members:
            forces = (self._weights[:, None, None] * sampled["A"]) @ self._local
            A = np.tensordot(self._local, forces, ((0, 1), (0, 1)))
            found["A"] = 0.5 * (A + A.T)
        if "f" in self._members:
            found["f"] = self._works(sampled["f"]) @ self._weights
        return found

    def _works(self, forces: Array) -> Array:
        """Works (N'×e) of forces on elements (e×k)."""
        return np.asarray(np.einsum("ekn,ek->ne", self._local, forces))

    def conditions(self, mu: Array, x: Array, rng: np.random.Generator) -> list[tuple[float, Array]]:
        """Works (N'×e) at mu (d,) that a cubature has to sum up, with weights: of f, of A x, and of A times noise."""
        sampled, found = self._sampler(mu), list[tuple[float, Array]]()
        if "A" in self._members:
            for weight, trial in ((1.0, x), (STABILITY, rng.standard_normal(len(x)))):
                found.append((weight, self._works(np.einsum("eij,ej->ei", sampled["A"], self._local @ trial))))
        return [*found, (1.0, self._works(sampled["f"]))] if "f" in self._members else found


class Sketch:
    """The conditions of a cubature, each with a random sign in one of few sums, which keep its residual.

    Parameters
    ----------
    size, count
        Number N' of conditions that are added at a time, and of what the cubature chooses from.
    """

    def __init__(self, size: int, count: int) -> None:
        self.sums, self._rng = np.zeros((max(SUMS, SUMS_PER_VECTOR * size), count)), np.random.default_rng(0)

    def add(self, conditions: Array, weight: float = 1.0) -> None:
        """Add conditions (N'×e), relative to what all columns together are."""
        if size := float(np.linalg.norm(conditions.sum(axis=1))):
            signs = self._rng.choice([-1.0, 1.0], len(conditions))
            where = self._rng.choice(len(self.sums), len(conditions), replace=False)
            self.sums[where] += (weight / size * signs)[:, None] * conditions


def reduced_elements(
    problem: Problem, members: AbstractSet[str], vectors: Array, mus: Array, u: Array, tolerance: float
) -> tuple[Indices, Array]:
    """Elements and weights of a cubature of members between vectors (n×N'), trained on the snapshots u (n×P) of mus."""
    everywhere, rng = np.arange(problem.element_dofs.shape[1]), np.random.default_rng(0)
    domain = ReducedDomain(problem, members, vectors, everywhere, np.ones(len(everywhere)))
    sketch = Sketch(vectors.shape[1], len(everywhere))
    for mu, x in zip(mus, problem.V.gram(vectors, u).T, strict=True):
        lower = scipy.linalg.cholesky(vectors.T @ np.asarray(problem.assemble(mu).A @ vectors), lower=True)
        for weight, works in domain.conditions(mu, x, rng):
            sketch.add(scipy.linalg.solve_triangular(lower, works, lower=True), weight)
    return cubature(sketch.sums, tolerance)


def reduced_rows(pressures: Array, works: Sequence[Array], tolerance: float) -> tuple[Indices, Array]:
    """Rows and weights with which each of the pressures χ (m×R) does about the work χᵀ B V that it does on all rows.

    `works` are B V (m×N') at some parameters.
    """
    sketch = Sketch(works[0].shape[1], len(pressures))
    for each in works:
        for pressure in pressures.T:
            sketch.add(each.T * pressure)
    return cubature(sketch.sums, tolerance)


def cubature(conditions: Array, tolerance: float) -> tuple[Indices, Array]:
    """Few columns (j,) of conditions (k×e) and weights (j,) > 0 with which they have about the sum of all.

    Nonnegative least squares after Lawson and Hanson (1974), ended at a relative residual as by Farhat et al. (2015);
    all columns with the weight 1 for the tolerance 0.
    """
    if not tolerance:
        return np.arange(conditions.shape[1]), np.ones(conditions.shape[1])
    total, chosen, weights = conditions.sum(axis=1), list[int](), np.zeros(conditions.shape[1])
    Q, R, residual = np.zeros((len(total), 0)), np.zeros((0, 0)), total
    while np.linalg.norm(residual) > tolerance * np.linalg.norm(total):
        slopes = conditions.T @ residual
        slopes[chosen] = -np.inf
        best = int(np.argmax(slopes))
        if not slopes[best] > 0.0:
            break  # the least residual there is
        Q, R = _with_column(Q, R, conditions[:, best])
        chosen.append(best)
        while (solved := scipy.linalg.solve_triangular(R, Q.T @ total)).min() <= 0.0:
            present, falling = weights[chosen], np.flatnonzero(solved <= 0.0)
            ratios = present[falling] / (present[falling] - solved[falling])
            first = int(falling[np.argmin(ratios)])
            weights[chosen] = present + ratios.min() * (solved - present)
            weights[chosen.pop(first)] = 0.0
            Q, R = scipy.linalg.qr_delete(Q, R, first, which="col")
        weights[chosen] = solved
        residual = total - conditions[:, chosen] @ solved
    columns = np.sort(np.array(chosen, int))
    return columns, weights[columns]


def _with_column(Q: Array, R: Array, column: Array) -> tuple[Array, Array]:
    """The economic QR decomposition of a matrix with one more column."""
    if not R.size:
        return column[:, None] / np.linalg.norm(column), np.array([[np.linalg.norm(column)]])
    extended: tuple[Array, Array] = scipy.linalg.qr_insert(Q, R, column, R.shape[1], which="col")
    return extended
