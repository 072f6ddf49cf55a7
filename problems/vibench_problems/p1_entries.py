"""P1 stiffness matrices and load vectors on meshes whose nodes move, as a whole and by single entries."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from vibench import Array, Indices, SparseMatrix


class MovedMesh:
    """∫ ∇φ_i · ∇φ_j and ∫ φ_i of the free nodes of one triangulation, for any positions of its nodes.

    On a triangle with edges e_i, e_j opposite to the nodes i, j they are e_i · e_j / (4 |T|) and |T| / 3. Which of
    these numbers make which entry is found once.

    Parameters
    ----------
    triangles
        Nodes of the triangles (3×t).
    free
        The nodes (n,) without Dirichlet conditions, rising.
    nodes
        The number of all nodes.
    """

    def __init__(self, triangles: NDArray[np.integer], free: Indices, nodes: int) -> None:
        self._triangles = triangles
        number = np.full(nodes, -1)
        number[free] = np.arange(len(free))
        numbers = number[triangles]
        rows, columns = np.repeat(numbers, 3, axis=0).ravel(), np.tile(numbers, (3, 1)).ravel()
        self._pairs, keys = _summing(rows * len(free) + columns, (rows >= 0) & (columns >= 0))
        self._corners, _ = _summing(numbers.ravel(), numbers.ravel() >= 0)
        self._columns = (keys % len(free)).astype(np.int32)
        self._ends = np.searchsorted(keys // len(free), np.arange(len(free) + 1)).astype(np.int32)

    def forms(self, points: Array) -> tuple[SparseMatrix, Array]:
        """The stiffness matrix (n×n) and the load vector (n,) of nodes at `points` (2×nodes)."""
        products, areas = _on_triangles(points[:, self._triangles])
        stiffness, load = self._pairs @ products.ravel(), self._corners @ np.tile(areas / 3.0, 3)
        # copies, since libraries sort indices in place
        matrix = sp.csr_array((stiffness, self._columns.copy(), self._ends.copy()), shape=2 * load.shape)
        return matrix, np.asarray(load)


def _summing(keys: Indices, kept: NDArray[np.bool_]) -> tuple[SparseMatrix, Indices]:
    """The matrix that sums the entries of each kept key, in rising order, and these keys."""
    positions = np.flatnonzero(kept)
    distinct, places = np.unique(keys[positions], return_inverse=True)
    return sp.csr_array((np.ones(len(positions)), (places, positions)), shape=(len(distinct), len(keys))), distinct


class TriangleForms:
    """∫ ∇φ_i · ∇φ_j and ∫ φ_i over single triangles.

    Parameters
    ----------
    modes, triangles
        As for `StiffnessEntries`.
    """

    def __init__(self, modes: Array, triangles: NDArray[np.integer]) -> None:
        self._corners = modes[:, :, triangles]

    def __call__(self, weights: Array) -> tuple[Array, Array]:
        """The matrices (t×3×3) and the vectors (t×3) at some weights."""
        products, areas = _on_triangles(np.tensordot(weights, self._corners, axes=1))
        return np.moveaxis(products, 2, 0), np.repeat(areas[:, None] / 3.0, 3, axis=1)


def _on_triangles(corners: Array) -> tuple[Array, Array]:
    """e_i · e_j / (4 |T|) (3×3×t) and |T| (t,) of triangles with these corners (2×3×t)."""
    x, y = corners.take([1, 2, 0], axis=1) - corners.take([2, 0, 1], axis=1)
    areas = 0.5 * np.abs(x[0] * y[1] - x[1] * y[0])
    return (x[:, None] * x + y[:, None] * y) / (4.0 * areas), areas


class Products:
    """Sums over pairs of weights w_a w_b T_ab: products of two vectors that are both linear in the weights.

    Parameters
    ----------
    terms
        T (weights×weights×k).
    """

    def __init__(self, terms: Array) -> None:
        self._first, self._second = np.triu_indices(len(terms))
        halves = np.where(self._first == self._second, 0.5, 1.0)[:, None]
        self._terms = halves * (terms[self._first, self._second] + terms[self._second, self._first])

    def __call__(self, weights: Array) -> Array:
        """The products (k,) at some weights."""
        return np.asarray((weights.take(self._first) * weights.take(self._second)) @ self._terms)


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
        ei, ej, ek = (_opposite(modes, nodes, local) for local in (i, j, (i + 1) % 3))
        self._products = Products(np.concatenate([0.5 * np.einsum("axk,bxk->abk", ei, ej), _cross(ei, ek)], axis=2))
        # `reduceat` returns a wrong value for an empty range: every entry must have a triangle, as neighbours do.
        self._count, self._starts = len(entry), np.searchsorted(entry, np.arange(len(rows)))

    def __call__(self, weights: Array) -> Array:
        """The entries (k,) at some weights."""
        found = self._products(weights)
        return np.asarray(np.add.reduceat(found[: self._count] / np.abs(found[self._count :]), self._starts))


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
        one, other = (modes[:, :, nodes[k]] - modes[:, :, nodes[0]] for k in (1, 2))
        self._products, self._starts = Products(_cross(one, other) / 6.0), np.searchsorted(entry, np.arange(len(rows)))

    def __call__(self, weights: Array) -> Array:
        """The entries (k,) at some weights."""
        return np.asarray(np.add.reduceat(np.abs(self._products(weights)), self._starts))


def _cross(one: Array, other: Array) -> Array:
    """x_a y_b − y_a x_b (weights×weights×k) of vectors by weight (weights×2×k)."""
    products = np.einsum("ak,bk->abk", one[:, 0], other[:, 1]) - np.einsum("ak,bk->abk", one[:, 1], other[:, 0])
    return np.asarray(products)


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
