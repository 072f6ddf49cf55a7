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
    jump
        ∫ (v∘φ − v) η for nodal values of v on the slave side and then on the master side (m×(slave + master nodes)).
    gap
        ∫ (y − y∘φ) η: the initial gap (m,).
    """

    jump: SparseMatrix
    gap: Array


class Pairing:
    """A slave polygon, to be coupled to master polygons by the vertical projection φ.

    Values are P1 on both sides, multipliers constant on pairs of slave edges. Along a vertical projection both sides
    are piecewise linear in the abscissa, with kinks at the nodes of either: "exact" cuts the slave edges at the
    projected master nodes, a number takes that many Gauss points per slave edge. What is integrated on the slave side
    alone is exact in both cases and does not depend on the master.

    Parameters
    ----------
    slave
        Nodes (2×s) of the slave polygon, abscissae rising from the axis.
    quadrature
        "exact", or Gauss points per slave edge.
    """

    def __init__(self, slave: Array, quadrature: Literal["exact"] | int) -> None:
        self._slave = slave
        widths, lengths = np.diff(slave[0]), np.linalg.norm(np.diff(slave, axis=1), axis=0)
        self._stretch = lengths / widths
        edges, nodes = np.arange(len(widths)), slave.shape[1]
        self._macros = edges // 2
        half = 0.5 * lengths
        self._slave_entries = (
            np.tile(self._macros, 2),
            np.concatenate([edges, edges + 1]),
            -np.concatenate([half, half]),
        )
        height = half * (slave[1, :-1] + slave[1, 1:])
        self._height = np.asarray(np.bincount(self._macros, height), float)
        self._points = None if quadrature == "exact" else self._gauss(int(quadrature))
        self._size = nodes

    def couple(self, master: Array) -> Coupling:
        """Couple to a master polygon (2×k), abscissae rising from the axis.

        Raises
        ------
        NumericalError
            If the master side does not reach as far as the slave side.
        """
        slave, size = self._slave, self._size
        if master[0, -1] < slave[0, -1]:
            raise NumericalError(
                f"the pairing ends at x = {master[0, -1]:.4g} m, but the potential contact zone of disc 1 reaches "
                f"x = {slave[0, -1]:.4g} m: the radius of disc 2 is too small"
            )
        macro, x, weight = self._points if self._points is not None else self._cut(master[0])
        edge = _edge_of(master[0], x)
        right = weight * (x - master[0, edge]) / np.diff(master[0])[edge]
        left = weight - right
        on_master = left * master[1, edge] + right * master[1, edge + 1]
        height = np.asarray(np.bincount(macro, on_master, minlength=len(self._height)), float)
        rows, columns, values = self._slave_entries
        jump = sp.csr_array(
            (
                np.concatenate([values, left, right]),
                (np.concatenate([rows, macro, macro]), np.concatenate([columns, size + edge, size + 1 + edge])),
            ),
            shape=(len(self._height), size + master.shape[1]),
        )
        return Coupling(jump, self._height - height)

    def _cut(self, abscissae: Array) -> tuple[Indices, Array, Array]:
        """Macro-edge, abscissa and weight of the midpoints of all segments between projected nodes."""
        first, last = np.searchsorted(abscissae, self._slave[0, [0, -1]])
        cuts = np.sort(np.concatenate([self._slave[0], abscissae[first:last]]), kind="stable")
        x = 0.5 * (cuts[1:] + cuts[:-1])
        edge = _edge_of(self._slave[0], x)
        return self._macros[edge], x, np.diff(cuts) * self._stretch[edge]

    def _gauss(self, count: int) -> tuple[Indices, Array, Array]:
        """Macro-edge, abscissa and weight of `count` Gauss points per slave edge."""
        nodes, weights = np.polynomial.legendre.leggauss(count)
        widths = np.diff(self._slave[0])
        edge = np.repeat(np.arange(len(widths)), count)
        x = self._slave[0, edge] + np.tile(0.5 * (1.0 + nodes), len(widths)) * widths[edge]
        return self._macros[edge], x, 0.5 * np.tile(weights, len(widths)) * (widths * self._stretch)[edge]


def _edge_of(abscissae: Array, x: Array) -> Indices:
    return np.clip(np.searchsorted(abscissae, x, side="right") - 1, 0, len(abscissae) - 2)
