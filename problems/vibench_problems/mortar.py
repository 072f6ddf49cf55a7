"""Coupling integrals between two facing polygonal boundaries, paired along a fixed direction."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import Literal

import numpy as np
import scipy.sparse as sp

from vibench import Array, ContactSource, Indices, NumericalError, SparseMatrix

ALL = slice(None)


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
        macro, edge, left, right = self.halves(master[0])
        on_master = left * master[1, edge] + right * master[1, edge + 1]
        height = np.asarray(np.bincount(macro, on_master, minlength=len(self._height)), float)
        jump = self._beside_slave(*_by_row(macro, edge, left, right), master.shape[1])
        return Coupling(jump, self._height - height)

    def tested(self, eta: Array) -> Tested:
        """The same integrals for given multipliers η (m×k), and any master polygon."""
        return Tested(self, eta)

    def source(self, master: Array, lift: Array, approach: float) -> ContactSource:
        """The coupling to a master polygon (2×k) times mu[0], in C.

        The gap closes by the approach, mu[1] if that is zero, times a displacement (s + k,) of both sides.
        """
        _, x, weights = self._points or (None, np.zeros(1), self._stretch)
        macros, masters = len(self._height), master.shape[1]
        tables = {
            "x": master[0], "y": master[1], "lift": lift, "approach": approach, "macros": macros, "masters": masters,
            "slave": self._slave[0], "height": self._height, "on_slave": self._on_slave.data, "abscissae": x,
            "weights": weights, "points": 0 if self._points is None else len(x) // (2 * macros),
        }  # fmt: skip
        text = (files("vibench_problems") / "mortar.c").read_text(encoding="utf-8")
        return ContactSource(text, tables, 5 * macros + masters)

    def on_slave(self, eta: Array) -> tuple[Array, Array]:
        """−∫ v η (s×k) for nodal values of v on the slave side, and ∫ y η (k,) there."""
        return np.asarray(self._on_slave.T @ eta), np.asarray(self._height @ eta)

    def end(self, macros: slice) -> float:
        """The abscissa where the last of some macro-edges ends."""
        return float(self._slave[0, 2 * macros.indices(len(self._height))[1]])

    def halves(self, abscissae: Array, macros: slice = ALL) -> tuple[Indices, Indices, Array, Array]:
        """Macro-edge and master edge of points on the slave side, and the weights of the two nodes of the master edge.

        Those of some macro-edges alone, if they are asked for. The abscissae (j,) are those of the master polygon.

        Raises
        ------
        NumericalError
            If the master side does not cover the slave side.
        """
        if abscissae[-1] < self._slave[0, -1]:
            raise NumericalError(
                f"the pairing ends at x = {abscissae[-1]:.4g} m, but the potential contact zone of disc 1 reaches "
                f"x = {self._slave[0, -1]:.4g} m: the radius of disc 2 is too small"
            )
        macro, edge, x, weight = (self._cut if self._points is None else self._facing)(abscissae, macros)
        begin = abscissae.take(edge)
        right = weight * (x - begin) / (abscissae.take(edge + 1) - begin)
        return macro, edge, weight - right, right

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

    def _cut(self, abscissae: Array, macros: slice) -> tuple[Indices, Indices, Array, Array]:
        """Macro-edge, master edge, abscissa and weight of the midpoints of all segments between projected nodes."""
        begin, end, _ = macros.indices(len(self._height))
        nodes = self._slave[0, 2 * begin : 2 * end + 1]
        first, last = abscissae.searchsorted(nodes[0]), abscissae.searchsorted(nodes[-1])
        merged = np.concatenate([nodes, abscissae[first:last]])
        order = merged.argsort(kind="stable")
        cuts, begun = merged.take(order), (order < len(nodes)).cumsum()[:-1]  # slave nodes up to each segment
        # The other cuts are master nodes; the last one before a segment is the number of its master edge. It would be
        # −1 on the empty segment between two nodes that coincide on the axis.
        facing = np.maximum(np.arange(first, first + len(begun)) - begun, 0)
        x = 0.5 * (cuts[1:] + cuts[:-1])  # exact: the integrands are linear on every segment
        edges = begun + (2 * begin - 1)
        return self._macros.take(edges), facing, x, (cuts[1:] - cuts[:-1]) * self._stretch.take(edges)

    def _facing(self, abscissae: Array, macros: slice) -> tuple[Indices, Indices, Array, Array]:
        """Macro-edge, master edge, abscissa and weight of given points on the slave side."""
        assert self._points is not None  # implied by the quadrature
        macro, x, weight = self._points
        begin, end, _ = macros.indices(len(self._height))
        chosen = slice(*macro.searchsorted([begin, end]))
        macro, x, weight = macro[chosen], x[chosen], weight[chosen]
        return macro, np.clip(np.searchsorted(abscissae, x, side="right") - 1, 0, len(abscissae) - 2), x, weight

    def _gauss(self, count: int) -> tuple[Indices, Array, Array]:
        """Macro-edge, abscissa and weight of `count` Gauss points per slave edge."""
        nodes, weights = np.polynomial.legendre.leggauss(count)
        widths = np.diff(self._slave[0])
        edge = np.repeat(np.arange(len(widths)), count)
        x = self._slave[0, edge] + np.tile(0.5 * (1.0 + nodes), len(widths)) * widths[edge]
        return self._macros[edge], x, 0.5 * np.tile(weights, len(widths)) * (widths * self._stretch)[edge]


class Tested:
    """The integrals of a pairing for given multipliers η (m×k), of whose macro-edges alone the slave edges are cut.

    Attributes
    ----------
    on_slave
        −∫ v η for nodal values of v on the slave side, as loads (s×k).
    height
        ∫ y η on the slave side (k,).
    end
        The largest abscissa where η is not zero.
    """

    def __init__(self, pairing: Pairing, eta: Array) -> None:
        acting = np.flatnonzero(eta.any(axis=1))
        self._macros = slice(int(acting[0]), int(acting[-1]) + 1) if len(acting) else slice(0, 1)
        self._pairing, self._eta = pairing, np.ascontiguousarray(eta)
        self.on_slave, self.height = pairing.on_slave(eta)
        self.end = pairing.end(self._macros)

    def on_master(self, abscissae: Array) -> Array:
        """∫ (v∘φ) η for nodal values of v on a master polygon, as loads (j×k) on its first nodes; the others have none.

        Raises
        ------
        NumericalError
            As `Pairing.couple`.
        """
        macro, edge, left, right = self._pairing.halves(abscissae, self._macros)
        points, edges = len(macro), int(edge[-1]) + 1
        begun = edge.searchsorted(np.arange(edges + 1))  # points before every master edge
        entries = np.concatenate([left, right]), np.concatenate([macro, macro])
        pointers = np.concatenate([begun, begun[1:] + points])
        sums = sp.csr_array((*entries, pointers), shape=(2 * edges, len(self._eta))) @ self._eta  # for its two nodes
        loads = np.zeros((edges + 1, self._eta.shape[1]))
        loads[:-1] = sums[:edges]
        loads[1:] += sums[edges:]
        return loads


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
