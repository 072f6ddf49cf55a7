"""Comparison of dense arrays and sparse matrices, and the search for jumps; messages name the entry at fault."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.testing.checks import ConformanceError

T = TypeVar("T")

Arrays = dict[str, Any]
"""Dense arrays and sparse matrices by name."""

JUMP = 1e-3
"""Smallest jump that is found, relative to the largest entry of the array."""

WIDTH = 2.0**-30
"""Length in t that localises a jump; a continuous array that changes by `JUMP` over it has a slope of at least 1e6."""

BISECTIONS = 60
"""Largest number of bisections on one line; a kink is bisected, too, until its deviation is below `JUMP`."""


def copies(arrays: Arrays) -> Arrays:
    """Copies of dense arrays, and of sparse matrices in CSR format without duplicate entries."""
    copied: Arrays = {}
    for name, value in arrays.items():
        copied[name] = value.copy() if isinstance(value, np.ndarray) else sp.csr_array(value, copy=True)
        if sp.issparse(copied[name]):
            copied[name].sum_duplicates()
    return copied


def largest_entry(value: Any) -> float:
    """Largest modulus of an entry of a dense array or a sparse matrix; 0 without entries."""
    return float(np.max(np.abs(_entries(value)), initial=0.0))


def difference(one: Any, other: Any, limit: float = 0.0) -> str:
    """Entry in which two arrays differ most, "entry (3, 4) is 1.0 against 2.0"; "" if by no more than the limit."""
    if one.shape != other.shape:
        return f"the shape is {one.shape} against {other.shape}"
    gap = one - other
    sizes = np.abs(_entries(gap))
    if not len(sizes) or np.max(sizes) <= limit:
        return ""
    place = _place(gap, int(np.argmax(np.where(np.isnan(sizes), np.inf, sizes))))
    values = float(one[place]), float(other[place])
    short = [f"{value:.6g}" for value in values]
    first, second = short if short[0] != short[1] else map(repr, values)
    return f"entry {place} is {first} against {second}"


def differences(one: Arrays, other: Arrays, rtol: float = 0.0) -> Iterator[tuple[str, str]]:
    """Names of the arrays that differ by more than rtol times the largest entry of the other, and the `difference`."""
    for name in {**one, **other}:
        if name not in one or name not in other:
            yield name, "one of the two has none"
        elif what := difference(one[name], other[name], rtol * largest_entry(other[name])):
            yield name, what


def unmutated(function: str, arrays: Arrays, call: Callable[[], T]) -> T:
    """Result of a call; a `ConformanceError` names the arrays that it changed, and an entry of each."""
    before = copies(arrays)
    result = call()
    if changed := [f"{name}: {what} before" for name, what in differences(copies(arrays), before)]:
        raise ConformanceError(f"{function} changes {'; '.join(changed)}; work on copies and return new arrays")
    return result


def array_fault(name: str, value: Any, shape: tuple[int, ...], *, sparse: bool = False) -> str:
    """Why a value is not a finite float64 array of a shape, dense or sparse (CSR, CSC); "" if it is."""
    if not (sp.issparse(value) if sparse else isinstance(value, np.ndarray)):
        right = f"sparse CSR matrix: scipy.sparse.csr_array({name})" if sparse else f"NumPy array of shape {shape}"
        return f"{name} is a {type(value).__name__}; expected a {right}"
    if value.shape != shape:
        return f"{name} has shape {value.shape}; expected {shape}"
    if sparse and value.format not in ("csr", "csc"):
        return f"{name} has the sparse format {value.format}; expected CSR or CSC: scipy.sparse.csr_array({name})"
    if value.dtype != np.float64:
        return f"{name} has dtype {value.dtype}; expected float64"
    wrong = np.flatnonzero(~np.isfinite(_entries(value)))
    if not len(wrong):
        return ""
    return f"{name} is not finite: entry {_place(value, wrong[0])} is {_entries(value)[wrong[0]]}"


def at(mu: Array) -> str:
    """A parameter (d,) in words: "at mu = [4.0, 0.1]"."""
    return f"at mu = {[float(f'{value:.12g}') for value in mu]}"


def _entries(value: Any) -> Array:
    """Entries of a dense array, or stored entries of a sparse matrix."""
    return np.asarray(value.data if sp.issparse(value) else np.ravel(value))


def _place(value: Any, k: int) -> tuple[int, ...] | int:
    """Index of the k-th of these entries, in a vector a number."""
    axes = [axis[k] for axis in sp.coo_array(value).coords] if sp.issparse(value) else np.unravel_index(k, value.shape)
    return tuple(int(index) for index in axes) if len(axes) > 1 else int(axes[0])


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment of the line, and the arrays at its left end, in its middle and at its right end.

    In the middle the array `name` deviates most from the mean of both ends, relative to its largest entry.
    """

    left: float
    right: float
    values: tuple[Arrays, Arrays, Arrays]
    name: str
    deviation: float


def find_jump(
    evaluate: Callable[[float], Arrays], scales: dict[str, float], late: Callable[[], bool] = lambda: False
) -> Segment | None:
    """A segment of length `WIDTH` at most on which an array jumps, `None` if no jump is found before it is `late`.

    The segment with the largest deviation is halved again and again. The deviation of a smooth array falls by 4 each
    time, that at a kink by 2; at a jump it stays half the jump. `evaluate` returns the arrays at t ∈ [0, 1]; `scales`
    names those that are examined, with their largest modulus.
    """

    def segment(left: float, right: float, first: Arrays, last: Arrays) -> Segment:
        middle = evaluate(0.5 * (left + right))
        off = {name: middle[name] - 0.5 * (first[name] + last[name]) for name in scales}
        deviations = {name: largest_entry(off[name]) / scales[name] for name in scales}
        name = max(deviations, key=deviations.__getitem__)
        return Segment(left, right, (first, middle, last), name, deviations[name])

    knots = [(t, evaluate(t)) for t in (0.0, 0.25, 0.5, 0.75, 1.0)]
    segments = [segment(left, right, first, last) for (left, first), (right, last) in pairwise(knots)]
    for _ in range(BISECTIONS):
        worst = max(segments, key=lambda each: each.deviation)
        if worst.deviation < 0.5 * JUMP or late():
            return None
        if worst.right - worst.left <= WIDTH:
            return worst
        segments.remove(worst)
        middle = 0.5 * (worst.left + worst.right)
        first, between, last = worst.values
        segments += [segment(worst.left, middle, first, between), segment(middle, worst.right, between, last)]
    return None
