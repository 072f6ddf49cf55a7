from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from samples import pga_reduction

import vibench
from vibench import RequestError, Stop, create, export_vtu
from vibench.offline.reduction import high_fidelity_sweep

meshio = pytest.importorskip("meshio")

NEIGHBOURS = [(1, 3, 4), (2, 0, 5), (3, 1, 6), (0, 2, 7), (7, 5, 0), (4, 6, 1), (5, 7, 2), (6, 4, 3)]
"""Those of each corner of a hexahedron in the order of VTK, right-handed."""

SMALL = {"hertz3d": {"resolution": 1350}, "hertz": {"resolution": 300}, "obstacle": {"resolution": 200}}


@cache
def model_of(name: str) -> vibench.Model:
    """A model of few snapshots, whose errors are large."""
    problem = create("problem", name, SMALL[name])
    box = problem.parameters
    training = box.lower + np.array([[0.1], [0.5], [0.9]]) * box.widths
    reduction = pga_reduction(problem, Stop(size=3), Stop(size=3))
    return reduction.given(snapshots=high_fidelity_sweep(problem, training)).model


@pytest.mark.parametrize("name", SMALL)
def test_the_file_has_both_solutions_and_their_differences(name: str, tmp_path: Path) -> None:
    model = model_of(name)
    mu = model.parameters.lower + 0.3 * model.parameters.widths
    written = meshio.read(export_vtu(model, mu, tmp_path / "deep" / "fields.vtu"))
    answer, exact = model.solve(mu), model.high_fidelity(mu)
    fields = model.problem.mesh_fields(mu, exact.u, exact.lam)
    assert np.array_equal(written.points, fields.points)
    assert {block.type: len(block.data) for block in written.cells} == {k: len(v) for k, v in fields.cells.items()}
    for kind, u, lam in (("high fidelity", exact.u, exact.lam), ("reduced", answer.u, answer.lam)):
        expected = model.problem.mesh_fields(mu, u, lam)
        for quantity, values in expected.at_points.items():
            assert np.array_equal(written.point_data[f"{quantity}, {kind}"], values, equal_nan=True)
        for owner, named in expected.in_cells.items():
            for quantity, values in named.items():
                blocks = dict(zip(fields.cells, written.cell_data[f"{quantity}, {kind}"], strict=True))
                assert np.array_equal(blocks.pop(owner), values)
                assert all(np.isnan(others).all() for others in blocks.values())
    for quantity in fields.at_points:
        high, low, error = (written.point_data[f"{quantity}, {kind}"] for kind in ("high fidelity", "reduced", "error"))
        assert np.array_equal(error, low - high, equal_nan=True)
        assert np.nanmax(np.abs(error)) > 0.0


def test_cells_have_the_order_of_vtk_and_keep_their_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = create("problem", "hertz3d", SMALL["hertz3d"])
    zero = np.zeros(problem.V.dim), np.zeros(problem.W.dim)
    fields = problem.mesh_fields(problem.parameters.lower, *zero)
    corners = fields.points[fields.cells["hexahedron"]]
    for corner, beside in enumerate(NEIGHBOURS):
        edges = np.stack([corners[:, k] - corners[:, corner] for k in beside], axis=1)
        assert np.all(np.linalg.det(edges) > 0.0)
    square = fields.points[fields.cells["quad"]]
    sides = np.linalg.norm(square - np.roll(square, 1, axis=1), axis=2)
    assert np.allclose(sides, sides[0, 0])
    model = model_of("obstacle")
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    cells = {"triangle": np.array([[0, 1, 2]], dtype=np.uint64), "tetra": np.arange(4)[None]}
    stress = {"triangle": {"stress [Pa]": np.array([2.0])}, "tetra": {"stress [Pa]": np.array([3.0])}}
    monkeypatch.setattr(type(model.problem), "mesh_fields", lambda *_: vibench.MeshFields(points, cells, {}, stress))
    written = meshio.read(export_vtu(model, model.parameters.lower, tmp_path / "fields.vtu"))
    assert [values.tolist() for values in written.cell_data["stress [Pa], reduced"]] == [[2.0], [3.0]]


def test_requests_that_cannot_be_met_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of("obstacle")
    mu = model.parameters.lower
    (tmp_path / "there.vtu").touch()
    for name, line in (("fields.vtk", r"must end in \.vtu"), ("there.vtu", "exists")):
        with pytest.raises(RequestError, match=line):
            export_vtu(model, mu, tmp_path / name)
    right = model.problem.mesh_fields(mu, np.zeros(model.problem.V.dim), np.zeros(model.problem.W.dim))
    wrong = replace(right, cells={"polygon7": np.arange(7)[None]}, in_cells={})
    several = iter([right, replace(right, at_points={})])
    for what, given, line in (
        ("mesh_fields", lambda *_: wrong, r"mesh_fields.cells\['polygon7'\]: no type"),
        ("mesh_fields", lambda *_: next(several), "two"),
        ("picture", lambda *_: None, "neither mesh_fields nor a picture"),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(type(model.problem), what, given)
            with pytest.raises(RequestError, match=line):
                export_vtu(model, mu, tmp_path / "fields.vtu")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(RequestError, match="needs meshio"):
        export_vtu(model, mu, tmp_path / "fields.vtu")
