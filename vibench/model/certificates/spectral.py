"""Bounds α(µ) X ≼ A(µ) ≼ γ(µ) X against one inner product X, without matrices of mesh size at the parameter.

**Anchors.** Let A(µ) = Σ_q θ_q(µ) A_q + D(µ) with ‖D(µ)‖ ≤ η in the operator norm of X, ‖A_q‖ ≤ s_q, and
α_i X ≼ A(µ_i) ≼ γ_i X with proved constants at a few anchors µ_i. For any weights c ≥ 0 and
δ = θ(µ) − Σ_i c_i θ(µ_i),

    α(µ) = Σ_i c_i α_i − Σ_q |δ_q| s_q − (1 + Σ_i c_i) η,     γ(µ) = Σ_i c_i γ_i + Σ_q |δ_q| s_q + (1 + Σ_i c_i) η

are bounds: each c is a feasible point of the dual of the linear program that the successive constraint method solves
(Huynh, Rozza, Sen and Patera, C. R. Math. 345, 2007). Anchors form a grid of the parameters on which A depends, and c
are the weights of multilinear interpolation on it, which leave a small δ and take no optimisation. The place of a
parameter on the grid is the length of the path of A along that parameter: where this is straight, as for a/µ or a µ³,
two anchors leave no δ. The A_q are rotated to the principal directions of A over the parameters first: if A is
interpolated, the last of them hardly matter and are left to D. The others are rotated once more, to the principal
directions of δ relative to α over the parameters, so that the sum is close to the norm of Σ_q δ_q A_q where α is small.

**Terms.** A grid of many parameters has too few points. Where A is declared as a sum and X = Σ_q θ_q(µ̄) A_q, let
l_q X ≼ θ_q(µ̄) A_q ≼ h_q X with proved constants, and t_q = θ_q(µ)/θ_q(µ̄). For any number τ

    A(µ) = τ X + Σ_q (t_q − τ) θ_q(µ̄) A_q ≽ (τ + Σ_q min((t_q − τ) l_q, (t_q − τ) h_q)) X,

and likewise from above. With A_q ≽ 0 and τ = min_q t_q this is the bound min_q θ_q(µ)/θ_q(µ̄) of Rozza, Huynh and
Patera (2008). As a function of τ it is concave and linear between the t_q, so that one of these is the best. The larger
α and the smaller γ are taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import Problem
from vibench.interfaces.validation import checked_assembly
from vibench.linalg import EPS
from vibench.linalg.inner_product import InnerProduct
from vibench.stability.coercivity import coercivity_and_continuity, largest_quotient, operator_norm, proved_above


@dataclass(frozen=True)
class TermRanges:
    """Bounds of single terms: l_q X ≼ θ_q(µ̄) A_q ≼ h_q X."""

    # θ(µ̄) (Q,), none of them zero.
    reference: Array
    # l_q and h_q (Q,).
    lower: Array
    upper: Array
    # Bound of the difference between X and the sum, and of the round-off in sums, for the largest |t_q| = 1.
    error: float

    @classmethod
    def of(cls, terms: Sequence[SparseMatrix], reference: Array, X: InnerProduct, error: float) -> TermRanges | None:
        """Prove the ranges of terms A_q (n×n); `None` where one is not proved.

        Their sum with θ(µ̄) (Q,) is X but for an error relative to it.
        """
        if not np.all(reference != 0.0):
            return None
        ranges = [_range(theta * sp.csr_array(term), X) for theta, term in zip(reference, terms, strict=True)]
        found = [one for one in ranges if one is not None]
        if len(found) < len(ranges):
            return None
        lower, upper = np.array(found).T
        rounded = (len(reference) + 4.0) * EPS * (1.0 + 2.0 * float(np.sum(upper - lower)))
        return cls(reference, lower, upper, error + rounded)

    def evaluate(self, theta: Array) -> tuple[float, float]:
        """The bounds α(µ) and γ(µ) with θ(µ) (Q,)."""
        t = theta / self.reference
        # a column for every τ
        above = t[:, None] - t
        low, high = above * self.lower[:, None], above * self.upper[:, None]
        room = self.error * float(np.abs(t).max())
        lower, upper = t + np.minimum(low, high).sum(axis=0), t + np.maximum(low, high).sum(axis=0)
        return float(lower.max()) - room, float(upper.min()) + room


def _range(term: SparseMatrix, X: InnerProduct) -> tuple[float, float] | None:
    """Proved l and h with l X ≼ A_q ≼ h X for a symmetric term (n×n); `None` where there are none."""
    norm = operator_norm(term, X)
    if not norm.proved:
        return None
    if not norm.value:
        return 0.0, 0.0
    lower = upper = norm.value
    # A semidefinite term is singular: its sign is proved but for a share of its norm above the round-off of the proof.
    for share in (1e-4, 1e-6, 1e-8, 1e-10):
        if lower > share * norm.value and proved_above(term, -share * norm.value, X):
            lower = share * norm.value
        elif upper > share * norm.value and proved_above(-term, -share * norm.value, X):
            upper = share * norm.value
        else:
            break
    return -lower, upper


@dataclass(frozen=True)
class AnchorGrid:
    """A grid of anchors over some of the parameters; the others are at their centre."""

    # Positions (a,) of the parameters.
    axes: Indices
    # Ends (a,) of the grid.
    lower: Array
    upper: Array
    # Numbers of anchors (a,) along each of them, two at least.
    counts: Indices
    # Lengths (a×K) of the path of A at equidistant values of each parameter, from 0 to 1.
    places: Array

    @classmethod
    def of(cls, box: ParameterBox, theta: Callable[[Array], Array], norms: Array) -> AnchorGrid:
        """Choose the grid for coefficients θ (Q,), a function of mu (d,), of terms with these norms (Q,).

        Bounds hold on any grid: if θ varies elsewhere than is seen here, they are only less sharp.
        """
        # Between tabulated places weights are linear in mu: with 33 of them some A had no bound here and there.
        values = np.linspace(box.lower, box.upper, 257)
        starts = np.vstack([0.5 * (box.lower + box.upper), box.sample(1, 17)])
        every = range(box.dim)
        paths = norms * np.array([[_path(theta, mu, axis, values[:, axis]) for mu in starts] for axis in every])
        lengths = np.linalg.norm(np.diff(paths, axis=2), axis=3).sum(axis=1)
        places = np.pad(np.cumsum(lengths, axis=1), ((0, 0), (1, 0)))
        moving = places[:, -1] > 0.0
        places[moving] /= places[moving, -1:]
        # Each anchor costs two eigenvalue problems of mesh size. Four along each parameter follow the curve of α; more
        # are for those along which A leaves the straight line, and α is 1 at the centre.
        each = next(count for count in (4, 3, 2, 1) if count ** int(moving.sum()) <= 81)
        counts = np.where(moving, each, 1)
        lacking = np.array([_lacking(*one) for one in zip(paths, places, counts.tolist(), strict=True)])
        while lacking.sum() > 5e-3:
            room = lacking * ((counts + 1) * (np.prod(counts) // counts) <= 81)
            axis = int(np.argmax(room))
            if not room[axis] > 0.0:
                break
            counts[axis] += 1
            lacking[axis] = _lacking(paths[axis], places[axis], int(counts[axis]))
        if lacking.sum() > 1.0:
            # As much as α at the centre is left between anchors of so many parameters: they would be of no use.
            counts[:] = 1
        axes = np.flatnonzero(counts > 1)
        return cls(axes, box.lower[axes], box.upper[axes], counts[axes], places[axes])

    def points(self, box: ParameterBox) -> Array:
        """The anchors (P×d), the last axis varying fastest."""
        values = np.linspace(self.lower, self.upper, self.places.shape[1]).T
        rows = zip(self.counts, self.places, values, strict=True)
        ticks = [np.interp(np.linspace(0.0, 1.0, count), places, value) for count, places, value in rows]
        points = np.tile(0.5 * (box.lower + box.upper), (int(np.prod(self.counts)), 1))
        points[:, self.axes] = np.array(list(product(*ticks)))
        return points

    def weights(self, mu: Array) -> tuple[list[int], list[float]]:
        """The anchors around mu (d,) and their weights, which sum to 1; outside those of the nearest point inside."""
        where, c, cells = [0], [1.0], self.places.shape[1] - 1
        # Few numbers: loops over them take less time than calls of NumPy.
        for value, low, high, count, places in zip(mu.take(self.axes).tolist(), *self._lists, strict=True):
            share = min(max((value - low) / (high - low), 0.0), 1.0) * cells
            cell = min(int(share), cells - 1)
            place = (places[cell] + (share - cell) * (places[cell + 1] - places[cell])) * (count - 1)
            first = min(int(place), count - 2)
            where = [k * count + first + end for k in where for end in (0, 1)]
            c = [weight * factor for weight in c for factor in (first + 1.0 - place, place - first)]
        return where, c

    @cached_property
    def _lists(self) -> tuple[list[float], list[float], list[int], list[list[float]]]:
        return self.lower.tolist(), self.upper.tolist(), self.counts.tolist(), self.places.tolist()


def _path(theta: Callable[[Array], Array], mu: Array, axis: int, values: Array) -> Array:
    """Coefficients (K×Q) along one parameter from mu (d,)."""
    along = np.tile(mu, (len(values), 1))
    along[:, axis] = values
    return np.array([theta(one) for one in along])


def _lacking(paths: Array, places: Array, count: int) -> float:
    """The largest Σ_q |δ_q| s_q along paths (S×K×Q), weighted by s, with so many anchors at these places (K,)."""
    if count == 1:
        return float(np.abs(paths - paths[:, len(places) // 2, None]).sum(axis=2).max())
    knots = np.linspace(0.0, 1.0, count)

    def missed(values: Array) -> Array:
        return values - np.interp(places, knots, np.interp(knots, places, values))

    return float(np.abs(np.apply_along_axis(missed, 1, paths)).sum(axis=2).max())


@dataclass(frozen=True)
class SpectralBounds:
    """Offline data of α(µ) and γ(µ)."""

    # The anchors.
    grid: AnchorGrid
    # α_i and γ_i (P,).
    alpha: Array
    gamma: Array
    # The second rotation (L×Q), of all θ to those of the first L terms.
    turn: Array
    # The turned θ(µ_i) (L×P).
    theta: Array
    # s_q (L,) of the turned A_q.
    norms: Array
    # η.
    error: float
    # Whether all of α_i, γ_i and s_q are proved.
    proved: bool
    # Ranges of the declared terms; `None` where A is no declared sum.
    ranges: TermRanges | None = None

    def evaluate(self, mu: Array, theta: Array, declared: Array | None = None) -> tuple[float, float]:
        """The bounds α(µ) and γ(µ) at mu (d,) with the rotated θ(µ) (Q,); a negative α(µ) is no bound.

        `declared` are the θ(µ) of the declared terms.
        """
        lower, upper, delta = self.interpolated(mu, theta)
        lacking = float(np.abs(delta) @ self.norms) + 2.0 * self.error
        lower, upper = lower - lacking, upper + lacking
        if self.ranges is None or declared is None:
            return lower, upper
        others = self.ranges.evaluate(declared)
        return max(lower, others[0]), min(upper, others[1])

    def interpolated(self, mu: Array, theta: Array) -> tuple[float, float, Array]:
        """The interpolated α and γ, and the turned δ (L,)."""
        where, c = self.grid.weights(mu)
        # `take` is three times as fast as an index that is a list
        combined = np.array(c) @ self._rows.take(where, axis=0)
        return float(combined[0]), float(combined[1]), self.turn @ theta - combined[2:]

    @cached_property
    def _rows(self) -> Array:
        """α_i, γ_i and θ(µ_i), one row per anchor."""
        return np.column_stack([self.alpha, self.gamma, self.theta.T])


def spectral_bounds(
    problem: Problem, X: InnerProduct, terms: list[SparseMatrix], theta: Callable[[Array], Array],
    missed: Callable[[Array], float], ranges: TermRanges | None = None,
) -> SpectralBounds:  # fmt: skip
    """Bounds from the first terms A_q (n×n) of A, coefficients θ (Q,) of all as a function of mu, and ‖D(µ)‖."""
    box, leading = problem.parameters, np.eye(len(terms), len(theta(problem.parameters.lower)))
    grid = AnchorGrid.of(box, lambda mu: leading @ theta(mu), np.array([largest_quotient(term, X) for term in terms]))
    points = grid.points(box)
    constants = [coercivity_and_continuity(checked_assembly(problem, mu).A, X) for mu in points]
    error = max(missed(mu) for mu in points)
    alpha, gamma = (np.array([constant.value for constant in one]) for one in zip(*constants, strict=True))
    coefficients = np.column_stack([theta(mu) for mu in points])
    proved = all(constant.proved for pair in constants for constant in pair)
    start, ones = leading @ coefficients, np.ones(len(terms))
    plain = SpectralBounds(grid, alpha, gamma, leading, start, ones, error, proved, ranges)
    # principal directions (L×L) of δ relative to α over the box, without a second rotation
    found = [plain.interpolated(mu, theta(mu)) for mu in box.sample(200, 19)]
    turn = np.linalg.svd(np.column_stack([delta / lower for lower, _, delta in found]))[0].T
    norms = [operator_norm(term, X) for term in combined(terms, turn.T)]
    proved, values = proved and all(norm.proved for norm in norms), np.array([norm.value for norm in norms])
    return replace(plain, turn=turn @ leading, theta=turn @ plain.theta, norms=values, proved=proved)


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
