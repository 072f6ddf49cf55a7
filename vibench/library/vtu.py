"""Solutions of a reduced model and of its high-fidelity problem, side by side in a file for ParaView."""

from __future__ import annotations

import importlib.util
from collections import defaultdict
from itertools import chain
from pathlib import Path

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.files import scratch, write_atomically, writing
from vibench.interfaces.outputs import MeshFields
from vibench.offline.models import Model, Parameters


def export_vtu(model: Model, mu: Parameters, file: Path | str) -> Path:
    """Write u and λ of a reduced model and of the high-fidelity problem at one parameter, and their differences.

    The file is one of VTK's unstructured grids, which ParaView and meshio read, on the mesh of the high-fidelity
    solution; fields of cells are NaN in cells that do not have them. Raises a `RequestError` if meshio is not
    installed, the problem has neither `mesh_fields` nor a picture, or has wrong ones, the parameter is outside the box,
    a solution fails, or the file exists or cannot be written.

    Parameters
    ----------
    model, mu
        The reduced model, and the parameter (d,).
    file
        Its name ends in .vtu.
    """
    file = Path(file)
    if file.suffix != ".vtu":
        raise RequestError(f"'{file}': the fields are written as a vtu file, whose name must end in .vtu")
    if importlib.util.find_spec("meshio") is None:
        raise RequestError("a vtu file needs meshio: pip install 'vibench[mesh]'")
    # Refuse an existing file before minutes of solving.
    with writing(file):
        if file.exists():
            raise RequestError(f"'{file}' exists; choose another name, or remove it")
    answer, reference = model.solve(mu), model.high_fidelity(mu)
    exact, reduced = (model.problem.mesh_fields(answer.mu, one.u, one.lam) for one in (reference, answer))
    name = type(model.problem).__name__
    if exact is None or reduced is None:
        raise RequestError(f"the problem '{name}' has neither mesh_fields nor a picture")
    for fault in chain(exact.faults(), reduced.faults()):
        raise RequestError(f"the problem '{name}': mesh_fields.{fault}")
    if _shapes(exact) != _shapes(reduced):
        raise RequestError(f"the problem '{name}': mesh_fields gives two solutions different meshes or fields")
    with writing(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, _written(exact, reduced))
    return file


def _shapes(fields: MeshFields) -> tuple[dict[str, tuple[int, ...]], dict[str, list[str]]]:
    """Shapes and names of fields: equal if the fields can be subtracted."""
    arrays = {"points": fields.points, **fields.cells, **fields.at_points}
    return {name: array.shape for name, array in arrays.items()}, {k: sorted(v) for k, v in fields.in_cells.items()}


def _written(exact: MeshFields, reduced: MeshFields) -> bytes:
    """The file of two solutions on the mesh of the first one."""
    import meshio  # noqa: PLC0415  an extra

    at_points = {
        f"{name}, {kind}": values
        for name, first in exact.at_points.items()
        for kind, values in _compared(first, reduced.at_points[name])
    }
    # Fields of some types of cells are NaN in the others: VTK wants every field in all cells.
    in_cells = defaultdict[str, list[Array]](lambda: [np.full(len(each), np.nan) for each in exact.cells.values()])
    for place, owner in enumerate(exact.cells):
        for name, first in exact.in_cells.get(owner, {}).items():
            for kind, values in _compared(first, reduced.in_cells[owner][name]):
                in_cells[f"{name}, {kind}"][place] = values
    # VTK has no other integers than these.
    cells = [(owner, corners.astype(np.int64)) for owner, corners in exact.cells.items()]
    mesh = meshio.Mesh(exact.points, cells, point_data=at_points, cell_data=in_cells)
    # meshio writes only to named files; a scratch file keeps the final one complete or absent.
    with scratch() as folder:
        mesh.write(folder / "fields.vtu")
        return (folder / "fields.vtu").read_bytes()


def _compared(exact: Array, reduced: Array) -> list[tuple[str, Array]]:
    return [("high fidelity", exact), ("reduced", reduced), ("error", reduced - exact)]
