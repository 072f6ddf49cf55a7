import base64
import os
import zlib
from pathlib import Path

import numpy as np
import pytest
from packs import manifest, write_cable, write_manifest, write_mesh

from vibench import RequestError
from vibench.packs import pack_digest, read_model_pack
from vibench.packs.meshes import read_mesh

pytest.importorskip("meshio")

VTU = """<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" compressor="vtkZLibDataCompressor">
<UnstructuredGrid><Piece NumberOfPoints="{points}" NumberOfCells="1"><Points>
<DataArray type="Float64" Name="Points" NumberOfComponents="3" format="binary">{data}</DataArray>
</Points></Piece></UnstructuredGrid></VTKFile>"""


def with_mesh(folder: Path, name: str, secret: str = "") -> Path:
    table = write_mesh(write_cable(folder), name, secret)
    write_manifest(folder, manifest({"mesh": table}))
    return folder


# A process reads each of them.
MORE = (
    pytest.param(ending, marks=pytest.mark.long) for ending in (".msh", ".stl", ".vtk", ".mesh", ".ply", ".off", ".obj")
)


@pytest.mark.parametrize("ending", [".vtu", *MORE])
def test_formats_of_one_file_are_read(ending: str, tmp_path: Path) -> None:
    mesh = read_model_pack(with_mesh(tmp_path / "pack", f"mesh{ending}")).mesh
    corners = mesh.points[:, mesh.triangles]  # their numbers are those of the file, but in .stl
    assert np.allclose(corners, np.array([[[0, 1], [1, 2], [11, 11]], [[0, 0], [0, 0], [11, 11]]]) / 11, atol=1e-7)


@pytest.mark.parametrize("ending", [".xdmf", ".inp", ".ele", ".xml", ".med", ".cgns", ".e", ""])
def test_formats_that_name_other_files_are_refused_before_they_are_opened(ending: str, tmp_path: Path) -> None:
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).tofile(tmp_path / "secret")
    folder = with_mesh(tmp_path / "pack", f"mesh{ending}", str(tmp_path / "secret"))
    with pytest.raises(RequestError, match=r"mesh\.file: 'mesh.*' has a format that is not read; expected one whose"):
        read_model_pack(folder)


@pytest.mark.parametrize("ending", [".vtu", ".msh"])
def test_the_digest_has_the_mesh(ending: str, tmp_path: Path) -> None:
    folder = with_mesh(tmp_path / "pack", f"mesh{ending}")
    before = pack_digest(folder)
    file = folder / f"mesh{ending}"
    file.write_bytes(file.read_bytes() + b"\n")
    assert pack_digest(folder) != before


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_what_is_no_regular_file_is_no_mesh(kind: str, tmp_path: Path) -> None:
    folder = with_mesh(tmp_path / "pack", "mesh.vtu")
    file = folder / "mesh.vtu"
    file.unlink()
    if kind == "device":
        file.symlink_to("/dev/zero")
    else:
        (os.mkfifo if kind == "pipe" else os.mkdir)(file)
    for read in (read_model_pack, pack_digest):
        with pytest.raises(RequestError, match=r"is not a regular file|is a symbolic link"):
            read(folder)


@pytest.mark.long
def test_a_mesh_takes_no_more_memory_than_it_may(tmp_path: Path) -> None:
    count = 2**25
    block = zlib.compress(bytes(count), 9)
    header = np.array([1, count, count, len(block)], np.uint32).tobytes()
    text = base64.b64encode(header) + base64.b64encode(block)
    (tmp_path / "bomb.vtu").write_text(VTU.format(points=count // 24, data=text.decode()))
    entities = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10 if k else "lol"}">' for k in range(12))
    (tmp_path / "laughs.vtu").write_text(f"<!DOCTYPE x [{entities}]><VTKFile>&l11;</VTKFile>")
    head = "# vtk DataFile Version 4.2\nx\nASCII\nDATASET STRUCTURED_POINTS\nORIGIN 0 0 0\nSPACING 1 1 1\n"
    (tmp_path / "grid.vtk").write_text(f"{head}DIMENSIONS 100000 100000 1\n")
    for name in ("bomb.vtu", "grid.vtk", "laughs.vtu"):
        with pytest.raises(RequestError, match=rf"'{name}' cannot be read: it takes more than the 0.0312 GiB"):
            read_mesh(tmp_path / name, 2**25, 60)


def test_a_mesh_takes_no_more_seconds_than_it_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "long.obj").write_text("v 0 0 0\n" * 1_000_000)
    with pytest.raises(RequestError, match=r"'long\.obj' cannot be read: it takes more than 1 s"):
        read_mesh(tmp_path / "long.obj", 2**30, 1)
