"""The zone that contact reaches, among all unknowns that constraints may touch, and its dense compliance.

Dense work on all candidates of contact grows with the cube of their number, and most of them are never pressed. The
zone is found from a coarse problem whose multipliers are constant on groups of neighbouring rows. Solutions do not
depend on it: rows that touch other unknowns are checked by products with every solution, and enlarge it where they are
violated (`vibench.highfidelity.active_set`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from scipy.optimize import nnls
from scipy.sparse.csgraph import reverse_cuthill_mckee

from vibench.arrays import Array, Indices, Mask, SparseMatrix
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg import EPS

GROUPS = 64
"""Multipliers of the coarse problem; each takes one solution with A."""

GROWTH = 1.15
"""A zone has, or is enlarged to, at least so many times the rows that it has to have, so that the next parameters find
their contact in it."""


def zone_of(B: SparseMatrix, rows: Mask) -> Indices:
    """Unknowns that some rows (m,) of B (m×n) and their neighbours touch: `GROWTH` times as many rows, rising."""
    B = sp.csr_array(B)
    wanted = min(len(rows), int(np.ceil(GROWTH * np.sum(rows))))
    touching, reached = sp.csc_array(B), rows.copy()
    while True:
        unknowns: Indices = np.unique(B[reached].indices)
        if np.sum(reached) >= wanted:
            return np.asarray(unknowns)
        before = int(np.sum(reached))
        reached[touching[:, unknowns].indices] = True
        if np.sum(reached) == before:  # no neighbours are left
            return np.asarray(unknowns)


def watched(B: SparseMatrix, zone: Indices) -> Mask:
    """Rows (m,) of B (m×n) that touch no unknown outside of a zone."""
    inside = np.zeros(B.shape[1], bool)
    inside[zone] = True
    outside = sp.csr_array(B).copy()
    outside.data = (~inside[outside.indices]).astype(float)
    return np.asarray(np.ravel(outside.sum(axis=1)) == 0.0)


def coarse_contact(solve: Callable[[Array], Array], vi: VariationalInequality) -> Mask:
    """Rows (m,) that are pressed in the coarse problem of `vi`, with whose stiffness `solve` solves."""
    B, m = sp.csr_array(vi.B), len(vi.g)
    order = reverse_cuthill_mckee(sp.csr_array(abs(B) @ abs(B).T), symmetric_mode=True)
    group = np.empty(m, np.intp)
    group[order] = np.arange(m) * GROUPS // m
    finite = np.isfinite(vi.g)
    members = sp.csr_array((finite.astype(float), (group, np.arange(m))), shape=(GROUPS, m))
    coarse, bounds = members @ B, members @ np.where(finite, vi.g, 0.0)
    displacements = solve(np.column_stack([coarse.toarray().T, vi.f]))
    K, excess = coarse @ displacements[:, :-1], coarse @ displacements[:, -1] - bounds
    values, vectors = np.linalg.eigh(0.5 * (K + K.T))
    kept = values > EPS * len(values) * np.max(values, initial=0.0)
    root = np.sqrt(values[kept])
    try:
        forces, _ = nnls(root[:, None] * vectors[:, kept].T, (vectors[:, kept].T @ excess) / root)
    except RuntimeError:  # it has not converged, and the rows that are violated without forces are a larger guess
        forces = np.maximum(excess, 0.0)
    return np.asarray(forces[group] > 0.0)
