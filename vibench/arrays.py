"""The array types of the contracts."""

from __future__ import annotations

from hashlib import sha256
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""A dense array of floats; the docstring of its user gives the shape."""

Indices: TypeAlias = NDArray[np.intp]
"""A vector of indices."""

Mask: TypeAlias = NDArray[np.bool_]
"""A vector of truth values."""

SparseMatrix: TypeAlias = Any
"""A SciPy sparse array or matrix (SciPy ships no types)."""


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
