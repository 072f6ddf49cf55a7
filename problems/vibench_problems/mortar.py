"""Coupling integrals between two facing polygonal boundaries, paired along a fixed direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp

from vibench import Array, Indices, NumericalError, SparseMatrix


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
    are piecewise linear in the abscissa, with kinks at the nodes of either. "exact" cuts the slave edges at the
    projected master nodes; a number is that of Gauss points per slave edge. Integrals over the slave side alone are
    exact in both cases and do not depend on the master.

    Parameters
    ----------
    slave
        Nodes (2×s) of the slave polygon, abscissae increasing from the axis.
    quadrature
        "exact", or Gauss points per slave edge.
    """

    def __init__(self, slave: Array, quadrature: Literal["exact"] | int) -> None:
        self._slave = slave
        widths, lengths = np.diff(slave[0]), np.linalg.norm(np.diff(slave, axis=1), axis=0)
        self._stretch = lengths / widths
        edges = np.arange(len(widths))
        self._macros = edges // 2
        half = 0.5 * lengths
        places = np.tile(self._macros, 2), np.concatenate([edges, edges + 1])
        self._on_slave = sp.csr_array((-np.concatenate([half, half]), places))
        self._slave_rows = np.repeat(np.arange(self._on_slave.shape[0]), np.diff(self._on_slave.indptr))
        height = half * (slave[1, :-1] + slave[1, 1:])
        self._height = np.asarray(np.bincount(self._macros, height), float)
        self._points = None if quadrature == "exact" else self._gauss(int(quadrature))

    def couple(self, master: Array) -> Coupling:
        """Couple to a master polygon (2×k), abscissae increasing from the axis.

        Raises
        ------
        NumericalError
            If the master side does not cover the slave side.
        """
        slave = self._slave
        if master[0, -1] < slave[0, -1]:
            raise NumericalError(
                f"the pairing ends at x = {master[0, -1]:.4g} m, but the potential contact zone of disc 1 reaches "
                f"x = {slave[0, -1]:.4g} m: the radius of disc 2 is too small"
            )
        macro, edge, x, weight = self._cut(master[0]) if self._points is None else self._facing(self._points, master[0])
        right = weight * (x - master[0, edge]) / np.diff(master[0])[edge]
        left = weight - right
        on_master = left * master[1, edge] + right * master[1, edge + 1]
        height = np.asarray(np.bincount(macro, on_master, minlength=len(self._height)), float)
        jump = self._beside_slave(*_by_row(macro, edge, left, right), master.shape[1])
        return Coupling(jump, self._height - height)

    def _beside_slave(self, rows: Indices, nodes: Indices, values: Array, count: int) -> SparseMatrix:
        """Matrix of the slave entries followed by those of `count` master nodes, sorted by row and node."""
        fixed = self._on_slave
        before = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=fixed.shape[0]))])
        mine = np.arange(fixed.nnz) + before[self._slave_rows]
        theirs = np.arange(len(rows)) + fixed.indptr[rows + 1]
        data, columns = np.empty(fixed.nnz + len(rows)), np.empty(fixed.nnz + len(rows), dtype=fixed.indices.dtype)
        data[mine], columns[mine] = fixed.data, fixed.indices
        data[theirs], columns[theirs] = values, fixed.shape[1] + nodes
        pointers = (fixed.indptr + before).astype(columns.dtype)
        return sp.csr_array((data, columns, pointers), shape=(fixed.shape[0], fixed.shape[1] + count))

    def _cut(self, abscissae: Array) -> tuple[Indices, Indices, Array, Array]:
        """Macro-edge, master edge, abscissa and weight of the midpoints of all segments between projected nodes."""
        nodes = self._slave[0]
        first, last = np.searchsorted(abscissae, nodes[[0, -1]])
        merged = np.concatenate([nodes, abscissae[first:last]])
        order = np.argsort(merged, kind="stable")
        cuts, begun = merged[order], np.cumsum(order < len(nodes))[:-1]  # slave nodes up to each segment
        # The other cuts are master nodes; the last one before a segment is the number of its master edge. It would be
        # −1 on the empty segment between two nodes that coincide on the axis.
        facing = np.maximum(first + np.arange(len(begun)) - begun, 0)
        x = 0.5 * (cuts[1:] + cuts[:-1])  # exact: the integrands are linear on every segment
        return self._macros[begun - 1], facing, x, np.diff(cuts) * self._stretch[begun - 1]

    @staticmethod
    def _facing(points: tuple[Indices, Array, Array], abscissae: Array) -> tuple[Indices, Indices, Array, Array]:
        """Macro-edge, master edge, abscissa and weight of given points on the slave side."""
        macro, x, weight = points
        return macro, np.clip(np.searchsorted(abscissae, x, side="right") - 1, 0, len(abscissae) - 2), x, weight

    def _gauss(self, count: int) -> tuple[Indices, Array, Array]:
        """Macro-edge, abscissa and weight of `count` Gauss points per slave edge."""
        nodes, weights = np.polynomial.legendre.leggauss(count)
        widths = np.diff(self._slave[0])
        edge = np.repeat(np.arange(len(widths)), count)
        x = self._slave[0, edge] + np.tile(0.5 * (1.0 + nodes), len(widths)) * widths[edge]
        return self._macros[edge], x, 0.5 * np.tile(weights, len(widths)) * (widths * self._stretch)[edge]


def _by_row(rows: Indices, edges: Indices, left: Array, right: Array) -> tuple[Indices, Indices, Array]:
    """Sum the contributions of points to the two nodes of their edges; returns rows, nodes and sums.

    Rows and edges ascend from point to point, so equal pairs of row and node are adjacent.
    """
    advance = np.diff(edges)
    # Successive points in one row share both nodes (same edge), one node (next edge) or none.
    step = np.where((np.diff(rows) > 0) | (advance > 1), 2, advance)
    place = np.concatenate([[0], np.cumsum(step)])
    count = int(place[-1]) + 2
    sums = np.asarray(np.bincount(place, left, count) + np.bincount(place + 1, right, count), float)
    of_row, node = np.empty(count, dtype=np.intp), np.empty(count, dtype=np.intp)
    of_row[place], node[place] = rows, edges
    of_row[place + 1], node[place + 1] = rows, edges + 1
    return of_row, node, sums
