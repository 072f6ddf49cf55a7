"""Comparison of dense arrays and sparse matrices; the messages name the entry at fault."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.testing.checks import ConformanceError

T = TypeVar("T")

Arrays = dict[str, Any]
"""Dense arrays and sparse matrices by name."""


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
