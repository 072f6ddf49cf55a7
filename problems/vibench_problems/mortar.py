"""Coupling integrals between two facing polygonal boundaries, paired along a fixed direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import NumericalError


@dataclass(frozen=True)
class Coupling:
    """Integrals over macro-edges of the slave side, measured along its arc length.

    Attributes
    ----------
    slave
        ∫ v η for nodal values of v on the slave side (m×nodes).
    master
        ∫ (v∘φ) η for nodal values of v on the master side (m×nodes).
    gap
        ∫ (y − y∘φ) η: the initial gap (m,).
    """

    slave: SparseMatrix
    master: SparseMatrix
    gap: Array


def coupling(slave: Array, master: Array, quadrature: Literal["exact"] | int) -> Coupling:
    """Couple two polygons by the vertical projection φ, for P1 values and cell-wise constants on pairs of slave edges.

    Along a vertical projection both sides are piecewise linear in the abscissa, with kinks at the nodes of either:
    "exact" cuts the slave edges at the projected master nodes, a number takes that many Gauss points per slave edge.

    Parameters
    ----------
    slave, master
        Nodes (2×k) of the polygons, abscissae rising from the axis.
    quadrature
        "exact", or Gauss points per slave edge.

    Raises
    ------
    NumericalError
        If the master side does not reach as far as the slave side.
    """
    if master[0, -1] < slave[0, -1]:
        raise NumericalError(
            f"the pairing ends at x = {master[0, -1]:.4g} m, but the potential contact zone of disc 1 reaches "
            f"x = {slave[0, -1]:.4g} m: the radius of disc 2 is too small"
        )
    edge, x, weight = _cut(slave, master) if quadrature == "exact" else _gauss(slave, int(quadrature))
    on_slave, on_master = _interpolation(slave[0], edge, x), _interpolation(master[0], _edge_of(master[0], x), x)
    sums = sp.csr_array((weight, (edge // 2, np.arange(len(x)))), shape=((slave.shape[1] - 1) // 2, len(x)))
    gap = on_slave @ slave[1] - on_master @ master[1]
    return Coupling(sp.csr_array(sums @ on_slave), sp.csr_array(sums @ on_master), np.asarray(sums @ gap))


def _lengths(polygon: Array) -> Array:
    return np.asarray(np.linalg.norm(np.diff(polygon, axis=1), axis=0))


def _cut(slave: Array, master: Array) -> tuple[Indices, Array, Array]:
    """Slave edge, abscissa and weight of the midpoints of all segments between projected nodes; exact for linears."""
    inner = master[0][(master[0] > slave[0, 0]) & (master[0] < slave[0, -1])]
    cuts = np.union1d(slave[0], inner)
    x = 0.5 * (cuts[1:] + cuts[:-1])
    edge = _edge_of(slave[0], x)
    return edge, x, np.diff(cuts) * (_lengths(slave) / np.diff(slave[0]))[edge]


def _gauss(slave: Array, count: int) -> tuple[Indices, Array, Array]:
    """Slave edge, abscissa and weight of `count` Gauss points per edge."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    edge = np.repeat(np.arange(slave.shape[1] - 1), count)
    t = np.tile(0.5 * (1.0 + nodes), slave.shape[1] - 1)
    x = slave[0, edge] + t * np.diff(slave[0])[edge]
    return edge, x, 0.5 * np.tile(weights, slave.shape[1] - 1) * _lengths(slave)[edge]


def _edge_of(abscissae: Array, x: Array) -> Indices:
    return np.clip(np.searchsorted(abscissae, x, side="right") - 1, 0, len(abscissae) - 2)


def _interpolation(abscissae: Array, edge: Indices, x: Array) -> SparseMatrix:
    """Matrix (points×nodes) of the P1 functions of a polygon at abscissae x on known edges."""
    t = (x - abscissae[edge]) / np.diff(abscissae)[edge]
    points = np.arange(len(x))
    entries = (np.concatenate([1.0 - t, t]), (np.tile(points, 2), np.concatenate([edge, edge + 1])))
    return sp.csr_array(entries, shape=(len(x), len(abscissae)))
