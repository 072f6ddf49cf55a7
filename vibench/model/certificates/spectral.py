"""Bounds α(µ) X ≼ A(µ) ≼ γ(µ) X against one inner product X, without matrices of mesh size at the parameter.

Let A(µ) = Σ_q θ_q(µ) A_q + D(µ) with ‖D(µ)‖ ≤ η in the operator norm of X, ‖A_q‖ ≤ s_q, and α_i X ≼ A(µ_i) ≼ γ_i X
with proved constants at a few anchors µ_i. For any weights c ≥ 0 and δ = θ(µ) − Σ_i c_i θ(µ_i),

    α(µ) = Σ_i c_i α_i − Σ_q |δ_q| s_q − (1 + Σ_i c_i) η,     γ(µ) = Σ_i c_i γ_i + Σ_q |δ_q| s_q + (1 + Σ_i c_i) η

are bounds: each c is a feasible point of the dual of the linear program that the successive constraint method solves
(Huynh, Rozza, Sen and Patera, C. R. Math. 345, 2007). Anchors form a grid of the parameter box, and c are the weights
of multilinear interpolation on it, which leave a small δ and take no optimisation. The A_q are rotated to the principal
directions of A over the parameters first, so that the sum is close to the norm of Σ_q δ_q A_q. If A is interpolated,
its last directions hardly matter: they are left to D.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, SparseMatrix, digest
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import Problem
from vibench.interfaces.validation import checked_assembly
from vibench.linalg.inner_product import InnerProduct
from vibench.stability.coercivity import Constant, coercivity_and_continuity, operator_norm


@dataclass(frozen=True)
class SpectralBounds:
    """Offline data of α(µ) and γ(µ).

    Attributes
    ----------
    lower, upper
        Ends (d,) of the grid of anchors.
    count
        Its points per direction.
    alpha, gamma
        α_i and γ_i (P,).
    theta
        θ(µ_i) (Q×P) in the rotated coordinates.
    norms
        s_q (Q,) of the rotated A_q; zero for those left to D.
    error
        η.
    proved
        Whether all of α_i, γ_i and s_q are proved.
    """

    lower: Array
    upper: Array
    count: int
    alpha: Array
    gamma: Array
    theta: Array
    norms: Array
    error: float
    proved: bool

    def evaluate(self, mu: Array, theta: Array) -> tuple[float, float]:
        """The bounds α(µ) and γ(µ) at mu (d,) with the rotated θ(µ) (Q,); a negative α(µ) is no bound."""
        where, c = self._weights(mu)
        # `take` is three times as fast as an index that is a list
        combined = np.array(c) @ self._rows.take(where, axis=0)
        lacking = float(np.abs(theta - combined[2:]) @ self.norms) + 2.0 * self.error
        return float(combined[0]) - lacking, float(combined[1]) + lacking

    @cached_property
    def _rows(self) -> Array:
        """α_i, γ_i and θ(µ_i), one row per anchor."""
        return np.column_stack([self.alpha, self.gamma, self.theta.T])

    def _weights(self, mu: Array) -> tuple[list[int], list[float]]:
        """The anchors around mu and their weights, which sum to 1; outside the box those of the nearest point in it."""
        where, c = [0], [1.0]
        if self.count == 1:
            return where, c
        # Few numbers: loops over them take less time than calls of NumPy.
        for value, low, high in zip(mu.tolist(), self.lower.tolist(), self.upper.tolist(), strict=True):
            # a box may be flat: any place will do then
            place = min(max((value - low) / (high - low or 1.0), 0.0), 1.0) * (self.count - 1)
            first = min(int(place), self.count - 2)
            where = [k * self.count + first + end for k in where for end in (0, 1)]
            c = [weight * factor for weight in c for factor in (first + 1.0 - place, place - first)]
        return where, c


def anchors(box: ParameterBox) -> tuple[Array, int]:
    """The grid of anchors (P×d), and its points per direction."""
    # each anchor costs two eigenvalue problems of mesh size, and more than 9 points make δ no smaller than round-off
    fitting = [count for count in range(2, 10) if count**box.dim <= 81]
    if not fitting:
        return 0.5 * (box.lower + box.upper)[None, :], 1
    return box.grid(*[fitting[-1]] * box.dim), fitting[-1]


def spectral_bounds(
    problem: Problem, X: InnerProduct, terms: list[SparseMatrix], theta: Callable[[Array], Array], error: float
) -> SpectralBounds:
    """Bounds from the first terms A_q (n×n) of A, coefficients θ (Q,) of all as a function of mu, and η of these."""
    points, count = anchors(problem.parameters)
    # A often depends on a few of the parameters alone: the same matrix at many anchors
    by_matrix: dict[bytes, tuple[Constant, Constant]] = {}
    constants = []
    for mu in points:
        A = checked_assembly(problem, mu).A
        key = digest(A)
        if key not in by_matrix:
            by_matrix[key] = coercivity_and_continuity(A, X)
        constants.append(by_matrix[key])
    norms, coefficients = [operator_norm(term, X) for term in terms], np.column_stack([theta(mu) for mu in points])
    return SpectralBounds(
        lower=problem.parameters.lower,
        upper=problem.parameters.upper,
        count=count,
        alpha=np.array([alpha.value for alpha, _ in constants]),
        gamma=np.array([gamma.value for _, gamma in constants]),
        theta=coefficients,
        norms=np.append([norm.value for norm in norms], np.zeros(len(coefficients) - len(norms))),
        error=error,
        proved=all(constant.proved for pair in constants for constant in pair) and all(norm.proved for norm in norms),
    )


def rotated(terms: tuple[SparseMatrix, ...], theta: Array) -> tuple[Array, list[SparseMatrix]]:
    """Principal directions of Σ_q θ_q A_q over samples θ (Q×P): a rotation T (Q×Q) and terms for Tθ.

    The new terms are orthonormal as vectors of entries, by falling norm of their coefficients over the samples. They
    have one sparsity pattern.
    """
    pattern = sp.csr_array(sum(abs(sp.csr_array(term)) for term in terms))
    pattern.sort_indices()
    pattern.eliminate_zeros()
    places = pattern.nonzero()
    entries = np.column_stack([np.asarray(sp.csr_array(term)[places]).ravel() for term in terms])
    q, r = np.linalg.qr(entries)
    # Principal directions of the samples in an orthonormal basis of the entries: norms are Euclidean there.
    left, _, _ = np.linalg.svd(r @ theta)
    rows = np.ascontiguousarray((q @ left).T)
    modes = [sp.csr_array((mode, pattern.indices, pattern.indptr), shape=pattern.shape) for mode in rows]
    return np.asarray(left.T @ r), modes


def combined(terms: Sequence[SparseMatrix], theta: Array) -> list[SparseMatrix]:
    """Σ_q θ_q A_q of `rotated` terms for every column of θ (Q×k), whose entries are those of one product."""
    entries, pattern = np.column_stack([term.data for term in terms]) @ theta, terms[0]
    return [sp.csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape) for data in entries.T.copy()]


def leading_terms(theta: Array) -> int:
    """Number of rotated terms that are more than 1e-4 of the variation of A over samples θ (Q×P)."""
    varying = np.linalg.norm(theta - theta.mean(axis=1, keepdims=True), axis=0).max()
    # norms of the sums of each term and those after it, the largest over the samples
    rest = np.sqrt(np.cumsum((theta**2)[::-1], axis=0)[::-1].max(axis=1))
    return int(np.count_nonzero(rest > 1e-4 * varying))
