"""A small model pack, and packs with one thing changed."""

import contextlib
import copy
from collections.abc import Mapping
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from samples import toml

from vibench import VariationalInequality, solve_high_fidelity

SIZE = 12
LOADS, DEPTH = [4.0, 6.0, 8.0], 0.2

MANIFEST: Mapping[str, Any] = {
    "format": 1, "name": "cable",
    "parameters": {
        "names": ["load", "depth"], "units": ["N/m", "m"], "lower": [4.0, 0.1], "upper": [8.0, 0.4],
        "training": [[load, DEPTH] for load in LOADS], "validation": [[5.0, 0.2], [7.0, 0.3]],
    },
    "spaces": {"X_V": "spaces.npz:X_V", "X_W": "spaces.npz:X_W"},
    "operators": {
        "A": "A.npz", "f": {"affine": [{"theta": "-load", "array": "vectors.npz:mass"}]},
        "B": "B.npz", "g": {"affine": [{"theta": "depth", "array": "vectors.npz:mass"}]},
    },
    "solutions": {"u": "solutions.npz:u", "lam": "solutions.npz:lam"},
}  # fmt: skip


class Cable:
    def __init__(self) -> None:
        width = 1.0 / (SIZE + 1)
        off = np.ones(SIZE - 1)
        self.A = sp.csr_array(sp.diags_array([2.0 * np.ones(SIZE), -off, -off], offsets=[0, 1, -1]) / width)
        self.mass = np.full(SIZE, width)
        self.X_W = sp.csr_array(sp.diags_array(self.mass))
        self.X_V = sp.csr_array(self.X_W + self.A)
        self.B = -self.X_W
        found = [solve_high_fidelity(self.at(load, DEPTH)) for load in LOADS]
        self.u, self.lam = np.column_stack([s.u for s in found]), np.column_stack([s.lam for s in found])

    def at(self, load: float, depth: float) -> VariationalInequality:
        return VariationalInequality(self.A, -load * self.mass, self.B, depth * self.mass)


def group(name: str, matrix: Any) -> dict[str, Any]:
    matrix = sp.csr_array(matrix)
    parts = {"data": matrix.data, "indices": matrix.indices, "indptr": matrix.indptr, "shape": np.array(matrix.shape)}
    return {f"{name}/{part}": value for part, value in parts.items()}


def write_arrays(folder: Path, cable: Cable) -> None:
    np.savez(folder / "spaces.npz", **group("X_V", cable.X_V), **group("X_W", cable.X_W))
    np.savez(folder / "vectors.npz", mass=cable.mass)
    np.savez(folder / "solutions.npz", u=cable.u, lam=cable.lam)
    sp.save_npz(folder / "A.npz", cable.A)
    sp.save_npz(folder / "B.npz", cable.B)


def write_manifest(folder: Path, content: Mapping[str, Any]) -> None:
    (folder / "pack.toml").write_text(toml(content), encoding="utf-8")


def manifest(changes: Mapping[str, Any] = {}) -> dict[str, Any]:
    """The manifest with other values at some paths, such as "operators.g.affine.0.theta"; `...` removes one."""
    content = copy.deepcopy(dict(MANIFEST))
    for path, to in changes.items():
        *steps, last = (int(step) if step.isdigit() else step for step in path.split("."))
        place: Any = reduce(lambda place, step: place[step], steps, content)
        if to is ...:
            del place[last]
        else:
            place[last] = to
    return content


def write_cable(folder: Path) -> Path:
    folder.mkdir(parents=True)
    write_arrays(folder, Cable())
    write_manifest(folder, MANIFEST)
    return folder


def write_mesh(folder: Path, name: str, secret: str) -> dict[str, Any]:
    """Write a mesh of two triangles, and return the table of the manifest; formats of several files name `secret`."""
    x, y = np.linspace(0.0, 1.0, SIZE), np.zeros(SIZE)
    points, corners = np.column_stack([x, np.where(x == 1.0, 1.0, 0.0), y]), [[0, 1, SIZE - 1], [1, 2, SIZE - 1]]
    elsewhere = {
        ".xdmf": '<Xdmf Version="3.0"><Domain><Grid><Geometry GeometryType="XYZ">'
        f'<DataItem DataType="Float" Dimensions="3 3" Format="Binary" Precision="8">{secret}</DataItem></Geometry>'
        '<Topology TopologyType="Triangle" NumberOfElements="1">'
        '<DataItem DataType="Int" Dimensions="1 3" Format="XML" Precision="8">0 1 2</DataItem>'
        "</Topology></Grid></Domain></Xdmf>",
        ".inp": f"*INCLUDE, INPUT={secret}\n",
    }
    import meshio  # noqa: PLC0415  optional

    file = folder / name
    form = {".msh": "gmsh22", ".mesh": "medit"}.get(file.suffix.lower(), file.suffix.lower()[1:])
    if form in ("vtu", "vtk", "gmsh22", "medit", "ply", "stl", "off", "obj"):
        with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):  # it warns of what formats lack
            meshio.Mesh(points, {"triangle": corners}).write(file, file_format=form)
    else:
        file.write_text(elsewhere.get(file.suffix, secret))
    np.savez(folder / "mesh.npz", points=np.arange(2), positions=x)
    named = {"points": "mesh.npz:points", "unknowns": "mesh.npz:points", "positions": "mesh.npz:positions"}
    return {"file": name, **named}
