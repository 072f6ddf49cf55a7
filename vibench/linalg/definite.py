"""Dense symmetric positive definite matrices that may consist of blocks, such as those of bodies that do not touch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg
from scipy.linalg.lapack import dpotri

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError


def connected_blocks(matrix: Array) -> list[Indices]:
    """The sets of unknowns of a symmetric matrix (c×c) between which all entries are zero."""
    blocks, left = [], np.ones(len(matrix), bool)
    while left.any():
        block = np.zeros_like(left)
        reached = np.flatnonzero(left)[:1]
        while len(reached):  # every row is looked at once
            block[reached] = True
            reached = np.flatnonzero((matrix[reached] != 0.0).any(axis=0) & ~block)
        left &= ~block
        blocks.append(np.flatnonzero(block))
    return blocks


def dense_cholesky(matrix: Array, name: str) -> Array:
    """The upper triangular F (c×c) with FᵀF = X.

    Raises a `NumericalError` that calls X by `name` if X is not positive definite.
    """
    return _by_blocks(matrix, name, lambda block: np.asarray(scipy.linalg.cholesky(block)))


def dense_inverse(matrix: Array, name: str) -> Array:
    """The inverse of a symmetric positive definite X (c×c).

    Raises a `NumericalError` that calls X by `name` if X is not positive definite.
    """
    return _by_blocks(matrix, name, _inverse)


def _inverse(block: Array) -> Array:
    upper = np.asarray(dpotri(scipy.linalg.cholesky(block), overwrite_c=True)[0])
    return np.asarray(upper + np.triu(upper, 1).T)


def _by_blocks(matrix: Array, name: str, function: Callable[[Array], Array]) -> Array:
    blocks = connected_blocks(matrix)
    try:
        if len(blocks) == 1:
            return function(matrix)
        result = np.zeros_like(matrix)
        for block in blocks:
            result[np.ix_(block, block)] = function(matrix[np.ix_(block, block)])
    except (np.linalg.LinAlgError, ValueError):  # a pivot is not positive, an entry not finite
        raise NumericalError(f"{name} is not positive definite") from None
    return result
