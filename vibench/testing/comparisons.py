"""Vectors and sparse matrices compared: where they differ, in words."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, SparseMatrix
from vibench.interfaces.problem import MEMBERS, VariationalInequality

Members = dict[str, Any]
"""Vectors and sparse matrices by name."""


def copied(value: Any) -> Any:
    """A copy of a vector or a sparse matrix in which every entry stands once; the matrix is CSR."""
    if isinstance(value, np.ndarray):
        return value.copy()
    matrix = sp.csr_array(value, copy=True)
    matrix.sum_duplicates()
    return matrix


def members(vi: VariationalInequality) -> Members:
    """Copies of A, f, B and g."""
    return {name: copied(getattr(vi, name)) for name in MEMBERS}


def peak(value: Any) -> float:
    """Largest modulus of an entry of a vector or a sparse matrix; 0 if there is none."""
    entries = value if isinstance(value, np.ndarray) else value.data
    return float(np.max(np.abs(entries), initial=0.0))


def difference(one: Any, other: Any, limit: float = 0.0) -> str:
    """Where two vectors or sparse matrices differ most, "entry (3, 4) is 1.0 against 2.0"; "" if by no more than this.

    Parameters
    ----------
    one, other
        Dense arrays of any shape, or sparse matrices.
    limit
        Largest difference of entries that is none; by default bits have to agree.
    """
    if one.shape != other.shape:
        return f"the shape is {one.shape} against {other.shape}"
    apart = sp.coo_array(one - other) if sp.issparse(one) else one - other
    data = apart.data if sp.issparse(apart) else np.ravel(apart)
    if not len(data) or np.max(np.abs(data)) <= limit:
        return ""
    worst = int(np.argmax(np.where(np.isnan(data), np.inf, np.abs(data))))
    if sp.issparse(apart):
        place: tuple[Any, ...] = tuple(int(axis[worst]) for axis in apart.coords)
    else:
        place = tuple(int(index) for index in np.unravel_index(worst, one.shape))
    return f"{entry(place)} is {_digits(one, place, other)} against {_digits(other, place, one)}"


def entry(place: tuple[Any, ...]) -> str:
    """An entry of a vector or a matrix, in words."""
    return f"entry {place[0]}" if len(place) == 1 else f"entry ({', '.join(map(str, place))})"


def _digits(value: Any, place: tuple[Any, ...], other: Any) -> str:
    """An entry with as many digits as it takes to tell it from the other."""
    own, against = float(value[place]), float(other[place])
    short = f"{own:.6g}"
    return short if short != f"{against:.6g}" else repr(own)


def asymmetry(matrix: SparseMatrix, rtol: float) -> str:
    """Where a square matrix is not symmetric, relative to its largest entry; "" if it is."""
    matrix = sp.csr_array(matrix)
    apart = sp.coo_array(abs(matrix - matrix.T))
    if not apart.nnz or apart.data.max() <= rtol * peak(matrix):
        return ""
    i, j = (int(axis[np.argmax(apart.data)]) for axis in apart.coords)
    return f"entry ({i}, {j}) is {matrix[i, j]:.6g} and entry ({j}, {i}) is {matrix[j, i]:.6g}"


def pickled(thing: Any) -> Any:
    """A thing after a journey between processes."""
    return pickle.loads(pickle.dumps(thing))


def why_not_pickled(thing: Any) -> str:
    """The attributes that keep an object from being pickled, in words; "" if it can be."""
    try:
        pickled(thing)
    except Exception as error:  # noqa: BLE001  pickling runs code of strangers
        reason = f"{type(error).__name__}: {error}"
    else:
        return ""
    found = [name for name, value in getattr(thing, "__dict__", {}).items() if not _travels(value)]
    where = f": look at its {'attribute' if len(found) == 1 else 'attributes'} {', '.join(found)}" if found else ""
    return f"the {type(thing).__name__} cannot be pickled ({reason}){where}"


def _travels(value: Any) -> bool:
    try:
        pickled(value)
    except Exception:  # noqa: BLE001  pickling runs code of strangers
        return False
    return True


def array_fault(name: str, value: Any, shape: tuple[int, ...]) -> str:
    """What is wrong with a dense array of floats that should have a shape; "" if nothing is."""
    if not isinstance(value, np.ndarray):
        return f"{name} is a {type(value).__name__}; expected a NumPy array of shape {shape}"
    if value.shape != shape:
        return f"{name} has shape {value.shape}; expected {shape}"
    if value.dtype != np.float64:
        return f"{name} has dtype {value.dtype}; expected float64, which no assignment rounds"
    wrong = np.argwhere(~np.isfinite(value))
    return f"{name} is not finite: {entry(tuple(wrong[0]))} is {value[tuple(wrong[0])]}" if len(wrong) else ""


def matrix_fault(name: str, value: Any, shape: tuple[int, ...]) -> str:
    """What is wrong with a sparse matrix of floats that should have a shape; "" if nothing is."""
    if not sp.issparse(value):
        return f"{name} is a {type(value).__name__}; expected a sparse CSR matrix: scipy.sparse.csr_array({name})"
    if value.shape != shape:
        return f"{name} has shape {value.shape}; the spaces V and W ask for {shape}"
    if value.format not in ("csr", "csc"):
        return f"{name} has the sparse format {value.format}; expected CSR or CSC: scipy.sparse.csr_array({name})"
    if value.dtype != np.float64:
        return f"{name} has dtype {value.dtype}; expected float64"
    if np.all(np.isfinite(value.data)):
        return ""
    found = sp.coo_array(value)
    k = int(np.flatnonzero(~np.isfinite(found.data))[0])
    return f"{name} is not finite: {entry(tuple(int(axis[k]) for axis in found.coords))} is {found.data[k]}"


def at(mu: Array) -> str:
    """A parameter in a sentence."""
    return f"at mu = {[float(f'{value:.12g}') for value in mu]}"
