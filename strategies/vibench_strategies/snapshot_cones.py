"""Cones of snapshots that no greedy algorithm of the relative maximum criterion made: their generators and errors."""

from __future__ import annotations

import numpy as np

from vibench import Array, InnerProduct
from vibench.reduction import LazyDistances, refuse_negative


def normalised(snapshots: Array, W: InnerProduct) -> Array:
    """Snapshots (m×Q) with unit norm in W, without those that are zero; `refuse_negative` checks them first."""
    refuse_negative(snapshots)
    norms = W.norm(snapshots)
    return np.asarray(snapshots[:, norms > 0.0] / norms[norms > 0.0])


def projection_errors(generators: Array, snapshots: Array, W: InnerProduct) -> Array:
    """e(r) for r = 0 … R: the largest distance of snapshots (m×Q) from the cone of the first r unit vectors (m×R).

    Relative to the largest norm of a snapshot, as in equations (13) and (34); zero where all snapshots are zero.
    """
    errors = np.zeros(generators.shape[1] + 1)
    if np.any(snapshots):
        distances, whitened = LazyDistances(W.whiten(snapshots)), W.whiten(generators)
        errors[0] = 1.0
        for r in range(1, len(errors)):
            distances.widen(whitened[:, :r])
            errors[r] = distances.next()[1]
    return errors
