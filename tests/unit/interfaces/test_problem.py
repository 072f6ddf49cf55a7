from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
from numerics import Varying

from vibench import MeshFields, ParameterBox, Picture, Stop, VariationalInequality, checked_assembly
from vibench.errors import NumericalError, RequestError

BOX = ParameterBox(("a", "b"), np.array([0.0, -1.0]), np.array([1.0, 3.0]), ("1", "m"))


def test_parameters_of_a_box_are_in_grids_samples_and_unit_cubes() -> None:
    grid = BOX.grid(2, 3)
    assert grid.tolist() == [[0, -1], [0, 1], [0, 3], [1, -1], [1, 1], [1, 3]]
    box = ParameterBox(("a", "b", "c"), np.array([-2.0, 1.0, 3.0]), np.array([4.0, 5.0, 3.0]), ("1",) * 3)
    places = np.array([[0.0, 0.25, 0.0], [1.0, 0.75, 0.0]])
    assert np.allclose(box.to_unit(box.from_unit(places)), places, atol=1e-15)  # the width of a point is not zero
    assert np.allclose(box.to_unit(np.array([1.0, 2.0, 3.0])), [0.5, 0.25, 0.0])
    sample = BOX.sample(50, seed=7)
    assert np.all((sample >= BOX.lower) & (sample <= BOX.upper))
    assert np.array_equal(sample, BOX.sample(50, seed=7))
    assert not np.array_equal(sample, BOX.sample(50, seed=8))
    assert np.array_equal(sample[:10], BOX.sample(10, seed=7))


def test_right_assemblies_pass_and_wrong_ones_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = Varying()
    vi = checked_assembly(problem, np.array([0.3]))
    assert vi.B.shape == (8, 30)
    assert np.isclose(problem.multiplier_integrals().sum(), problem.W.matrix.sum())
    good = problem.assemble(np.array([0.3]))
    far = replace(good, g=np.append(good.g[:-1], 1e250), f=1e-200 * good.f)
    monkeypatch.setattr(problem, "assemble", lambda mu: far)
    assert checked_assembly(problem, np.array([0.3])) is far
    for member, wrong, message in (
        ("A", lambda vi: vi.A[:-1], r"A has shape \(29, 30\).*require \(30, 30\)"),
        ("g", lambda vi: np.append(vi.g, 1.0), r"g has shape \(9,\)"),
        ("f", lambda vi: vi.f * np.nan, "f has entries that are not finite"),
        ("B", lambda vi: sp.csr_array(vi.B * np.inf), "B has entries that are not finite"),
        ("f", lambda vi: np.where(np.arange(30) == 3, -np.inf, vi.f), "f has entries that are not finite"),
        ("g", lambda vi: vi.g * np.nan, "g has entries that are not finite"),
        ("A", lambda vi: sp.csr_array(vi.A * 1e200), "A has entries of up to .e.2.*: choose units"),
        ("B", lambda vi: sp.csr_array(vi.B * 1e-200), "B has entries of up to .e-2.*: choose units"),
        ("f", lambda vi: vi.f - 1e150, r"f has entries of up to 1e\+150 at mu = \[0.3\]; .* 1e-100 and 1e\+100"),
    ):
        problem = Varying()
        good = problem.assemble(np.array([0.3]))
        with np.errstate(invalid="ignore"):
            bad: VariationalInequality = replace(good, **{member: wrong(good)})
        monkeypatch.setattr(problem, "assemble", lambda mu, bad=bad: bad)
        with pytest.raises(NumericalError, match=message):
            checked_assembly(problem, np.array([0.3]))


def test_stops_are_a_tolerance_or_a_size_and_reached_as_they_say() -> None:
    for wrong in ({}, {"tolerance": 0.1, "size": 3}):
        with pytest.raises(RequestError, match="either a tolerance or a size"):
            Stop(**wrong)
    errors = np.array([1.0, 0.1, 0.01])
    assert Stop(tolerance=0.1).first_reached(errors) == 1
    assert Stop(tolerance=1e-3).first_reached(errors) is None
    assert Stop(size=2).first_reached(errors) == 2
    assert Stop(size=2).reached(2, 0.5)
    assert not Stop(size=2).reached(1, 0.0)
    assert (str(Stop(size=2)), str(Stop(tolerance=0.01))) == ("size 2", "tolerance 0.01")


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
