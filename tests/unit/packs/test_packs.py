"""Model packs: what is read is what was written, in every format, and results of an edited one are not used again."""

from __future__ import annotations

import gzip
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp
from packs import SIZE, Cable, group, manifest, write_arrays, write_cable, write_manifest
from running import Main

from vibench.errors import NumericalError, RequestError
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces.problem import MEMBERS
from vibench.packs.checks import read_model_pack
from vibench.packs.dual_half import reduce_multipliers
from vibench.packs.pack import ModelPack
from vibench.study import registry
from vibench.study.cells import Plugin
from vibench.testing import check_problem

MU = np.array([5.0, 0.2])


def pack_with(folder: Path, content: dict[str, Any], **arrays: Any) -> ModelPack:
    """The pack of a changed manifest and further arrays."""
    folder.mkdir()
    write_arrays(folder, Cable())
    write_manifest(folder, content)
    if arrays:
        np.savez(folder / "more.npz", **arrays)
    return read_model_pack(folder)


def assert_cable(pack: ModelPack) -> None:
    """The members at a listed parameter are those of the cable."""
    found, expected = pack.at(MU), Cable().at(*MU)
    for name in MEMBERS:
        one, other = getattr(found, name), getattr(expected, name)
        assert abs(one - other).max() <= 1e-15 * abs(other).max(), name


def test_an_affine_pack_is_the_problem_anywhere_in_the_box(tmp_path: Path) -> None:
    pack = read_model_pack(write_cable(tmp_path / "pack"))
    assert_cable(pack)
    assert pack.everywhere
    assert (pack.constant, pack.entrywise) == ({"A", "B"}, {"f", "g"})
    assert np.array_equal(pack.at(np.array([7.7, 0.11])).f, -7.7 * Cable().mass)
    assert np.array_equal(pack.contact, np.arange(SIZE))


def test_the_problem_of_a_pack_conforms(tmp_path: Path) -> None:
    folder, content = write_cable(tmp_path / "pack"), manifest()
    del content["parameters"]["validation"]
    write_manifest(folder, content)
    check_problem(partial(registry.load("problem", "pack"), str(folder)))


def test_triplets_count_from_the_index_base_and_matrix_market_from_one(tmp_path: Path) -> None:
    content, cable, folder = manifest(), Cable(), write_cable(tmp_path / "pack")
    A = sp.coo_array(cable.A)
    np.savez(folder / "more.npz", row=A.coords[0] + 1, col=A.coords[1] + 1, data=A.data, shape=np.array(A.shape))
    with gzip.open(folder / "B.mtx.gz", "wb") as file:
        scipy.io.mmwrite(file, sp.coo_array(cable.B))
    content |= {"index_base": 1}
    content["operators"] |= {"A": "more.npz", "B": "B.mtx.gz"}
    write_manifest(folder, content)
    assert_cable(read_model_pack(folder))


def test_hdf5_datasets_groups_and_links(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    content, folder = manifest(), write_cable(tmp_path / "pack")
    content["operators"]["A"] = "arrays.h5:A"
    content["operators"]["f"] = {"affine": [{"theta": "-load", "array": "arrays.h5:/vectors/mass"}]}
    with h5py.File(folder / "arrays.h5", "w") as file:
        for name, value in (group("A", Cable().A) | {"vectors/mass": Cable().mass}).items():
            file[name] = value
        file["soft"] = h5py.SoftLink("/vectors/mass")
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
    write_manifest(folder, content)
    assert_cable(read_model_pack(folder))
    for name, line in (
        ("soft", "is a link"),
        ("elsewhere", "is a link"),
        ("nothing", "no dataset"),
        ("vectors", "is a group"),
    ):
        content["operators"]["f"]["affine"][0]["array"] = f"arrays.h5:{name}"
        write_manifest(folder, content)
        with pytest.raises(RequestError, match=line):
            read_model_pack(folder)


def test_tables_and_arrays_by_parameter_hold_at_listed_parameters_only(tmp_path: Path) -> None:
    content, cable = manifest(), Cable()
    listed = content["parameters"]["training"] + content["parameters"]["validation"]
    content["operators"] |= {
        "A": {"each": "more.npz:A{}"},
        "f": {"each": "more.npz:f"},
        "g": {"affine": [{"table": "more.npz:depths", "array": "vectors.npz:mass"}]},
    }
    arrays = {key: value for k in range(5) for key, value in group(f"A{k}", cable.A).items()}
    arrays |= {"f": np.column_stack([-load * cable.mass for load, _ in listed]), "depths": np.array(listed)[:, 1]}
    pack = pack_with(tmp_path / "pack", content, **arrays)
    assert_cable(pack)
    assert not pack.everywhere
    with pytest.raises(NumericalError, match=r"mu = \[5.5, 0.2\] is not listed"):
        pack.at(np.array([5.5, 0.2]))


def test_rows_of_dirichlet_unknowns_are_removed_where_free_ones_are_named(tmp_path: Path) -> None:
    content, cable = manifest(), Cable()

    def wide(matrix: Any) -> Any:
        return sp.csr_array(sp.block_diag([[[1.0]], matrix, [[1.0]]]))

    arrays = group("A", wide(cable.A)) | group("X_V", wide(cable.X_V)) | {"free": np.arange(1, SIZE + 1)}
    arrays |= {"mass": np.pad(cable.mass, 1), "u": np.pad(cable.u, ((1, 1), (0, 0)))}
    arrays |= group("B", sp.hstack([np.zeros((SIZE, 1)), cable.B, np.zeros((SIZE, 1))]))
    content["spaces"] |= {"X_V": "more.npz:X_V", "free": "more.npz:free"}
    content["operators"] |= {"A": "more.npz:A", "B": "more.npz:B"}
    content["operators"]["f"]["affine"][0]["array"] = "more.npz:mass"
    content["solutions"]["u"] = "more.npz:u"
    assert_cable(pack_with(tmp_path / "pack", content, **arrays))


def test_what_is_computed_from_a_pack_is_not_used_again_after_an_edit(tmp_path: Path) -> None:
    folder = write_cable(tmp_path / "pack")
    plugin = Plugin("problem", "pack", json.dumps({"path": str(folder)}), "").as_installed()
    (folder / "notes.txt").write_text("not part of the pack")
    assert plugin.as_installed() == plugin
    cable = Cable()
    cable.mass = 1.5 * cable.mass
    np.savez(folder / "vectors.npz", mass=cable.mass)
    edited = plugin.as_installed()
    assert edited.code != plugin.code
    write_manifest(folder, manifest() | {"description": "another"})
    assert plugin.as_installed().code not in (edited.code, plugin.code)
    (folder / "vectors.npz").unlink()
    with pytest.raises(RequestError, match=r"operators.f.affine.0: the file 'vectors.npz' does not exist"):
        plugin.as_installed()


def test_multipliers_alone_are_enough_for_cones(tmp_path: Path, main: Main) -> None:
    content = manifest()
    del content["operators"], content["solutions"]["u"], content["spaces"]["X_V"]
    pack = pack_with(tmp_path / "pack", content)
    found = reduce_multipliers(pack, registry.create("dual strategy", "mcpg", {}), 1e-3)
    assert found.cone.errors[-1] <= 1e-3
    code, out, _ = main("import", str(tmp_path / "pack"))
    assert (code, "it has no operators" in out) == (0, True)
    code, out, _ = main("cones", str(tmp_path / "pack"), "--dual", "cpg", "--dual", "mcpg", "--out", "here")
    assert code == 0
    assert {path.name for path in Path("here").iterdir()} == {"errors.csv", "errors.png", "errors.svg"}
    assert main("cones", str(write_cable(tmp_path / "whole")))[0] == 0


def test_import_says_what_a_pack_can_do(tmp_path: Path, main: Main) -> None:
    code, out, _ = main("import", str(write_cable(tmp_path / "pack")))
    assert code == 0
    for words in (
        "12 unknowns",
        "affine, 1 term",
        "KKT residuals up to",
        "anywhere in the box",
        "validation = 2 at most",
    ):
        assert words in out


def test_a_pack_is_written_whole_or_not_at_all(tmp_path: Path, main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_cable(tmp_path / "pack")
    code, _, line = main("pack", "pack", str(folder), "--option", f"path={folder}", "--validation", "2")
    assert (code, "a pack is written into a new folder" in line) == (2, True)

    def fail(self: HighFidelitySolver, mu: Any) -> Any:
        raise NumericalError("no solution")

    with monkeypatch.context() as patch:
        patch.setattr(HighFidelitySolver, "solve", fail)
        assert main("pack", "pack", "new", "--option", f"path={folder}", "--validation", "2", "--solutions")[0] == 1
    assert list(Path().iterdir()) == []
    code, _, _ = main("pack", "pack", "new", "--option", f"path={folder}", "--validation", "2", "--solutions")
    assert code == 0
    assert_cable(read_model_pack("new"))
    assert [path.name for path in Path().iterdir()] == ["new"]
