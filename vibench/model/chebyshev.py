"""Polynomial interpolation of parametrised arrays in Chebyshev points of a box, its error measured at random points."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy.fft

from vibench.arrays import Array, Indices
from vibench.linalg.inner_product import svd

# from a parameter mu (d,) to flat arrays (size,) by name, of the same sizes everywhere
Evaluate = Callable[[Array], Mapping[str, Array]]


@dataclass(frozen=True)
class AffinePolynomial:
    """An array Σ_q θ_q(mu) · terms_q whose coefficients θ_q are polynomials on a box."""

    # Degrees (K×d) of the products of Chebyshev polynomials that occur, in (2 mu − lower − upper)/(upper − lower).
    indices: Indices
    # Coefficients of θ in these products (K×Q), zero where no value needs them.
    coefficients: Array
    # Flat terms (Q×size).
    terms: Array
    # Largest Euclidean error at random points of the box and at its corners, over the largest norm there.
    error: float
    # The largest norm.
    scale: float

    @property
    def degrees(self) -> tuple[int, ...]:
        """Degree in every parameter."""
        return tuple(int(degree) for degree in self.indices.max(axis=0))

    def evaluate(self, unit: Array) -> Array:
        """Values (P×size) at points (P×d) of the unit box."""
        return products(self.indices, unit) @ self.coefficients @ self.terms


def products(indices: Indices, unit: Array) -> Array:
    """Products (P×K) of Chebyshev polynomials of these degrees (K×d) at points (P×d) of the unit box."""
    factors = [
        np.polynomial.chebyshev.chebvander(2.0 * at - 1.0, int(degrees.max()))[:, degrees]
        for at, degrees in zip(unit.T, indices.T, strict=True)
    ]
    return np.asarray(np.prod(factors, axis=0))


def interpolate_on_box(
    evaluate: Evaluate, lower: Array, upper: Array, tolerance: float, budget: int,
    terms: Mapping[str, Array] = MappingProxyType({}), alike: Sequence[str] = (),
) -> dict[str, AffinePolynomial]:  # fmt: skip
    """Tensor-product Chebyshev interpolation of arrays on a box (Trefethen 2013, chapters 3 and 8).

    Degrees differ by direction: along random lines, the arrays are interpolated with more and more points until the
    coefficients have decayed to a tenth of the tolerance, relative to the largest array. One grid has these degrees, or
    larger ones if its measured error is above the tolerance. An array that misses the tolerance has a grid of its own
    if it varies less than others in some direction. Every array loses the coefficients it does not need. If all of a
    grid have the tolerance, those without given terms are factorised into θ and terms by singular values.

    `evaluate` gives the arrays at a parameter of the box from `lower` to `upper` (d,), and `budget` is the largest
    number of points of a grid. The relative `tolerance` may be missed: functions that are not smooth take too many
    points. The errors of the result say so. `terms` are flat terms (Q×size) of those arrays for which `evaluate`
    returns the coefficients θ (Q,) instead, `alike` names of arrays with terms whose θ are the same: so are their
    polynomials, which serve the most demanding one.
    """
    random = np.random.default_rng(0)
    # degrees are chosen along three random lines in every direction: one alone may miss an oscillation
    anchors, corners = random.random((3, len(lower))), np.array(np.meshgrid(*[[0.0, 1.0]] * len(lower)))
    anchors = anchors if len(lower) > 1 else anchors[:1]
    # 100 points, and the corners, show an error that is not far below the largest one
    unit = np.vstack([random.random((100, len(lower))), corners.reshape(len(lower), -1).T])
    points = lower + unit * (upper - lower)
    values = _stacked([evaluate(mu) for mu in points])
    values = {name: each @ terms[name] if name in terms else each for name, each in values.items()}
    scale = {name: float(np.linalg.norm(each, axis=-1).max()) or 1.0 for name, each in values.items()}
    # A coefficient counts by what it adds to the array: times the norm of its term, unless that vanishes.
    units: dict[str, Any] = dict(scale)
    for name, given in terms.items():
        norms = np.linalg.norm(given, axis=1)
        units[name] = scale[name] / np.where(norms > 0.0, norms, 1.0)
    if alike:
        units |= dict.fromkeys(alike, np.min([np.asarray(units[name]) for name in alike], axis=0))
    along = _Sampled(evaluate, lower, upper, units)
    # A function that needs more points than that along a line has a grid beyond the budget, or nearly.
    limit = max(9, round(4 * budget ** (1.0 / len(lower)))) if len(lower) > 1 else budget
    lines = [[along.counts(k, at, 0.1 * tolerance, limit) for at in anchors] for k in range(len(lower))]

    def measured(name: str, polynomial: AffinePolynomial) -> AffinePolynomial:
        error = float(np.linalg.norm(polynomial.evaluate(unit) - values[name], axis=-1).max()) / scale[name]
        return replace(polynomial, error=error, scale=scale[name])

    def counts_of(names: Collection[str]) -> list[int]:
        return [max(found[name] for found in line for name in names) for line in lines]

    together = counts_of(values)
    polynomials = _on_grids(along, values, together, tolerance, budget, terms, measured)
    for names in dict.fromkeys(tuple(alike) if name in alike else (name,) for name in values):
        alone = counts_of(names)
        if alone != together and max(polynomials[name].error for name in names) > tolerance:
            polynomials |= _on_grids(along, names, alone, tolerance, budget, terms, measured)
    return polynomials


def _on_grids(
    along: _Sampled, names: Collection[str], counts: Sequence[int], tolerance: float, budget: int,
    terms: Mapping[str, Array], measured: Callable[[str, AffinePolynomial], AffinePolynomial],
) -> dict[str, AffinePolynomial]:  # fmt: skip
    """Polynomials of some of the arrays on the first grid on which all have the tolerance, or on the last one."""
    # three grids, each with a quarter more points per direction than the last: the lines may have missed some
    for _ in range(3):
        counts = _within(counts, budget)
        kept = {name: _needed(c, 0.1 * tolerance) for name, c in along.coefficients(counts, names).items()}
        polynomials = {}
        for name in kept.keys() & terms.keys():
            indices, c = kept[name]
            # Products of Chebyshev polynomials are at most 1: what is left out sums up to a tenth of the tolerance.
            theta = np.where(np.abs(c) > 0.1 * tolerance / c.size, c, 0.0) * along.units[name]
            polynomials[name] = AffinePolynomial(indices, theta, terms[name], np.inf, 1.0)
        for name in kept.keys() - terms.keys():
            indices, c = kept[name]
            count, size = c.shape
            # the coefficients themselves are the terms, or the entries of the array, whichever are fewer
            whole = along.units[name]
            theta, own = (c, whole * np.eye(size)) if size < count else (np.eye(count), whole * c)
            polynomials[name] = AffinePolynomial(indices, theta, own, np.inf, 1.0)
        polynomials = {name: measured(name, polynomials[name]) for name in kept}
        if max(p.error for p in polynomials.values()) <= tolerance:
            # only now: the decomposition of a large array takes minutes
            for name in kept.keys() - terms.keys():
                polynomials[name] = compressed(polynomials[name], tolerance)
        if max(p.error for p in polynomials.values()) <= tolerance or prod(counts) >= 0.7 * budget:
            break
        counts = [count + max(1, count // 4) if count > 1 else count for count in counts]
    return polynomials


class _Sampled:
    """Arrays over their units, sampled on lines and grids of Chebyshev points."""

    def __init__(self, evaluate: Evaluate, lower: Array, upper: Array, units: Mapping[str, Any]) -> None:
        self._evaluate, self._lower, self._upper, self.units = evaluate, lower, upper, units

    def _at(self, unit: Array, names: Collection[str]) -> dict[str, Array]:
        """Some of the arrays at points (P×d) of the unit box, (P×size) each."""
        found = [self._evaluate(self._lower + at * (self._upper - self._lower)) for at in unit]
        stacked = _stacked([{name: arrays[name] for name in names} for arrays in found])
        return {name: values / self.units[name] for name, values in stacked.items()}

    def counts(self, direction: int, anchor: Array, tolerance: float, limit: int) -> dict[str, int]:
        """Numbers of coefficients on the line through a point, without last ones that sum up to the tolerance.

        The number of points is doubled until the last third of the coefficients is not needed.
        """
        count = 3
        while True:
            line = np.tile(anchor, (count, 1))
            line[:, direction] = _chebyshev_points(count)
            needed = dict[str, int]()
            for name, values in self._at(line, self.units).items():
                sizes = np.linalg.norm(_transformed(values, 0), axis=1)
                needed[name] = max(int(np.count_nonzero(np.cumsum(sizes[::-1]) > tolerance)), 1)
            if 3 * max(needed.values()) <= 2 * count or count >= limit:
                return needed
            count = min(2 * count, limit)

    def coefficients(self, counts: Sequence[int], names: Collection[str]) -> dict[str, Array]:
        """Coefficients (n₁×…×n_d×size) of some interpolants on a grid with this many points per direction."""
        grid = np.stack(np.meshgrid(*map(_chebyshev_points, counts), indexing="ij"), axis=-1)
        found = self._at(grid.reshape(-1, len(counts)), names)
        coefficients = {name: values.reshape(*counts, -1) for name, values in found.items()}
        for axis in range(len(counts)):
            coefficients = {name: _transformed(values, axis) for name, values in coefficients.items()}
        return coefficients


def _chebyshev_points(count: int) -> Array:
    """Zeros of the Chebyshev polynomial of this degree, in [0, 1], falling."""
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / count))


def _transformed(values: Array, axis: int) -> Array:
    """Chebyshev coefficients from values in the points above, along an axis."""
    count = values.shape[axis]
    coefficients = np.moveaxis(np.asarray(scipy.fft.dct(values, type=2, axis=axis)) / count, axis, 0)
    coefficients[0] *= 0.5
    return np.moveaxis(coefficients, 0, axis)


def _within(counts: Sequence[int], budget: int) -> list[int]:
    """Numbers of points per direction, the largest ones reduced until the grid is within the budget."""
    kept = list(counts)
    while prod(kept) > budget:
        kept[kept.index(max(kept))] -= 1
    return kept


def _needed(coefficients: Array, tolerance: float) -> tuple[Indices, Array]:
    """Degrees (K×d) and coefficients (K×size), of n₁×…×n_d×size, without those that sum up to less than a tolerance."""
    shape = coefficients.shape
    flat = coefficients.reshape(-1, shape[-1])
    norms = np.linalg.norm(flat, axis=1)
    rising = np.argsort(norms, kind="stable")
    kept = np.sort(rising[np.cumsum(norms[rising]) > tolerance]) if norms.sum() > tolerance else np.zeros(1, np.intp)
    return np.stack(np.unravel_index(kept, shape[:-1]), axis=1), flat[kept]


def compressed(polynomial: AffinePolynomial, tolerance: float) -> AffinePolynomial:
    """The polynomial with orthogonal terms, and few coefficients, up to a tenth of the tolerance.

    Terms are singular vectors. The largest threshold is found below which coefficients can be dropped. Numbers that
    single precision changes by less than it have that precision. The error grows by what all this changes.
    """
    right, triangle = np.linalg.qr(polynomial.terms.T)
    U, sigma, V = svd(polynomial.coefficients @ triangle.T)
    whole, vectors, unit = U * sigma, V @ right.T, np.random.default_rng(0).random((100, polynomial.indices.shape[1]))
    # Products of Chebyshev polynomials are largest at corners.
    unit[:30] = np.rint(unit[:30])
    factors, values = products(polynomial.indices, unit), polynomial.evaluate(unit)
    for threshold in tolerance * polynomial.scale * 10.0 ** -np.arange(0.0, 8.0, 0.25):
        # The 24 bits of single precision.
        theta, terms, limit = np.where(np.abs(whole) > threshold, whole, 0.0), vectors.copy(), 2.0**24 * threshold
        small, minor = np.abs(theta).max(axis=1) <= limit, np.abs(factors @ theta).max(axis=0) <= limit
        theta[small], terms[minor] = theta[small].astype(np.float32), terms[minor].astype(np.float32)
        change = float(np.linalg.norm(factors @ theta @ terms - values, axis=1).max()) / polynomial.scale
        if change <= min(0.1 * tolerance, tolerance - polynomial.error):
            break
    kept, used = np.count_nonzero(theta, axis=1) > 0, np.count_nonzero(theta, axis=0) > 0
    # C and NumPy have no polynomials without products.
    kept[0], used[0] = kept[0] or not kept.any(), used[0] or not used.any()
    error = polynomial.error + change
    return AffinePolynomial(polynomial.indices[kept], theta[kept][:, used], terms[used], error, polynomial.scale)


def _stacked(evaluated: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    return {name: np.stack([arrays[name] for arrays in evaluated]) for name in evaluated[0]}
