"""Solutions to be looked at: a picture in the plane, and fields on a mesh for programs that show meshes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vibench.arrays import Array, Indices


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
