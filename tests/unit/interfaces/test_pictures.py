from dataclasses import replace
from typing import Any

import numpy as np

from vibench import MeshFields, Picture

CUBE = np.array([[x, y, z] for z in (0.0, 1.0) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=float)
"""Corners of a cube in the order of VTK."""

SOLID = MeshFields(
    CUBE,
    {"hexahedron": np.arange(8)[None], "tetra": np.array([[0, 1, 3, 4]]), "quad": np.array([[0, 1, 2, 3]])},
    {"u [m]": np.zeros((8, 3)), "T [K]": np.full(8, np.nan)},
    {"quad": {"pressure [Pa]": np.ones(1)}},
)
"""A cube with one of its corners and one of its sides."""

WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "nodes in the plane": ({"points": CUBE[:, :2]}, "points has dtype float64 and shape (8, 2)"),
    "nodes nowhere": ({"points": np.full((8, 3), np.nan)}, "points is not finite"),
    "an unknown type": ({"cells": {"hexa": np.arange(8)[None], "quad": np.arange(4)[None]}}, "cells['hexa']: no type"),
    "an element of another order": (
        {"cells": {"hexahedron20": np.arange(8)[None], "quad": np.arange(4)[None]}}, "expected indices (k, 20)",
    ),
    "floats for nodes": ({"cells": {"quad": np.arange(4.0)[None]}}, "has dtype float64 and shape (1, 4)"),
    "one node too many": ({"cells": {"quad": np.array([[0, 1, 2, 8]])}}, "refers to nodes 0 to 8; there are 8"),
    "nodes of another body": ({"cells": {"quad": np.array([[0, 1, 2, -1]])}}, "refers to nodes -1 to 2"),
    "a hexahedron inside out": (
        {"cells": {"hexahedron": np.arange(8)[None, [4, 5, 6, 7, 0, 1, 2, 3]], "quad": np.arange(4)[None]}},
        "cells['hexahedron']: 1 of 1 cells are inside out",
    ),
    "a hexahedron as products number it": (
        {"cells": {"hexahedron": np.arange(8)[None, [0, 1, 3, 2, 4, 5, 7, 6]], "quad": np.arange(4)[None]}},
        "order of VTK",
    ),
    "a flat tetrahedron": (
        {"cells": {"tetra": np.arange(4)[None], "quad": np.arange(4)[None]}}, "cells['tetra']: 1 of 1 cells",
    ),
    "a field without a node": ({"at_points": {"T [K]": np.zeros(7)}}, "expected float64 of shape (8,) or (8, 3)"),
    "an infinite field": ({"at_points": {"T [K]": np.full(8, np.inf)}}, "at_points['T [K]'] is not finite"),
    "a field of cells that there are not": (
        {"in_cells": {"wedge": {"p": np.ones(1)}}}, "in_cells has 'wedge', of which there are no cells",
    ),
    "a field of more cells": ({"in_cells": {"quad": {"p": np.ones(2)}}}, "in_cells['quad']['p'] has dtype float64"),
}  # fmt: skip


def test_right_meshes_pass_and_what_no_solution_has_is_named() -> None:
    for changed, expected in WRONG.values():
        (fault,) = replace(SOLID, **changed).faults()
        assert expected in fault
    for dtype in (np.int32, np.uint64, np.intp):
        cells = {name: corners.astype(dtype) for name, corners in SOLID.cells.items()}
        assert list(replace(SOLID, cells=cells).faults()) == []
    points = np.vstack([CUBE, np.zeros((12, 3))])
    right = MeshFields(points, {"hexahedron20": np.arange(20)[None]}, {}, {})
    assert list(right.faults()) == []
    assert "inside out" in next(replace(right, points=points * [1.0, 1.0, -1.0]).faults())
    x = np.array([1.0, 0.0, 0.5])
    line = Picture(x[None], np.zeros((3, 0), dtype=int), x, "u [m]", x[None, :2], x[:2], "λ [N/m]")
    plane = replace(line, points=np.stack([x, x**2]), triangles=np.array([[0], [1], [2]]))
    for picture in (line, plane):
        assert list(MeshFields.of_picture(picture).faults()) == []
