"""Packs with one mistake that an exporting user may make: each has a line of its own, and none runs."""

from __future__ import annotations

import gzip
import io
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp
from packs import SIZE, Cable, manifest, write_arrays, write_cable, write_manifest
from running import Main
from samples import write_study

from vibench.errors import RequestError
from vibench.packs import reader
from vibench.packs.checks import read_model_pack
from vibench.study.matrix import read_study

Content = dict[str, Any]
Mistake = Callable[[Content, Cable, Path], None]

MISTAKES: dict[str, tuple[str, Mistake]] = {}
"""By name: what the line says, and a function that changes the manifest, the arrays, or, at the end, the files."""


def mistake(line: str) -> Callable[[Mistake], Mistake]:
    def add(function: Mistake) -> Mistake:
        MISTAKES[function.__name__] = (line, function)
        return function

    return add


def simple(name: str, line: str, *path: str | int, to: Any) -> None:
    """A mistake in one value of the manifest."""

    def change(content: Content, cable: Cable, folder: Path) -> None:
        place: Any = content
        for step in path[:-1]:
            place = place[step]
        place[path[-1]] = to

    MISTAKES[name] = (line, change)


def later(folder: Path, change: Callable[[Path], None]) -> None:
    """Change a file once everything is written."""
    AFTER.append(lambda: change(folder))


AFTER: list[Callable[[], None]] = []

simple("future format", "format is 2; this version of vibench reads format 1", "format", to=2)
simple("unknown key", "spaces: no key is called 'X_U'; did you mean 'X_[VW]'", "spaces", "X_U", to="X_V.mtx")
simple("unknown table", "no key is called 'operatorz'; did you mean 'operators'", "operatorz", to={})
simple("number for a name", "spaces.X_V: Input should be a valid string", "spaces", "X_V", to=3)
simple("index base 2", "index_base: Input should be 0 or 1", "index_base", to=2)
simple("same names", "two parameters have the same name: load, load", "parameters", "names", to=["load", "load"])
simple("name of a constant", "'e' is a constant of expressions; give the", "parameters", "names", to=["load", "e"])
simple("name of a function", "'max' is a function of expressions", "parameters", "names", to=["max", "depth"])
simple("micro and mu", "two parameters have the same name: μ, μ", "parameters", "names", to=["\u00b5", "\u03bc"])
simple(
    "a point twice", r"training: the points 0 and 2 are the same, \[4.0, 0.2\]", "parameters", "training",
    to=[[4.0, 0.2], [6.0, 0.2], [4.0, 0.2]],
)  # fmt: skip
simple(
    "a point nearly twice", "validation: the points 0 and 1 are the same", "parameters", "validation",
    to=[[5.0, 0.2], [5.0 + 1e-9, 0.2], [6.0, 0.3]],
)  # fmt: skip
simple("name with a hyphen", "'my-load' cannot stand in expressions", "parameters", "names", to=["my-load", "depth"])
simple("units", "parameters.units has 1 entries for 2 parameters", "parameters", "units", to=["m"])
simple("bounds", "lower bound 9 of 'load' is above its upper bound 8", "parameters", "lower", to=[9.0, 0.1])
simple(
    "outside the box",
    r"point 1 has 'load' = 80, outside the box \[4, 8\]",
    "parameters",
    "training",
    to=[[4, 0.2], [80, 0.2]],
)
simple(
    "point too short", "every point needs 2 values, one for each of load, depth", "parameters", "training", to=[[4.0]]
)
simple("grid", "grid has 1 counts for 2 parameters", "parameters", "training", to={"grid": [3]})
simple(
    "unknown parameter",
    "no parameter is called 'laod'; did you mean 'load'",
    "operators",
    "f",
    "affine",
    0,
    "theta",
    to="-laod",
)
simple(
    "call in theta",
    "no function of expressions is called 'system'",
    "operators",
    "f",
    "affine",
    0,
    "theta",
    to="system('rm')",
)
simple("attribute in theta", "contains an attribute", "operators", "f", "affine", 0, "theta", to="load.real")
simple("broken theta", "is not an expression", "operators", "f", "affine", 0, "theta", to="2 load")
simple("infinite theta", "division by zero", "operators", "f", "affine", 0, "theta", to="1 / (load - 6)")
simple(
    "both ways",
    r"give exactly one of constant, affine, each \(found constant and each\)",
    "operators",
    "A",
    to={"constant": "A.npz", "each": "A{}.npz"},
)
simple(
    "no theta",
    r"give exactly one of theta, table \(found none\)",
    "operators",
    "f",
    to={"affine": [{"array": "vectors.npz:mass"}]},
)
simple(
    "outside the folder",
    "'../A.npz' is not the name of a file inside the pack's folder",
    "operators",
    "A",
    to="../A.npz",
)
simple("absolute path", "'/etc/A.npz' is not the name of a file inside", "operators", "A", to="/etc/A.npz")
simple("missing file", "the file 'K.npz' does not exist", "operators", "A", to="K.npz")
simple(
    "missing array",
    "no array in 'vectors.npz' is called 'masse'; did you mean 'mass'",
    "operators",
    "f",
    to="vectors.npz:masse",
)
simple("unread format", "'A.mat' has a format that is not read; expected one of .npz", "operators", "A", to="A.mat")
simple("several arrays", "has several arrays: name one", "operators", "f", to="solutions.npz")
simple("each without number", "has no {} that stands for the number", "operators", "A", to={"each": "A.npz"})
simple(
    "fewer arrays than parameters",
    "operators.A, parameter 0: the file 'A0.npz' does not exist",
    "operators",
    "A",
    to={"each": "A{}.npz"},
)
simple("columns", r"operators.g.each: an array 12×3; expected 12×5", "operators", "g", to={"each": "solutions.npz:lam"})
simple(
    "table",
    r"affine.0.table: 12; expected 5",
    "operators",
    "f",
    "affine",
    to=[{"table": "vectors.npz:mass", "array": "vectors.npz:mass"}],
)
simple(
    "B is missing", "operators.B: required, but not given", "operators", to={"A": "A.npz", "f": "f.npz", "g": "g.npz"}
)
simple("no X_V", "spaces.X_V: required with", "spaces", to={"X_W": "spaces.npz:X_W"})


@mistake("give both 'lower' and 'upper', or neither")
def one_bound(content: Content, cable: Cable, folder: Path) -> None:
    del content["parameters"]["upper"]


@mistake(r"without the table \[operators\] a pack consists of")
def nothing_to_do(content: Content, cable: Cable, folder: Path) -> None:
    del content["operators"], content["solutions"]


@mistake("pack.toml' does not exist")
def no_manifest(content: Content, cable: Cable, folder: Path) -> None:
    later(folder, lambda folder: (folder / "pack.toml").unlink())


@mistake("not valid TOML")
def no_toml(content: Content, cable: Cable, folder: Path) -> None:
    later(folder, lambda folder: (folder / "pack.toml").write_text("format = \n"))


@mistake("together: the points 1 and 4 are the same")
def a_point_that_is_trained_and_validated(content: Content, cable: Cable, folder: Path) -> None:
    content["parameters"]["validation"][1] = [6.0, 0.2]
    content["operators"]["g"] = {"each": "g.npz"}
    later(folder, lambda folder: np.savez(folder / "g.npz", g=np.ones((SIZE, 5))))


@mistake("parameters.validation: required, since arrays")
def nothing_to_validate_on(content: Content, cable: Cable, folder: Path) -> None:
    del content["parameters"]["validation"]
    content["operators"]["g"] = {"each": "solutions.npz:lam"}


@mistake("'A.npz' is a symbolic link")
def symbolic_link(content: Content, cable: Cable, folder: Path) -> None:
    def link(folder: Path) -> None:
        (folder / "A.npz").rename(folder.parent / "elsewhere.npz")
        (folder / "A.npz").symlink_to("../elsewhere.npz")

    later(folder, link)


@mistake("is not a regular file")
def named_pipe(content: Content, cable: Cable, folder: Path) -> None:
    def pipe(folder: Path) -> None:
        (folder / "A.npz").unlink()
        os.mkfifo(folder / "A.npz")

    later(folder, pipe)


class Payload:
    def __reduce__(self) -> Any:
        return (os._exit, (3,))


@mistake(r"holds Python objects \(a pickle\)")
def pickled_objects(content: Content, cable: Cable, folder: Path) -> None:
    later(folder, lambda folder: np.savez(folder / "vectors.npz", mass=np.array([Payload()], dtype=object)))


@mistake("a .npz that is a pickle|'A.npz' is damaged")
def bare_pickle(content: Content, cable: Cable, folder: Path) -> None:
    later(folder, lambda folder: (folder / "A.npz").write_bytes(pickle.dumps(Payload())))


@mistake("too big for memory: the arrays of the pack take")
def zip_bomb(content: Content, cable: Cable, folder: Path) -> None:
    def bomb(folder: Path) -> None:
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (2**22,)})
        with zipfile.ZipFile(folder / "vectors.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("mass.npy", header.getvalue() + bytes(8 * 2**22))

    later(folder, bomb)


@mistake("is larger than its file")
def lying_header(content: Content, cable: Cable, folder: Path) -> None:
    def lie(folder: Path) -> None:
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (2**50,)})
        with zipfile.ZipFile(folder / "vectors.npz", "w") as archive:
            archive.writestr("mass.npy", header.getvalue())

    later(folder, lie)


def write_header(folder: Path, shape: tuple[int, ...], content: bytes) -> None:
    """An array in a compressed file whose header says what it likes."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(folder / "vectors.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mass.npy", header.getvalue() + content)


@mistake("its shape -1 is negative")
def negative_shape(content: Content, cable: Cable, folder: Path) -> None:
    later(folder, lambda folder: write_header(folder, (-1,), bytes(2**25)))


@mistake("its shape -3×-4 is negative")
def negative_shape_of_positive_size(content: Content, cable: Cable, folder: Path) -> None:
    later(folder, lambda folder: write_header(folder, (-3, -4), bytes(96)))


@mistake("operators.f.affine.0: too big for memory")
def bytes_that_become_doubles(content: Content, cable: Cable, folder: Path) -> None:
    later(folder, lambda folder: np.savez_compressed(folder / "vectors.npz", mass=np.ones(3 * 2**20, np.int8)))


@mistake("operators.A: too big for memory")
def padded_text(content: Content, cable: Cable, folder: Path) -> None:
    content["operators"]["A"] = "A.mtx.gz"
    head, line = b"%%MatrixMarket matrix coordinate real general\n12 12 110000\n", b"1 1 1.0" + b" " * 120 + b"\n"
    later(folder, lambda folder: (folder / "A.mtx.gz").write_bytes(gzip.compress(head + 110_000 * line, 1)))


simple("grid of a billion points", "pack': too big for memory", "parameters", "training", to={"grid": [10**6, 10**6]})
simple("grid beyond int64", "too big for memory: the arrays of the pack take .*e", "parameters", "training",
       to={"grid": [10**18, 10**18]})  # fmt: skip


@mistake("has .* bytes, at most 16777216 are read")
def manifest_without_end(content: Content, cable: Cable, folder: Path) -> None:
    later(folder, lambda folder: os.truncate(folder / "pack.toml", 2**40))


@mistake("is longer than the 1 entries that it declares")
def gzip_bomb(content: Content, cable: Cable, folder: Path) -> None:
    content["operators"]["A"] = "A.mtx.gz"
    text = b"%%MatrixMarket matrix coordinate real general\n12 12 1\n1 1 1.0\n" + b" " * 10**6
    later(folder, lambda folder: (folder / "A.mtx.gz").write_bytes(gzip.compress(text)))


@mistake("the field 'pattern', it holds no values")
def pattern_only(content: Content, cable: Cable, folder: Path) -> None:
    content["operators"]["A"] = "A.mtx"
    later(folder, lambda folder: scipy.io.mmwrite(folder / "A.mtx", sp.coo_array(cable.A), field="pattern"))


@mistake("operators.A: it holds complex numbers")
def complex_numbers(content: Content, cable: Cable, folder: Path) -> None:
    cable.A = cable.A * (1.0 + 0j)


@mistake("operators.f.affine.0: 1 of its entries are not finite")
def not_a_number(content: Content, cable: Cable, folder: Path) -> None:
    cable.mass[3] = np.nan


@mistake("they count from 1, so the manifest needs index_base = 1")
def indices_from_one(content: Content, cable: Cable, folder: Path) -> None:
    content["operators"]["A"] = "triplets.npz"
    A = sp.coo_array(cable.A)
    parts = {"row": A.coords[0] + 1, "col": A.coords[1] + 1, "data": A.data, "shape": np.array(A.shape)}
    later(folder, lambda folder: np.savez(folder / "triplets.npz", **parts))


@mistake("indices do not fit the shape 12×12")
def indices_beyond_the_matrix(content: Content, cable: Cable, folder: Path) -> None:
    cable.A.indices = cable.A.indices + 5


@mistake("has its upper triangle only; store both")
def one_triangle(content: Content, cable: Cable, folder: Path) -> None:
    cable.A = sp.csr_array(sp.triu(cable.A))


@mistake("operators.A is not symmetric: entries differ by 1.0e-0?3$")
def not_symmetric(content: Content, cable: Cable, folder: Path) -> None:
    cable.A = sp.csr_array(cable.A + sp.csr_array(([1e-3], ([0], [5])), shape=cable.A.shape))


@mistake("rows of Dirichlet unknowns were replaced and their columns kept")
def replaced_dirichlet_row(content: Content, cable: Cable, folder: Path) -> None:
    dense = cable.A.toarray()
    dense[0] = np.eye(SIZE)[0]
    cable.A = sp.csr_array(dense)


@mistake("couples 1 unknowns with no other, the first is 0.*rows of Dirichlet unknowns were left in")
def dirichlet_rows_left_in(content: Content, cable: Cable, folder: Path) -> None:
    dense = cable.A.toarray()
    dense[0], dense[:, 0] = np.eye(SIZE)[0], np.eye(SIZE)[0]
    cable.A = sp.csr_array(dense)


@mistake("diagonal entries of 1e.30 at 1 unknowns, the first is 0: a penalty for Dirichlet")
def penalty_left_in(content: Content, cable: Cable, folder: Path) -> None:
    cable.A = sp.csr_array(cable.A + sp.csr_array(([1e30], ([0], [0])), shape=cable.A.shape))


@mistake("constants are in its kernel: Dirichlet conditions were not applied")
def no_dirichlet_conditions(content: Content, cable: Cable, folder: Path) -> None:
    dense = cable.A.toarray()
    dense[0, 0] = dense[-1, -1] = dense[0, 0] / 2.0
    cable.A = sp.csr_array(dense)


@mistake("the sign of A is the opposite one")
def negative_stiffness(content: Content, cable: Cable, folder: Path) -> None:
    cable.A = -cable.A


@mistake("spaces.X_V .*; it is the product of a seminorm, without the L² part")
def seminorm(content: Content, cable: Cable, folder: Path) -> None:
    dense = cable.A.toarray()
    dense[0, 0] = dense[-1, -1] = dense[0, 0] / 2.0
    cable.X_V = sp.csr_array(dense)


@mistake("spaces.X_W: a matrix 12×11; expected a square one")
def rectangular_gram_matrix(content: Content, cable: Cable, folder: Path) -> None:
    cable.X_W = sp.csr_array(cable.X_W[:, 1:])


@mistake("operators.A: 14×14; expected 12×12; if it has the Dirichlet unknowns, too")
def all_unknowns(content: Content, cable: Cable, folder: Path) -> None:
    cable.A = sp.csr_array(sp.block_diag([[[1.0]], cable.A, [[1.0]]]))


@mistake("operators.B: 12×5; expected 5×12; it is transposed")
def transposed_constraint(content: Content, cable: Cable, folder: Path) -> None:
    cable.X_W, cable.B = sp.csr_array(cable.X_W[:5, :5]), sp.csr_array(cable.B[:, :5])


@mistake("parameters.training: an array 0×2; expected P×2 with P > 0, a row per parameter$")
def no_points(content: Content, cable: Cable, folder: Path) -> None:
    np.savez(folder / "points.npz", none=np.empty((0, 2)))
    content["parameters"]["training"] = "points.npz:none"


@mistake("spaces.contact: 9 unknowns that B touches are not in it, the first is 1; leave it out, and they are found")
def contact_without_unknowns_of_constraints(content: Content, cable: Cable, folder: Path) -> None:
    """As of numbers that were stored in a type too small for them."""
    np.savez(folder / "contact.npz", few=np.array([0, 2, 2, 3], np.uint8))
    content["spaces"]["contact"] = "contact.npz:few"


@mistake("operators.B is zero: no constraint acts")
def no_constraint(content: Content, cable: Cable, folder: Path) -> None:
    cable.B = 0.0 * cable.B


@mistake("probably λ has the other sign: with B u ≤ g")
def other_multiplier(content: Content, cable: Cable, folder: Path) -> None:
    cable.lam = -cable.lam


@mistake("probably the constraints are B u ≥ g: write B and g with the other sign")
def other_constraint(content: Content, cable: Cable, folder: Path) -> None:
    cable.B = -cable.B
    content["operators"]["g"]["affine"][0]["theta"] = "-depth"


@mistake("probably the constraints are B u ≥ g and λ ≤ 0")
def other_constraint_and_multiplier(content: Content, cable: Cable, folder: Path) -> None:
    other_constraint(content, cable, folder)
    cable.lam = -cable.lam


@mistake("probably f has the other sign")
def other_load(content: Content, cable: Cable, folder: Path) -> None:
    content["operators"]["f"]["affine"][0]["theta"] = "load"


@mistake("probably g has the other sign")
def other_gap(content: Content, cable: Cable, folder: Path) -> None:
    content["operators"]["g"]["affine"][0]["theta"] = "-depth"


@mistake("probably B has the other sign")
def other_operator(content: Content, cable: Cable, folder: Path) -> None:
    cable.B = -cable.B


@mistake("probably u has the other sign")
def other_u(content: Content, cable: Cable, folder: Path) -> None:
    cable.u = -cable.u


@mistake("probably the energy has no factor ½")
def energy_without_half(content: Content, cable: Cable, folder: Path) -> None:
    cable.A, cable.X_V = sp.csr_array(0.5 * cable.A), sp.csr_array(cable.X_W + cable.A)


@mistake("probably λ are nodal forces")
def forces(content: Content, cable: Cable, folder: Path) -> None:
    cable.lam = cable.X_W @ cable.lam


@mistake("but that of parameter 2: the columns are in another order")
def other_order(content: Content, cable: Cable, folder: Path) -> None:
    cable.u, cable.lam = cable.u[:, ::-1], cable.lam[:, ::-1]


@mistake("does not solve the problem: A u . Bᵀλ = f is violated by")
def inaccurate(content: Content, cable: Cable, folder: Path) -> None:
    cable.lam = 1.01 * cable.lam


@mistake("solutions.u: an array 3×12; expected 12×3, a column per parameter; it is transposed")
def transposed_solutions(content: Content, cable: Cable, folder: Path) -> None:
    cable.u = cable.u.T


@mistake("solutions.lam has 2 columns for 5 parameters")
def a_solution_is_missing(content: Content, cable: Cable, folder: Path) -> None:
    cable.u, cable.lam = cable.u[:, :2], cable.lam[:, :2]


@mistake("solutions.lam has both signs")
def both_signs(content: Content, cable: Cable, folder: Path) -> None:
    del content["operators"], content["solutions"]["u"]
    cable.lam[3, 1] *= -1.0


@mistake("solutions.lam is negative: λ has the other sign")
def negative_snapshots(content: Content, cable: Cable, folder: Path) -> None:
    del content["operators"], content["solutions"]["u"]
    cable.lam = -cable.lam


@mistake("no constraint is active, there is nothing to reduce")
def no_contact(content: Content, cable: Cable, folder: Path) -> None:
    cable.lam = 0.0 * cable.lam


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Function that writes a pack with a mistake; 16 MiB of arrays are read at most."""
    monkeypatch.setattr(reader, "memory_limit", lambda: 2**24)

    def write(name: str) -> Path:
        folder, content, cable = tmp_path / "pack", manifest(), Cable()
        folder.mkdir()
        AFTER.clear()
        MISTAKES[name][1](content, cable, folder)
        write_arrays(folder, cable)
        write_manifest(folder, content)
        for change in AFTER:
            change()
        return folder

    return write


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_has_its_line(name: str, broken: Callable[[str], Path]) -> None:
    folder = broken(name)
    with pytest.raises(RequestError, match=MISTAKES[name][0]) as caught:
        read_model_pack(folder)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("pack '")
    with pytest.raises(RequestError, match="pack '"):  # and no study on it is started
        read_study(write_study(folder.parent, study_on(folder, 2)))


def test_there_are_many_mistakes_and_as_many_lines() -> None:
    lines = [line for line, _ in MISTAKES.values()]
    assert len(set(lines)) == len(lines) > 40


def study_on(folder: Path, validation: int) -> Content:
    """A study on a pack."""
    return {
        "name": "broken", "validation": validation, "solvers": ["piqp"], "dual": ["cpg"], "primal": ["decorrelated"],
        "problem": [{"name": "pack", "options": {"path": str(folder)}}], "tolerances": [{"N": [1], "R": [1]}],
    }  # fmt: skip


@pytest.mark.parametrize("name", ["unknown key", "missing file", "other_multiplier", "zip_bomb", "no_manifest"])
def test_a_broken_pack_neither_imports_nor_runs(name: str, broken: Callable[[str], Path], main: Main) -> None:
    folder = broken(name)
    code, out, line = main("pack", str(folder))
    assert (code, out) == (2, "")
    code, out, again = main("run", write_study(Path(), study_on(folder, 2)))
    assert (code, out) == (2, "")
    assert line.removeprefix("vibench: ") in again
    assert not Path("runs").exists()


def test_more_validation_parameters_than_are_listed_are_refused_before_a_run(tmp_path: Path) -> None:
    study = write_study(tmp_path, study_on(write_cable(tmp_path / "pack"), 3))
    with pytest.raises(RequestError, match="lists 2 validation parameters, the study asks for 3: set validation = 2"):
        read_study(study)
