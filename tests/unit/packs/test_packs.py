import codecs
import gzip
import json
import re
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp
from packs import DEPTH, SIZE, Cable, group, manifest, write_arrays, write_cable, write_manifest
from running import Main
from samples import write_study

from vibench import MEMBERS, NumericalError, RequestError, VariationalInequality, checked_assembly, create, read_study
from vibench.highfidelity.active_set import HighFidelitySolver, solve_high_fidelity
from vibench.interfaces.absent_rows import ABSENT
from vibench.packs import pack_digest, read_model_pack, writer
from vibench.packs.pack import ModelPack, reduce_multipliers
from vibench.plugins.plugin import Plugin
from vibench.testing.problems import continuity
from vibench_problems.tresca import Tresca

MU = np.array([5.0, 0.2])
MASS, GAP = "operators.f.affine.0.array", "operators.g.affine.0.theta"
LISTED = np.array(manifest()["parameters"]["training"] + manifest()["parameters"]["validation"])


def pack_with(folder: Path, changes: dict[str, Any], **arrays: Any) -> ModelPack:
    """The pack of a changed manifest and further arrays."""
    folder.mkdir()
    write_arrays(folder, Cable())
    write_manifest(folder, manifest(changes))
    if arrays:
        np.savez(folder / "more.npz", **arrays)
    return read_model_pack(folder)


def assert_cable(pack: ModelPack) -> None:
    """The members at a parameter are those of the cable, whether its depth is a parameter or not."""
    found, expected = pack.at(MU[: pack.box.dim]), Cable().at(*MU)
    for name in MEMBERS:
        one, other = getattr(found, name), getattr(expected, name)
        assert abs(one - other).max() <= 1e-15 * abs(other).max(), name


def test_an_affine_pack_is_the_problem_anywhere_in_the_box(tmp_path: Path) -> None:
    folder = write_cable(tmp_path / "pack")
    for licence, given in (("unknown", {}), ("CC-BY-4.0", {"license": "CC-BY-4.0"})):
        write_manifest(folder, manifest(given))
        assert create("problem", "pack", {"path": str(folder)}).licence == licence
    pack = read_model_pack(folder)
    assert_cable(pack)
    assert pack.everywhere
    assert (pack.constant, pack.entrywise) == ({"A", "B"}, {"f", "g"})
    assert np.array_equal(pack.at(np.array([7.7, 0.11])).f, -7.7 * Cable().mass)
    assert np.array_equal(pack.contact, np.arange(SIZE))


def test_triplets_count_from_the_index_base_and_matrix_market_from_one(tmp_path: Path) -> None:
    cable, folder = Cable(), write_cable(tmp_path / "pack")
    A = sp.coo_array(cable.A)
    np.savez(folder / "more.npz", row=A.coords[0] + 1, col=A.coords[1] + 1, data=A.data, shape=np.array(A.shape))
    with gzip.open(folder / "B.mtx.gz", "wb") as file:
        scipy.io.mmwrite(file, sp.coo_array(cable.B))
    write_manifest(folder, manifest({"index_base": 1, "operators.A": "more.npz", "operators.B": "B.mtx.gz"}))
    assert_cable(read_model_pack(folder))


def test_hdf5_datasets_groups_and_links(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    folder = write_cable(tmp_path / "pack")
    with h5py.File(folder / "arrays.h5", "w") as file:
        for name, value in (group("A", Cable().A) | {"vectors/mass": Cable().mass}).items():
            file[name] = value
        file["soft"] = h5py.SoftLink("/vectors/mass")
        file["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
    write_manifest(folder, manifest({"operators.A": "arrays.h5:A", MASS: "arrays.h5:/vectors/mass"}))
    assert_cable(read_model_pack(folder))
    lines = {"soft": "is a link", "elsewhere": "is a link", "nothing": "no dataset", "vectors": "is a group"}
    for name, line in lines.items():
        write_manifest(folder, manifest({MASS: f"arrays.h5:{name}"}))
        with pytest.raises(RequestError, match=line):
            read_model_pack(folder)


def test_an_infinite_entry_of_g_is_a_row_that_constrains_nothing(tmp_path: Path, main: Main) -> None:
    content, g = {"operators.g": "more.npz:g"}, DEPTH * Cable().mass
    g[-1] = np.inf  # the multiplier is zero there
    pack = pack_with(tmp_path / "pack", content, g=g)
    assert pack.at(MU).g[-1] == ABSENT
    assert np.array_equal(pack.at(MU).g[:-1], g[:-1])
    assert main("pack", str(tmp_path / "pack"))[0] == 0
    for name, wrong in (("one", -np.inf), ("two", np.nan)):
        g[-1] = wrong
        with pytest.raises(RequestError, match=r"operators.g: 1 of its entries are not finite \(nan or -inf; inf"):
            pack_with(tmp_path / name, content, g=g)


@pytest.mark.parametrize("far", [1e12, 1e16, 1e20, np.inf])
def test_no_obstacle_on_every_second_row_leaves_the_others_in_force(tmp_path: Path, far: float) -> None:
    """A g of 1e20, as codes write it where there is none, once switched all rows off, and the solution was ok."""
    terms = [{"theta": "depth", "array": "more.npz:near"}, {"theta": "1", "array": "more.npz:far"}]
    second = np.arange(SIZE) % 2 == 1
    arrays = {"near": np.where(second, 0.0, Cable().mass), "far": np.where(second, far, 0.0)}
    pack = pack_with(tmp_path / "pack", {"solutions": ..., "operators.g": {"affine": terms}}, **arrays)
    vi = pack.at(MU)
    kept = np.flatnonzero(~second)
    alone = VariationalInequality(vi.A, vi.f, sp.csr_array(vi.B)[kept], vi.g[kept])
    solution, expected = solve_high_fidelity(vi), solve_high_fidelity(alone)
    assert np.any(expected.lam > 0.0)
    assert np.max(vi.B @ solution.u - vi.g) <= 1e-14
    assert np.allclose(solution.u, expected.u, rtol=1e-10, atol=0.0)
    assert np.allclose(solution.lam[kept], expected.lam, rtol=1e-10, atol=1e-14)
    assert not solution.lam[second].any()


@pytest.mark.parametrize("precision", [np.float16, np.float32])
def test_numbers_may_be_stored_in_few_digits(tmp_path: Path, precision: type) -> None:
    """What is stored is exact: computations with it are not made in its precision."""
    cable, content = Cable(), {"solutions": ..., "operators.A": "more.npz:A", "operators.B": "more.npz:B"}
    stored = {name: group(name, getattr(cable, name)) for name in ("A", "B", "X_V", "X_W")}
    mass = cable.mass.astype(precision)
    packs = []
    for dtype in (precision, np.float64):
        folder = tmp_path / str(np.dtype(dtype))
        folder.mkdir()
        few = {name: parts[f"{name}/data"].astype(precision).astype(dtype) for name, parts in stored.items()}
        groups = {name: parts | {f"{name}/data": few[name]} for name, parts in stored.items()}
        np.savez(folder / "spaces.npz", **groups["X_V"], **groups["X_W"])
        np.savez(folder / "more.npz", **groups["A"], **groups["B"])
        np.savez(folder / "vectors.npz", mass=mass.astype(dtype))
        write_manifest(folder, manifest(content))
        packs.append(read_model_pack(folder))
    few, many = packs
    for name in MEMBERS:
        one, other = (getattr(pack.at(MU), name) for pack in packs)
        assert one.dtype == np.float64
        assert abs(one - other).max() == 0.0, name
    assert abs(few.V.matrix - many.V.matrix).max() == 0.0
    assert np.array_equal(solve_high_fidelity(few.at(MU)).u, solve_high_fidelity(many.at(MU)).u)


def test_tables_and_arrays_by_parameter_hold_at_listed_parameters_only(tmp_path: Path) -> None:
    cable, table = Cable(), {"table": "more.npz:depths", "array": "vectors.npz:mass"}
    each = {f"operators.{name}": {"each": f"more.npz:{files}"} for name, files in (("A", "A{}"), ("f", "f"))}
    arrays = {key: value for k in range(5) for key, value in group(f"A{k}", cable.A).items()}
    arrays |= {"f": -np.outer(cable.mass, LISTED[:, 0]), "depths": LISTED[:, 1]}
    pack = pack_with(tmp_path / "pack", each | {"operators.g": {"affine": [table]}}, **arrays)
    assert_cable(pack)
    assert not pack.everywhere
    with pytest.raises(NumericalError, match=r"mu = \[5.5, 0.2\] is not listed"):
        pack.at(np.array([5.5, 0.2]))
    (note,) = continuity(Mock(points=9, plugin=create("problem", "pack", {"path": str(tmp_path / "pack")})))
    assert "listed parameters only" in str(note)


def test_rows_of_dirichlet_unknowns_are_removed_where_free_ones_are_named(tmp_path: Path) -> None:
    cable = Cable()

    def wide(matrix: Any) -> Any:
        return sp.csr_array(sp.block_diag([[[1.0]], matrix, [[1.0]]]))

    arrays = group("A", wide(cable.A)) | group("X_V", wide(cable.X_V)) | {"free": np.arange(1, SIZE + 1)}
    arrays |= {"mass": np.pad(cable.mass, 1), "u": np.pad(cable.u, ((1, 1), (0, 0)))}
    arrays |= group("B", sp.hstack([np.zeros((SIZE, 1)), cable.B, np.zeros((SIZE, 1))]))
    places = "spaces.X_V", "spaces.free", "operators.A", "operators.B", "solutions.u"
    content = {place: f"more.npz:{place.split('.')[1]}" for place in places} | {MASS: "more.npz:mass"}
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
    write_manifest(folder, manifest({"description": "another"}))
    assert plugin.as_installed().code not in (edited.code, plugin.code)
    (folder / "vectors.npz").unlink()
    with pytest.raises(RequestError, match=r"operators.f.affine.0: the file 'vectors.npz' does not exist"):
        plugin.as_installed()


def test_multipliers_alone_are_enough_for_cones(tmp_path: Path, main: Main) -> None:
    pack = pack_with(tmp_path / "pack", {"operators": ..., "solutions.u": ..., "spaces.X_V": ...})
    cone, _ = reduce_multipliers(pack, create("dual strategy", "mcpg", {}), 1e-3)
    assert cone.errors[-1] <= 1e-3
    code, out, _ = main("pack", str(tmp_path / "pack"))
    assert (code, "it has no operators" in out) == (0, True)
    code, out, _ = main("pack", str(tmp_path / "pack"), "--cones", "--dual", "cpg", "--dual", "mcpg", "--out", "here")
    assert code == 0
    assert {path.name for path in Path("here").iterdir()} == {"errors.csv", "errors.png", "errors.svg"}
    whole = str(write_cable(tmp_path / "whole"))
    assert main("pack", whole, "--cones", "--dual", "cpg")[0] == 0


def test_friction_with_a_given_bound_is_a_pack(tmp_path: Path, main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same numbers as the problem it is written of, with reference solutions in K on both of its sides."""
    few = type("Few", (Tresca,), {"training_set": lambda self: self.parameters.grid(2, 3)})
    problem, folder = few(4, growth=2.0), tmp_path / "pack"
    writer.write_pack(problem, folder, name="partial slip", source="", validation=1, seed=0, solutions=True)
    read = create("problem", "pack", {"path": str(folder)})
    assert read.K == problem.K
    mu = read.validation_set(1, 0)[0]
    one, other = HighFidelitySolver(problem).solve(mu), HighFidelitySolver(read).solve(mu)
    assert np.array_equal(one.u, other.u)
    assert np.array_equal(one.lam, other.lam)
    # Figures take seconds.
    monkeypatch.setattr("vibench.report.figures.style.save", lambda *_: [])
    monkeypatch.setattr("vibench.report.figures.spaces.cone_errors", lambda *_: None)
    code, out, _ = main("pack", str(folder), "--cones", "--dual", "hull-greedy", "--dual", "cpg", "--dual-tol", "0.1")
    assert code == 0
    assert "unavailable: cpg: the dual strategy CPG knows λ ≥ 0 alone; K has intervals" in out
    assert "hull-greedy" in out
    assert "K: 11 of the multipliers in intervals" in main("pack", str(folder))[1]
    # The sign of friction is what its multipliers show.
    lam = dict(np.load(folder / "solutions.npz"))
    np.savez(folder / "solutions.npz", u=lam["u"], lam=-lam["lam"])
    with pytest.raises(RequestError, match="probably λ has the other sign"):
        read_model_pack(folder)


def test_import_says_what_a_pack_can_do(tmp_path: Path, main: Main) -> None:
    code, out, _ = main("pack", str(write_cable(tmp_path / "pack")))
    assert code == 0
    for words in (
        "12 unknowns", "affine, 1 term", "KKT residuals up to", "anywhere in the box",
        "; reduced assembly sums the terms of f, g\n", "/pack --validation 2\n",
    ):  # fmt: skip
        assert words in out
    assert "interpolates" not in out
    assert "outputs" not in out


def test_import_solves_once_and_reads_a_byte_order_mark(tmp_path: Path, main: Main) -> None:
    folder = write_cable(tmp_path / "pack")
    (folder / "pack.toml").write_bytes(codecs.BOM_UTF8 + (folder / "pack.toml").read_bytes())
    scipy.io.mmwrite(folder / "A.mtx", Cable().A)
    (folder / "A.mtx").write_bytes(codecs.BOM_UTF8 + (folder / "A.mtx").read_bytes())
    (folder / "pack.toml").write_bytes((folder / "pack.toml").read_bytes().replace(b"A.npz", b"A.mtx"))
    code, out, _ = main("pack", str(folder))
    assert code == 0
    assert re.search(r"solved at mu = \[4.0, 0.2\]: \d+ of 12 multipliers are positive, KKT residuals up to \de-1", out)
    content = {"name": "marked", "validation": 2, "solvers": ["piqp"], "dual": ["cpg"], "primal": ["decorrelated"]}
    content |= {"tolerances": [{"N": [1], "R": [1]}]}
    problem = {"name": "pack", "options": {"path": str(folder)}}
    study = Path(write_study(tmp_path, content | {"problem": [problem]}))
    study.write_bytes(codecs.BOM_UTF8 + study.read_bytes())
    assert read_study(str(study)).name == "marked"


def test_import_refuses_a_pack_without_a_solution_and_names_empty_rows(tmp_path: Path, main: Main) -> None:
    cable = Cable()
    kept = cable.B
    cable.B = sp.csr_array(sp.vstack([kept[:6], -kept[:6]]))
    (tmp_path / "pack").mkdir()
    write_arrays(tmp_path / "pack", cable)
    write_manifest(tmp_path / "pack", manifest({"solutions": ..., GAP: "-depth"}))
    code, out, line = main("pack", str(tmp_path / "pack"))
    assert (code, out) == (2, "")
    assert "there is no solution: at mu = [4.0, 0.2]: rows 3 and 9 of B are opposite, and no u satisfies both" in line
    cable.B = sp.csr_array(sp.diags_array(np.arange(SIZE) % 2, dtype=float) @ kept)
    write_arrays(tmp_path / "pack", cable)
    write_manifest(tmp_path / "pack", manifest({"solutions": ...}))
    code, out, _ = main("pack", str(tmp_path / "pack"))
    assert code == 0
    assert "6 rows of B are zero at every listed parameter, the first is 0" in out


@pytest.mark.parametrize("bump", [0.0, 1e-3])
def test_import_names_outputs_and_what_is_interpolated_and_misses(tmp_path: Path, main: Main, bump: float) -> None:
    outputs = [{"name": "sag", "unit": "m", "u": "more.npz:sag"}]
    f = -np.outer(Cable().mass, LISTED[:, 0])
    f[0, 3:] *= 1.0 + bump
    content = {"operators.f": {"each": "more.npz:f"}, "outputs": outputs}
    pack_with(tmp_path / "pack", content, f=f, sag=np.ones(SIZE))
    code, out, _ = main("pack", str(tmp_path / "pack"))
    assert "; reduced assembly interpolates f and sums the terms of g\n" in out
    assert "\n  outputs: sag [m]\n" in out
    warned = re.search(r"warning: f, interpolated over 3 training parameters to 1e-06, has an error of (\S+) at", out)
    assert (code, bool(warned)) == (0, bump > 0.0)
    assert warned is None or 0.2 * bump < float(warned[1]) < bump


def test_a_pack_is_written_whole_or_not_at_all(tmp_path: Path, main: Main, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_cable(tmp_path / "pack")
    code, _, line = main("pack", "pack", str(folder), "--option", f"path={folder}", "--validation", "2")
    assert (code, "a pack is written into a new folder" in line) == (2, True)

    with monkeypatch.context() as patch:
        patch.setattr(HighFidelitySolver, "solve", Mock(side_effect=NumericalError("no solution")))
        assert main("pack", "pack", "new", "--option", f"path={folder}", "--validation", "2", "--solutions")[0] == 1
    assert list(Path().iterdir()) == []
    code, _, _ = main("pack", "pack", "new", "--option", f"path={folder}", "--validation", "2", "--solutions")
    assert code == 0
    assert_cable(read_model_pack("new"))
    assert [path.name for path in Path().iterdir()] == ["new"]


def test_constants_and_declared_sums_are_assembled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, assembled = create("problem", "pack", {"path": str(write_cable(tmp_path / "pack"))}), []
    monkeypatch.setattr(writer, "checked_assembly", lambda *given: assembled.append(1) or checked_assembly(*given))
    writer.write_pack(problem, tmp_path / "new", name="cable", source="", validation=2, seed=0)
    assert len(assembled) == 1
    assert_cable(read_model_pack(tmp_path / "new"))


def test_the_python_example_of_the_page_exports_a_pack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[3] / "docs" / "model-packs.md").read_text(encoding="utf-8")
    code = page.partition('```python title="export.py"\n')[2].partition("```")[0]
    cable, mu = Cable(), np.array([[4.0, 0.2], [5.0, 0.2], [8.0, 0.3]])
    monkeypatch.chdir(tmp_path)
    f, g = np.outer(-mu[:, 0], cable.mass), np.outer(mu[:, 1], cable.mass)
    exec(code, {"A": 3 * [cable.A], "B": 3 * [cable.B], "f": list(f), "g": list(g), "mu": mu})
    assert_cable(read_model_pack("my-model"))


def test_what_the_example_for_matlab_writes_is_read(tmp_path: Path) -> None:
    """The lines that its `fprintf` gives; an Octave to run it is not at hand everywhere."""
    page = (Path(__file__).parents[3] / "docs" / "model-packs.md").read_text(encoding="utf-8")
    code, cable = page.partition("```matlab\n")[2].partition("```")[0], Cable()
    assert "'%d %d %.17g\\n', [i(:) j(:) v(:)]'" in code
    columns = {"f": -cable.mass[:, None], "g": DEPTH * cable.mass[:, None]}
    for name, matrix in {"A": cable.A, "B": cable.B, "X_V": cable.X_V, "X_W": cable.X_W, **columns}.items():
        coo = sp.coo_array(matrix)
        head = "%%MatrixMarket matrix coordinate real general\n{} {} {}\n".format(*coo.shape, coo.nnz)
        lines = "".join(f"{i + 1} {j + 1} {v:.17g}\n" for i, j, v in zip(*coo.coords, coo.data, strict=True))
        (tmp_path / f"{name}.mtx").write_text(head + lines)
    manifest_lines = code.partition("pack.toml', 'w');")[2]
    texts = [part.partition("');")[0] for part in manifest_lines.split("fprintf(file, '")[1:]]
    (tmp_path / "pack.toml").write_text("".join(texts).replace("\\n", "\n"), encoding="utf-8")
    assert_cable(read_model_pack(tmp_path))


def test_a_mesh_gives_pictures(tmp_path: Path) -> None:
    meshio = pytest.importorskip("meshio")
    folder = write_cable(tmp_path / "pack")
    x = np.linspace(0.0, 1.0, SIZE + 2)
    points = np.concatenate([np.column_stack([x, y + 0.0 * x, 0.0 * x]) for y in (0.0, 1.0)])
    cells = [[k, k + 1, k + SIZE + 2] for k in range(SIZE + 1)]
    meshio.Mesh(points, {"triangle": cells}).write(folder / "mesh.vtu")
    np.savez(folder / "more.npz", points=np.arange(1, SIZE + 1), positions=x[1:-1])
    table = {"file": "mesh.vtu", "points": "more.npz:points", "positions": "more.npz:positions"}
    write_manifest(folder, manifest({"mesh": table}))
    problem = create("problem", "pack", {"path": str(folder)})
    cable = Cable()
    picture = problem.picture(MU, cable.u[:, 0], cable.lam[:, 0])
    assert picture.points.shape == (2, 2 * SIZE + 4)
    assert picture.triangles.shape == (3, SIZE + 1)
    assert np.array_equal(picture.values[1 : SIZE + 1], cable.u[:, 0])
    assert not picture.values[SIZE + 1 :].any()
    (folder / "mesh.vtu").write_text("<VTKFile>")
    with pytest.raises(RequestError, match=r"mesh.file: 'mesh.vtu' cannot be read"):
        read_model_pack(folder)


@pytest.mark.parametrize("where", ["m/{}/A.npz", "m{}/{}.npz", "A-{}.npz", ""])
def test_the_digest_has_every_file_of_a_numbered_name(where: str, tmp_path: Path) -> None:
    """A name with brackets that is not numbered is one file."""
    folder = write_cable(tmp_path / "pack")
    write_manifest(folder, manifest({"operators.A": {"each": where} if where else "A{}.npz"}))
    files = [folder / where.replace("{}", str(k)) for k in range(5)] if where else [folder / "A{}.npz"]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        sp.save_npz(file, Cable().A)
    read_model_pack(folder)
    before = pack_digest(folder)
    for file in files:
        sp.save_npz(file, 2.0 * Cable().A)
        assert pack_digest(folder) != before
        before = pack_digest(folder)


@pytest.mark.parametrize("written", ["\u00b5", "\u03bc"])
@pytest.mark.parametrize("named", ["\u00b5", "\u03bc"])
def test_the_micro_sign_and_mu_are_one_name(named: str, written: str, tmp_path: Path) -> None:
    content = {"parameters.names.0": named, "operators.f.affine.0.theta": f"-{written}"}
    pack = pack_with(tmp_path / "pack", content)
    assert pack.box.names == ("\u03bc", "depth")
    assert np.array_equal(pack.at(MU).f, -MU[0] * Cable().mass)
