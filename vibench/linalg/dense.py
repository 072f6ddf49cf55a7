"""Dense linear algebra for the small and often nearly rank-deficient matrices of reduced models."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from vibench.arrays import Array

RANK_RTOL = 1e-12
"""Directions below this fraction of the largest one are round-off and are dropped from every orthonormal basis."""

ORTHOGONALITY_ATOL = 1e-13
"""Inner products of unit vectors below this are round-off."""


def svd(a: Array) -> tuple[Array, Array, Array]:
    """Thin singular value decomposition a = (u·s) vᵀ: u (n×k), s (k,) falling, vᵀ (k×l).

    By QR iteration (LAPACK's gesvd): the divide-and-conquer routine behind `numpy.linalg.svd` was seen not to converge
    on sines of principal angles, whose values cluster at 1 and at round-off.
    """
    u, s, vt = scipy.linalg.svd(a, full_matrices=False, lapack_driver="gesvd")
    return np.asarray(u), np.asarray(s), np.asarray(vt)


def singular_values(a: Array) -> Array:
    """Singular values of `a`, falling; by the same routine as `svd`."""
    if not a.size:
        return np.zeros(0)
    return np.asarray(scipy.linalg.svd(a, compute_uv=False, lapack_driver="gesvd"))


def orthonormal_range(y: Array, against: Array | None = None) -> Array:
    """Euclidean orthonormal basis of the columns of y (n×k), with orthonormal columns `against` (n×l) projected out.

    Rank-revealing (pivoted QR). The threshold is relative to the norm of each column before `against` is projected out:
    a short column is not mistaken for a dependent one. The basis is (n×r), r the numerical rank at `RANK_RTOL`.
    """
    norms = np.linalg.norm(y, axis=0)
    y = y[:, norms > 0.0] / norms[norms > 0.0]
    if against is not None:
        y = project_out(against, y)
    if not y.size:
        return np.zeros((y.shape[0], 0))
    q, r, _ = scipy.linalg.qr(y, mode="economic", pivoting=True)
    q = q[:, np.abs(np.diag(r)) > RANK_RTOL]
    if against is not None and np.max(np.abs(against.T @ q), initial=0.0) > ORTHOGONALITY_ATOL:
        # normalising a column of which little is left magnifies its round-off along `against`
        q, _ = np.linalg.qr(project_out(against, q))
    return np.asarray(q)


def project_out(space: Array, y: Array) -> Array:
    """(I − Π)y for orthonormal columns `space` (n×l) and y (n,) or (n×k); applied twice against round-off."""
    for _ in range(2):
        y = y - space @ (space.T @ y)
    return y
