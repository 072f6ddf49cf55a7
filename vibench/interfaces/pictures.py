"""Solutions to be looked at: a picture in the plane, and fields on a mesh for programs that show meshes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vibench.arrays import Array, Indices

NODES = {
    "vertex": 1, "line": 2, "line3": 3, "triangle": 3, "triangle6": 6, "quad": 4, "quad8": 8, "quad9": 9,
    "tetra": 4, "tetra10": 10, "pyramid": 5, "pyramid13": 13, "wedge": 6, "wedge15": 15, "hexahedron": 8,
    "hexahedron20": 20, "hexahedron27": 27,
}  # fmt: skip
"""Numbers of nodes of the types of cells, by meshio's names; the corners come first, as in VTK."""

RIGHT_HANDED = {
    "tetra": ((0, 1, 2, 3),),
    "hexahedron": (
        (0, 1, 3, 4), (1, 2, 0, 5), (2, 3, 1, 6), (3, 0, 2, 7), (4, 7, 5, 0), (5, 4, 6, 1), (6, 5, 7, 2), (7, 6, 4, 3),
    ),
}  # fmt: skip
"""Corners of cells in space, each followed by those beside it: three edges with a positive determinant."""


@dataclass(frozen=True)
class Picture:
    """A solution to be drawn.

    Attributes
    ----------
    points, triangles
        Mesh in the configuration to be drawn (2×p), (3×t); on a line points (1×p) and no triangles.
    values, name
        Nodal values of the colour map (p,), and their name with its unit.
    positions, multiplier
        Points of the multiplier (1×m on a line, 2×m in the plane) and its values (m,).
    multiplier_name
        Name of the multiplier, with its unit.
    length_unit
        Unit of the coordinates; "" where it is not said.
    """

    points: Array
    triangles: Indices
    values: Array
    name: str
    positions: Array
    multiplier: Array
    multiplier_name: str
    length_unit: str = ""


@dataclass(frozen=True)
class MeshFields:
    """A solution on a mesh.

    Attributes
    ----------
    points
        Nodes (p×3), in the configuration to be shown.
    cells
        Corners (k×v) of the cells of every type, by meshio's names of the types, such as "triangle" or "hexahedron".
    at_points
        Fields at the nodes (p,) or (p×3), by name with unit; NaN where there is none.
    in_cells
        Fields in the cells of one type (k,), by type and by name with unit.
    """

    points: Array
    cells: Mapping[str, Indices]
    at_points: Mapping[str, Array]
    in_cells: Mapping[str, Mapping[str, Array]]

    def faults(self) -> Iterator[str]:
        """What is wrong with the fields: shapes, types, nodes that do not exist, cells inside out."""
        count = len(self.points)
        if faults := list(_real_faults("points", self.points, (count, 3), missing=False)):
            yield from faults
            return
        for name, corners in self.cells.items():
            yield from self._cell_faults(name, np.asarray(corners))
        for name, values in self.at_points.items():
            yield from _real_faults(f"at_points[{name!r}]", values, (count,), (count, 3))
        for owner, named in self.in_cells.items():
            if owner not in self.cells:
                yield f"in_cells has {owner!r}, of which there are no cells; expected one of {sorted(self.cells)}"
                continue
            for name, values in named.items():
                yield from _real_faults(f"in_cells[{owner!r}][{name!r}]", values, (len(self.cells[owner]),))

    def _cell_faults(self, name: str, corners: Indices) -> Iterator[str]:
        where = f"cells[{name!r}]"
        if name not in NODES:
            yield f"{where}: no type of cells; expected one of {', '.join(NODES)}"
        elif not np.issubdtype(corners.dtype, np.integer) or corners.ndim != 2 or corners.shape[1] != NODES[name]:
            yield f"{where} has dtype {corners.dtype} and shape {corners.shape}; expected indices (k, {NODES[name]})"
        elif corners.size and (corners.min() < 0 or corners.max() >= len(self.points)):
            yield f"{where} refers to nodes {corners.min()} to {corners.max()}; there are {len(self.points)}"
        elif count := np.count_nonzero(self._inverted(name, corners)):
            yield (
                f"{where}: {count} of {len(corners)} cells are inside out or flat; expected nodes in the order of VTK, "
                "at every corner with edges that are right-handed"
            )

    def _inverted(self, name: str, corners: Indices) -> Any:
        """Which cells (k,) of a type have a corner whose edges are not right-handed."""
        inverted = np.zeros(len(corners), dtype=bool)
        for corner, *beside in RIGHT_HANDED.get(name.rstrip("0123456789"), ()):
            edges = self.points[corners[:, beside]] - self.points[corners[:, [corner]]]
            inverted |= np.linalg.det(edges) <= 0.0
        return inverted

    @classmethod
    def of_picture(cls, picture: Picture) -> MeshFields:
        """The triangles of a picture, or its line, with the colour map; the multiplier at vertices at its positions."""
        count, values = picture.points.shape[1], picture.values
        vertices = np.arange(count, count + picture.positions.shape[1])[:, None]
        points = np.zeros((count + len(vertices), 3))
        points[:count, : len(picture.points)] = picture.points.T
        points[count:, : len(picture.positions)] = picture.positions.T
        order = np.argsort(picture.points[0], kind="stable")
        line = {"line": np.column_stack([order[:-1], order[1:]])}
        cells = {"triangle": picture.triangles.T} if picture.triangles.size else line
        at_points = {picture.name: np.concatenate([values, np.full(len(vertices), np.nan)])}
        return cls(
            points, cells | {"vertex": vertices}, at_points, {"vertex": {picture.multiplier_name: picture.multiplier}}
        )


def _real_faults(name: str, values: Any, *shapes: tuple[int, ...], missing: bool = True) -> Iterator[str]:
    """Why values are not floats in one of the shapes, finite or, where some may be missing, NaN."""
    given = np.asarray(values)
    if given.shape not in shapes or given.dtype != np.float64:
        expected = " or ".join(map(str, shapes))
        yield f"{name} has dtype {given.dtype} and shape {given.shape}; expected float64 of shape {expected}"
    elif np.isinf(given).any() or (not missing and np.isnan(given).any()):
        yield f"{name} is not finite"
