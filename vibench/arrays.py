"""The array types of the contracts."""

from __future__ import annotations

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
