"""Proper orthogonal decomposition in a weighted inner product (paper, equations (10) and (11))."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.interfaces.strategies import Stop
from vibench.linalg.inner_product import RANK_RTOL, InnerProduct, svd
from vibench.signatures import bordered


@bordered
@dataclass(frozen=True)
class POD:
    """A nested basis of V-orthonormal modes (n×N), the first k of which are the POD basis of dimension k.

    `errors` are the relative tails e_POD(k) for k = 0 … number of snapshots (equation (11)).
    """

    basis: Annotated[Array, "n", "N"]
    errors: Annotated[Array, "k"]


def pod(snapshots: Annotated[Array, "n", "P"], V: Annotated[InnerProduct, "n"], stop: Stop) -> POD:
    """POD of snapshots u(mu_p) (n×P), by the singular value decomposition of the whitened snapshots.

    The eigenvalues of the correlation matrix UᵀX_V U, the method of snapshots, have a floor of 1e-8 in relative terms.
    The number of modes is given by `stop`: a relative tail, or a size.

    Raises a `NumericalError` if more modes are requested than the numerical rank of the snapshots.
    """
    if not snapshots.shape[1]:
        return POD(np.zeros((V.dim, 0)), np.zeros(1))
    coordinates, span = V.coordinates(snapshots)
    left, sigma, _ = svd(coordinates)
    total = float(np.linalg.norm(sigma))
    tails = np.append(np.sqrt(np.cumsum((sigma**2)[::-1])[::-1]), 0.0)
    errors = tails / total if total > 0.0 else tails
    rank = int(np.count_nonzero(sigma > RANK_RTOL * total))
    size = stop.first_reached(errors)
    if size is None or size > rank:
        raise NumericalError(f"POD cannot give {stop}: the {snapshots.shape[1]} snapshots have rank {rank}")
    modes = left[:, :size]
    # The sign of a singular vector is arbitrary: make the largest entry positive.
    signs = np.where(np.take_along_axis(modes, np.abs(modes).argmax(axis=0)[None], axis=0)[0] < 0.0, -1.0, 1.0)
    modes = modes * signs
    return POD(V.unwhiten(modes) if span is None else span @ modes, errors)
