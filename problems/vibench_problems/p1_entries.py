"""Single entries of P1 stiffness matrices and load vectors on meshes whose node positions are linear in weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibench import Array, Indices


class StiffnessEntries:
    """Entries of ∫ ∇φ_i · ∇φ_j.

    On a triangle with edges e_i, e_j opposite to the nodes i, j this is e_i · e_j / (4 |T|).

    Parameters
    ----------
    modes
        Positions of the nodes by weight (weights×2×nodes).
    triangles
        Nodes of the triangles (3×t).
    rows, columns
        The nodes i and j (k,), equal or neighbours.
    """

    def __init__(self, modes: Array, triangles: NDArray[np.integer], rows: Indices, columns: Indices) -> None:
        entry, triangle = _shared(triangles, rows, columns)
        nodes = triangles[:, triangle]
        i, j = (np.argmax(nodes == wanted[entry], axis=0) for wanted in (rows, columns))
        # The third edge is needed for the area: on the diagonal the edges opposite to i and to j are the same.
        edges = np.stack([_opposite(modes, nodes, local) for local in (i, j, (i + 1) % 3)], axis=2)
        self._edges = edges.reshape(len(modes), -1)  # weight × (component, edge, contribution)
        # `reduceat` returns a wrong value for an empty range: every entry must have a triangle, as neighbours do.
        self._starts = np.searchsorted(entry, np.arange(len(rows)))

    def __call__(self, weights: Array) -> Array:
        """The entries (k,) at some weights."""
        (xi, xj, xk), (yi, yj, yk) = (weights @ self._edges).reshape(2, 3, -1)
        contributions = 0.5 * (xi * xj + yi * yj) / np.abs(xi * yk - yi * xk)
        return np.asarray(np.add.reduceat(contributions, self._starts))


class LoadEntries:
    """Entries of ∫ φ_i: one third of the area of the triangles at node i.

    Parameters
    ----------
    modes, triangles
        As for `StiffnessEntries`.
    rows
        The nodes i (k,).
    """

    def __init__(self, modes: Array, triangles: NDArray[np.integer], rows: Indices) -> None:
        entry, triangle = _shared(triangles, rows, rows)
        nodes = triangles[:, triangle]
        edges = np.stack([modes[:, :, nodes[k]] - modes[:, :, nodes[0]] for k in (1, 2)], axis=2)
        self._edges = edges.reshape(len(modes), -1)
        self._starts = np.searchsorted(entry, np.arange(len(rows)))

    def __call__(self, weights: Array) -> Array:
        """The entries (k,) at some weights."""
        (x1, x2), (y1, y2) = (weights @ self._edges).reshape(2, 2, -1)
        return np.asarray(np.add.reduceat(np.abs(x1 * y2 - y1 * x2) / 6.0, self._starts))


def _shared(triangles: NDArray[np.integer], rows: Indices, columns: Indices) -> tuple[Indices, Indices]:
    """Pairs of an entry and a triangle that contains both of its nodes, sorted by entry: two index arrays."""
    pairs = [
        (k, t)
        for k, (i, j) in enumerate(zip(rows, columns, strict=True))
        for t in np.flatnonzero(np.any(triangles == i, axis=0) & np.any(triangles == j, axis=0))
    ]
    incidences = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return incidences[:, 0], incidences[:, 1]


def _opposite(modes: Array, nodes: NDArray[np.integer], local: Indices) -> Array:
    """Edges (weights×2×contributions) opposite to a local node of each triangle, in the triangle's orientation."""
    at = np.arange(nodes.shape[1])
    return np.asarray(modes[:, :, nodes[(local + 2) % 3, at]] - modes[:, :, nodes[(local + 1) % 3, at]])
