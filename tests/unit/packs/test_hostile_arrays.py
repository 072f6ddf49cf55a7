"""Arrays that no code wrote in good faith: each ends in one line, and no interpreter ends because of it."""

import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packs import Cable as Arrays
from packs import manifest, write_cable, write_manifest

from vibench import RequestError
from vibench.packs import read_model_pack

N = 12
READ = """
import sys
from pathlib import Path
from vibench.errors import RequestError
from vibench.packs import read_model_pack
for name in sys.argv[1:]:
    print(Path(name).name, end="\\t", flush=True)
    try:
        pack = read_model_pack(name)
        print("read", abs(pack.members["A"].arrays[0] @ range(12)).sum())
    except RequestError as error:
        print(error)
"""
"""What reads packs, one after the other: a process of its own, since some of them ended it by a signal."""

A = Arrays().A
PARTS = {"data": A.data, "indices": A.indices, "indptr": A.indptr, "shape": np.array(A.shape)}
HUGE = 2**63
JUMP = np.array([0, *[HUGE] * (N - 1), A.nnz], np.uint64)
DOWN = np.array([0, 200, *A.indptr[2:]])
TRIPLETS = {"row": A.tocoo().coords[0], "col": A.tocoo().coords[1], "data": A.data, "shape": np.array(A.shape)}
TOO_FAR = np.where(np.arange(A.nnz) == 3, 200, A.indices)

REFUSED: dict[str, tuple[str, dict[str, Any]]] = {
    "indptr of 2^63": ("indptr", {"indptr": JUMP}),
    "indptr of uint32": ("indptr", {"indptr": DOWN.astype(np.uint32)}),
    "indptr of uint8": ("indptr", {"indptr": DOWN.astype(np.uint8)}),
    "indptr of fractions": ("indptr", {"indptr": A.indptr + 0.5}),
    "indptr of NaN": ("indptr", {"indptr": np.full(N + 1, np.nan)}),
    "indptr of text": ("indptr", {"indptr": np.array([b"0"] * (N + 1))}),
    "indptr complex": ("indptr", {"indptr": A.indptr * (1 + 0j)}),
    "no indptr": ("indptr", {"indptr": np.zeros(0, int)}),
    "indices of 2^63": ("indices", {"indices": np.full(A.nnz, HUGE, np.uint64)}),
    "indices of uint8": ("indices", {"indices": TOO_FAR.astype(np.uint8)}),
    "indices negative": ("indices", {"indices": -A.indices}),
    "indices of fractions": ("indices", {"indices": A.indices + 0.5}),
    "shape negative": ("shape", {"shape": np.array([-1, -1]), "indptr": np.zeros(0, int)}),
    "shape of 2^63": ("shape", {"shape": np.array([HUGE, HUGE], np.uint64)}),
    "shape of one": ("shape", {"shape": np.array([N])}),
    "shape of fractions": ("shape", {"shape": np.array([N + 0.5, N])}),
    "columns of 2^62": ("too big for memory", {"shape": np.array([N, 2**62])}),
    "no format": ("format", {"format": np.array([], "S3")}),
    "format of blocks": ("format", {"format": np.array("bsr", "S3")}),
}
"""By name: what the line says, and the arrays of a compressed matrix that are replaced."""

REFUSED_TRIPLETS: dict[str, tuple[str, dict[str, Any]]] = {
    "row of 2^63": ("it has values from 9223372036854775808", {"row": np.full(A.nnz, HUGE, np.uint64)}),
    "row of uint8": ("it has indices from 255", {"row": np.full(A.nnz, 255, np.uint8)}),
    "row complex": ("whole numbers", {"row": TRIPLETS["row"] * (1 + 0j)}),
    "triplets of negative shape": ("shape", {"shape": np.array([-N, -N])}),
}

ACCEPTED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "uint8": lambda a: a.astype(np.uint8), "uint64": lambda a: a.astype(np.uint64), "double": lambda a: a.astype(float),
    "big-endian": lambda a: a.astype(">i4"), "int16": lambda a: a.astype(np.int16),
}  # fmt: skip

MARKET = {
    "negative entries": ("%%MatrixMarket matrix coordinate real general\n12 12 -5\n", "operators.A"),
    "negative rows": ("%%MatrixMarket matrix coordinate real general\n-12 12 1\n1 1 1.0\n", "operators.A"),
    "index 0": ("%%MatrixMarket matrix coordinate real general\n12 12 1\n0 1 1.0\n", "operators.A"),
    "index beyond": ("%%MatrixMarket matrix coordinate real general\n12 12 1\n1 13 1.0\n", "operators.A"),
    "index of 2^63": (f"%%MatrixMarket matrix coordinate real general\n12 12 1\n{HUGE} 1 1.0\n", "operators.A"),
    "array negative": ("%%MatrixMarket matrix array real general\n-3 -3\n", "operators.A"),
    "integers": ("%%MatrixMarket matrix coordinate unsigned-integer general\n12 12 1\n1 1 1\n", "operators: A"),
}


def write(folder: Path, **parts: Any) -> Path:
    np.savez(write_cable(folder) / "A.npz", **parts)
    return folder


def read_in_a_process(folders: list[Path]) -> dict[str, str]:
    """What is said of each pack by a process that reads them all."""
    command = [sys.executable, "-W", "error", "-c", READ, *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, (done.returncode, done.stdout.splitlines()[-1:], done.stderr[-2000:])
    return dict(line.split("\t") for line in done.stdout.splitlines())


def test_index_arrays_of_any_type_are_checked_before_compiled_code_has_them(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    good = float(abs(A @ np.arange(N)).sum())
    folders = [write(tmp_path / name, **PARTS | parts) for name, (_, parts) in REFUSED.items()]
    folders += [write(tmp_path / name, **TRIPLETS | parts) for name, (_, parts) in REFUSED_TRIPLETS.items()]
    for (name, change), (prefix, parts) in product(ACCEPTED.items(), (("", PARTS), ("triplets ", TRIPLETS))):
        changed = {n: a if n == "data" else change(a) for n, a in parts.items()}
        folders.append(write(tmp_path / f"{prefix}{name}", **changed))
    for name, (text, _) in MARKET.items():
        folders.append(write_cable(tmp_path / name))
        write_manifest(folders[-1], manifest({"operators.A": "A.mtx"}))
        (folders[-1] / "A.mtx").write_text(text)
    with h5py.File(write_cable(tmp_path / "HDF5") / "A.h5", "w") as file:
        for name, array in (PARTS | {"indptr": JUMP}).items():
            file[f"A/{name}"] = array
    write_manifest(folders[-1].parent / "HDF5", manifest({"operators.A": "A.h5:A"}))
    said = read_in_a_process([*folders, tmp_path / "HDF5"])
    read = {name: said[name] for name in said if name.removeprefix("triplets ") in ACCEPTED}
    assert {float(line.removeprefix("read ")) for line in read.values()} == {good}
    words = {name: word for name, (word, _) in (REFUSED | REFUSED_TRIPLETS).items()}
    words |= {name: word for name, (_, word) in MARKET.items()} | {"HDF5": "indptr"}
    for name, word in words.items():
        assert not said[name].startswith("read"), name
        assert word in said[name]


@pytest.mark.parametrize("corner", [-1, 2**62, *(pytest.param(k, marks=pytest.mark.long) for k in (3, 2**31))])
def test_a_mesh_whose_triangles_lead_beyond_its_points_is_refused(corner: int, tmp_path: Path) -> None:
    meshio = pytest.importorskip("meshio")
    folder = write_cable(tmp_path / "cable")
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    meshio.Mesh(points, {"triangle": np.array([[0, 1, corner]])}).write(folder / "mesh.vtu", binary=False)
    np.savez(folder / "mesh.npz", points=[0, 1], positions=np.zeros(N))
    named = {key: f"mesh.npz:{key}" for key in ("points", "positions")}
    write_manifest(folder, manifest({"mesh": {"file": "mesh.vtu", **named}}))
    with pytest.raises(RequestError, match=r"triangles of 'mesh\.vtu' has values from .* expected 0 to 2"):
        read_model_pack(folder)


def test_indices_that_are_not_sorted_are_read(tmp_path: Path) -> None:
    order = np.concatenate([np.arange(A.indptr[k], A.indptr[k + 1])[::-1] for k in range(N)])
    parts = {"data": A.data[order], "indices": A.indices[order].astype(np.int64), "indptr": A.indptr.astype(np.int64)}
    pack = read_model_pack(write(tmp_path / "cable", **PARTS | parts))
    assert np.array_equal(pack.members["A"].arrays[0].toarray(), A.toarray())
