"""What strategy plugins hand over, checked before anything is made of it: the line names what is wrong."""

from __future__ import annotations

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError
from vibench.space import InnerProduct
from vibench.strategy import Cone, Enrichment

ROUND_OFF = 1e-8
"""How far norms and angles may be from what they are promised to be."""


def check_cone(cone: object, W: InnerProduct) -> Cone:
    """A cone that keeps its promises: shape, finite, unit norms in W, in W⁺ unless free.

    Raises
    ------
    NumericalError
        Naming the promise that is broken.
    """
    if not isinstance(cone, Cone):
        raise NumericalError(f"the dual strategy returned a {type(cone).__name__}, expected a Cone")
    chi = _matrix("generators", cone.generators, W.dim)
    if chi.shape[1] and np.max(np.abs(W.norm(chi) - 1.0)) > ROUND_OFF:
        raise NumericalError("the generators do not all have unit norm in W")
    if cone.free.shape != (chi.shape[1],):
        raise NumericalError(f"'free' has shape {cone.free.shape} for {chi.shape[1]} generators")
    smallest = float(np.min(chi[:, ~cone.free], initial=0.0))
    if smallest < 0.0:
        raise NumericalError(f"a generator has the negative coefficient {smallest:.1e} and is not declared free")
    return cone


def check_enrichment(enrichment: object, V: InnerProduct, basis: Array) -> Enrichment:
    """An enrichment that keeps its promises: fixed vectors are finite, orthonormal in V and orthogonal to V_N.

    Raises
    ------
    NumericalError
        Naming the promise that is broken.
    """
    if not isinstance(enrichment, Enrichment):
        raise NumericalError(f"the primal strategy returned a {type(enrichment).__name__}, expected an Enrichment")
    if enrichment.vectors is not None:
        vectors = _matrix("vectors of the enrichment", enrichment.vectors, V.dim)
        off = V.gram(np.hstack([basis, vectors]), vectors)
        off[basis.shape[1] :] -= np.eye(vectors.shape[1])
        if np.max(np.abs(off), initial=0.0) > ROUND_OFF:
            raise NumericalError("the vectors of the enrichment are not orthonormal in V and orthogonal to V_N")
    return enrichment


def _matrix(name: str, value: object, rows: int) -> Array:
    if not isinstance(value, np.ndarray) or value.ndim != 2 or value.shape[0] != rows:
        found = getattr(value, "shape", type(value).__name__)
        raise NumericalError(f"the {name} have shape {found}, expected ({rows}, count)")
    if not np.all(np.isfinite(value)):
        raise NumericalError(f"the {name} have entries that are not finite")
    return value
