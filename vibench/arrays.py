"""The array types of the contracts."""

from __future__ import annotations

from hashlib import sha256
from typing import Annotated, Any, TypeAlias, TypeVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from vibench.errors import NumericalError
from vibench.signatures import Rule, is_plain

Array: TypeAlias = NDArray[np.float64]
"""A dense array of floats; the docstring of its user gives the shape."""

Indices: TypeAlias = NDArray[np.intp]
"""A vector of indices."""

Mask: TypeAlias = NDArray[np.bool_]
"""A vector of truth values."""

A = TypeVar("A", bound=NDArray[Any])


def _is_matrix(value: Any) -> bool:
    is_matrix = (sp.issparse(value) or is_plain(value)) and value.ndim == 2 and value.dtype.kind in "fiub"
    return is_matrix and bool(np.isfinite(sp.coo_array(value).data if sp.issparse(value) else value).all())


SparseMatrix: TypeAlias = Annotated[Any, Rule("a matrix of finite real numbers", _is_matrix)]
"""A SciPy sparse array or matrix (SciPy ships no types)."""


def real_matrix(value: Any, name: str) -> SparseMatrix:
    """A matrix of any format and any type of real numbers as a sparse array of float64, in rows or columns.

    Raises a `NumericalError` that calls it by `name` if it is something else.
    """
    if isinstance(value, sp.csr_array | sp.csc_array) and value.dtype == np.float64:
        return value
    if not (sp.issparse(value) or isinstance(value, np.ndarray)):
        raise NumericalError(f"{name} is a {type(value).__name__}, expected a sparse matrix")
    _check_real(value, name)
    if value.ndim != 2:
        raise NumericalError(f"{name} has shape {value.shape}, expected a matrix")
    # Other formats lack what sparse arrays in rows can do, such as the choice of rows.
    made = sp.csc_array if sp.issparse(value) and value.format == "csc" else sp.csr_array
    return made(value, dtype=np.float64)


def real_vector(value: Any, name: str) -> Array:
    """A vector of any type of real numbers as an array of float64; raises as `real_matrix`."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    if not isinstance(value, np.ndarray):
        raise NumericalError(f"{name} is a {type(value).__name__}, expected a vector, an array of NumPy")
    _check_real(value, name)
    return np.asarray(value, np.float64)


def taken(value: object, what: str, *shape: int | str, finite: bool = True) -> Array:
    """A read-only copy in float64 of an array that a plugin returned; a `NumericalError` says `what` is wrong with it.

    A size of the shape that is a name may be any. What a plugin keeps and refills, or another one is given, is not
    shared by this.
    """
    expected = f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"
    if not isinstance(value, np.ndarray):
        raise NumericalError(f"{what} has the type {type(value).__name__}, expected an array {expected}")
    _check_real(value, what)
    sizes = zip(value.shape, shape, strict=False)
    if value.ndim != len(shape) or any(size != right for size, right in sizes if isinstance(right, int)):
        raise NumericalError(f"{what} has shape {value.shape}, expected {expected}")
    copied = np.array(value, np.float64)
    if finite and not (fine := np.isfinite(copied)).all():
        first = np.argwhere(~fine)[0][-1]
        raise NumericalError(f"{what} is not finite, first in {'entry' if len(shape) == 1 else 'column'} {first}")
    copied.flags.writeable = False
    return copied


def is_sound(array: Array | None) -> bool:
    """Whether there is no array, or its entries and the squares of their sums are finite."""
    return array is None or bool(np.max(np.abs(array), initial=0.0) < 1e100)


def read_only(array: A) -> A:
    """An array that is read-only, or a view of it into which nobody writes by chance."""
    # What shares an array is stored with one.
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def frozen(matrix: SparseMatrix) -> SparseMatrix:
    """A sparse matrix with read-only views in place of its arrays, which SciPy does not sort any more."""
    if matrix.format in ("csr", "csc") and matrix.has_canonical_format:
        for name in ("data", "indices", "indptr"):
            setattr(matrix, name, read_only(getattr(matrix, name)))
    return matrix


def _check_real(value: Any, name: str) -> None:
    if value.dtype.kind == "c":
        raise NumericalError(f"{name} is complex; vibench is for real problems")
    if value.dtype.kind not in "fiub":
        raise NumericalError(f"{name} has entries of the type {value.dtype}, expected real numbers")
    # A conversion would make numbers of the masked entries again.
    if isinstance(value, np.ma.MaskedArray):
        raise NumericalError(f"{name} is a masked array, expected numbers alone")


def digest(matrix: SparseMatrix) -> bytes:
    """Digest that two sparse matrices (CSR or CSC) of one format share exactly if their arrays are equal."""
    return sha256(b"".join(array.tobytes() for array in (matrix.indptr, matrix.indices, matrix.data))).digest()


def times_dense(sparse: SparseMatrix, dense: Array) -> Array:
    """The product of a sparse M (m×c) and a dense matrix (c×k)."""
    # Rows with one entry, such as those of nodal constraints, scale rows, which SciPy would add to zeros.
    if sparse.format != "csr" or not np.array_equal(sparse.indptr, np.arange(sparse.shape[0] + 1)):
        return np.asarray(sparse @ dense)
    rows = sparse.indices
    chosen = dense if np.array_equal(rows, np.arange(len(dense))) else dense[rows]
    return np.asarray(sparse.data[:, None] * chosen)
