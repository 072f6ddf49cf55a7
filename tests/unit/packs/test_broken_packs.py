import gzip
import io
import os
import pickle
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse as sp
from packs import SIZE, Cable, manifest, write_arrays, write_cable, write_manifest
from running import Main
from samples import write_study

from vibench import RequestError, read_study
from vibench.packs import read_model_pack, reader

Content = dict[str, Any]
Mistake = Callable[[Cable, Path], Content]

MISTAKES: dict[str, tuple[str, Mistake]] = {}
"""By name: what the line says, and a function that makes a manifest and changes arrays or, at the end, files."""


def changed(
    name: str, line: str, content: dict[str, Any], more: Mapping[str, Callable[[Cable], Any]] = {}, **arrays: Any
) -> None:
    """A mistake in values of the manifest by path, `...` for what is missing, in `more.npz`, and in other arrays."""

    def change(cable: Cable, folder: Path) -> Content:
        computed = {key: compute(cable) for key, compute in arrays.items()}
        if more:
            np.savez(folder / "more.npz", **{key: compute(cable) for key, compute in more.items()})
        vars(cable).update(computed)
        return manifest(content)

    MISTAKES[name] = (line, change)


def simple(name: str, line: str, path: str, to: Any) -> None:
    changed(name, line, {path: to})


def in_arrays(name: str, line: str, **arrays: Callable[[Cable], Any]) -> None:
    changed(name, line, {}, **arrays)


def in_files(name: str, line: str, change: Callable[[Path], object], A: str = "A.npz") -> None:
    """A mistake made once everything is written; the manifest names the file of A."""

    def plan(cable: Cable, folder: Path) -> Content:
        AFTER.append(lambda: change(folder))
        return manifest({"operators.A": A})

    MISTAKES[name] = (line, plan)


AFTER: list[Callable[[], object]] = []

simple("future format", "format is 2; this version of vibench reads format 1", "format", 2)
simple("unknown key", "spaces: no key is called 'X_U'; did you mean 'X_[VW]'", "spaces.X_U", "X_V.mtx")
simple("unknown table", "no key is called 'operatorz'; did you mean 'operators'", "operatorz", {})
simple("number for a name", "spaces.X_V: Input should be a valid string", "spaces.X_V", 3)
simple("index base 2", "index_base: Input should be 0 or 1", "index_base", 2)
simple("same names", "two parameters have the same name: load, load", "parameters.names", ["load", "load"])
simple("name of a constant", "'e' is a constant of expressions; give the", "parameters.names", ["load", "e"])
simple("name of a function", "'max' is a function of expressions", "parameters.names", ["max", "depth"])
simple("micro and mu", "two parameters have the same name: μ, μ", "parameters.names", ["\u00b5", "\u03bc"])
simple("name with a hyphen", "'my-load' cannot stand in expressions", "parameters.names", ["my-load", "depth"])
TWICE, NEARLY = [[4.0, 0.2], [6.0, 0.2], [4.0, 0.2]], [[5.0, 0.2], [5.0 + 1e-9, 0.2], [6.0, 0.3]]
simple("twice", r"training: the points 0 and 2 are the same, \[4.0, 0.2\]", "parameters.training", TWICE)
simple("nearly twice", "validation: the points 0 and 1 are the same", "parameters.validation", NEARLY)
simple("units", "parameters.units has 1 entries for 2 parameters", "parameters.units", ["m"])
simple("bounds", "lower bound 9 of 'load' is above its upper bound 8", "parameters.lower", [9.0, 0.1])
OUTSIDE = r"point 1 has 'load' = 80, outside the box \[4, 8\]"
simple("outside the box", OUTSIDE, "parameters.training", [[4, 0.2], [80, 0.2]])
simple("short point", "every point needs 2 values, one for each of load, depth", "parameters.training", [[4.0]])
simple("grid", "grid has 1 counts for 2 parameters", "parameters.training", {"grid": [3]})
simple("grid of a billion points", "pack': too big for memory", "parameters.training", {"grid": [10**6, 10**6]})
BEYOND = "too big for memory: the arrays of the pack take .*e"
simple("grid beyond int64", BEYOND, "parameters.training", {"grid": [10**18, 10**18]})
THETA = "operators.f.affine.0.theta"
simple("unknown parameter", "no parameter is called 'laod'; did you mean 'load'", THETA, "-laod")
simple("call in theta", "no function of expressions is called 'system'", THETA, "system('rm')")
simple("attribute in theta", "contains an attribute", THETA, "load.real")
simple("broken theta", "is not an expression", THETA, "2 load")
simple("infinite theta", "division by zero", THETA, "1 / (load - 6)")
simple("other load", "probably f has the other sign", THETA, "load")
simple("other gap", "probably g has the other sign", "operators.g.affine.0.theta", "-depth")
BOTH = r"give exactly one of constant, affine, each \(found constant and each\)"
simple("both ways", BOTH, "operators.A", {"constant": "A.npz", "each": "A{}.npz"})
MASS = "vectors.npz:mass"
simple("no theta", r"give exactly one of theta, table \(found none\)", "operators.f", {"affine": [{"array": MASS}]})
simple("table", r"affine.0.table: 12; expected 5", "operators.f.affine", [{"table": MASS, "array": MASS}])
simple("outside the folder", "'../A.npz' is not the name of a file inside the pack's folder", "operators.A", "../A.npz")
simple("absolute path", "'/etc/A.npz' is not the name of a file inside", "operators.A", "/etc/A.npz")
simple("missing file", "the file 'K.npz' does not exist", "operators.A", "K.npz")
MASSE = "no array in 'vectors.npz' is called 'masse'; did you mean 'mass'"
simple("missing array", MASSE, "operators.f", "vectors.npz:masse")
simple("unread format", "'A.mat' has a format that is not read; expected one of .npz", "operators.A", "A.mat")
simple("several arrays", "has several arrays: name one", "operators.f", "solutions.npz")
simple("each without number", "has no {} that stands for the number", "operators.A", {"each": "A.npz"})
FEWER = "operators.A, parameter 0: the file 'A0.npz' does not exist"
simple("fewer arrays than parameters", FEWER, "operators.A", {"each": "A{}.npz"})
simple("columns", r"operators.g.each: an array 12×3; expected 12×5", "operators.g", {"each": "solutions.npz:lam"})
NO_B = {"A": "A.npz", "f": "f.npz", "g": "g.npz"}
simple("B is missing", "operators.B: required, but not given", "operators", NO_B)
simple("no X_V", "spaces.X_V: required with", "spaces", {"X_W": "spaces.npz:X_W"})
simple("one bound", "give both 'lower' and 'upper', or neither", "parameters.upper", ...)
changed("nothing to do", r"without the table \[operators\] a pack consists of", {"operators": ..., "solutions": ...})
changed("nothing to validate on", "parameters.validation: required, since arrays",
        {"parameters.validation": ..., "operators.g": {"each": "solutions.npz:lam"}})  # fmt: skip
changed("a point that is trained and validated", "together: the points 1 and 4 are the same",
        {"parameters.validation.1": [6.0, 0.2], "operators.g": {"each": "more.npz:g"}},
        {"g": lambda c: np.ones((SIZE, 5))})  # fmt: skip


def link(folder: Path) -> None:
    (folder / "A.npz").rename(folder.parent / "elsewhere.npz")
    (folder / "A.npz").symlink_to("../elsewhere.npz")


def pipe(folder: Path) -> None:
    (folder / "A.npz").unlink()
    os.mkfifo(folder / "A.npz")


class Payload:
    def __reduce__(self) -> Any:
        return (os._exit, (3,))


def declare(shape: tuple[int, ...], content: bytes, compression: int = zipfile.ZIP_DEFLATED) -> Callable[[Path], None]:
    """Write an array whose header says what it likes."""

    def write(folder: Path) -> None:
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
        with zipfile.ZipFile(folder / "vectors.npz", "w", compression) as archive:
            archive.writestr("mass.npy", header.getvalue() + content)

    return write


def text(content: bytes) -> Callable[[Path], object]:
    head = b"%%MatrixMarket matrix coordinate real general\n12 12 "
    return lambda folder: (folder / "A.mtx.gz").write_bytes(gzip.compress(head + content, 1))


def mass(array: np.ndarray) -> Callable[[Path], object]:
    return lambda folder: np.savez_compressed(folder / "vectors.npz", mass=array)


in_files("no_manifest", "pack.toml' does not exist", lambda folder: (folder / "pack.toml").unlink())
in_files("no TOML", "not valid TOML", lambda folder: (folder / "pack.toml").write_text("format = \n"))
TOO_LONG = "has .* bytes, at most 16777216 are read"
in_files("manifest without end", TOO_LONG, lambda folder: os.truncate(folder / "pack.toml", 2**40))
in_files("symbolic link", "'A.npz' is a symbolic link", link)
in_files("named pipe", "is not a regular file", pipe)
in_files("pickled objects", r"holds Python objects \(a pickle\)", mass(np.array([Payload()], dtype=object)))
PICKLE = "a .npz that is a pickle|'A.npz' is damaged"
in_files("bare pickle", PICKLE, lambda folder: (folder / "A.npz").write_bytes(pickle.dumps(Payload())))
in_files("zip_bomb", "too big for memory: the arrays of the pack take", declare((2**22,), bytes(8 * 2**22)))
in_files("lying header", "is larger than its file", declare((2**50,), b"", zipfile.ZIP_STORED))
in_files("negative shape", "its shape -1 is negative", declare((-1,), bytes(2**25)))
in_files("negative shape of positive size", "its shape -3×-4 is negative", declare((-3, -4), bytes(96)))
in_files("small integers", "operators.f.affine.0: too big for memory", mass(np.ones(3 * 2**20, np.int8)))
PADDED = b"110000\n" + 110_000 * (b"1 1 1.0" + b" " * 120 + b"\n")
in_files("padded text", "operators.A: too big for memory", text(PADDED), "A.mtx.gz")
LONGER = "is longer than the 1 entries that it declares"
in_files("gzip bomb", LONGER, text(b"1\n1 1 1.0\n" + b" " * 10**6), "A.mtx.gz")
in_files("pattern", "the field 'pattern', it holds no values", lambda folder: scipy.io.mmwrite(
    folder / "A.mtx", sp.coo_array(Cable().A), field="pattern"), "A.mtx")  # fmt: skip


def moved(A: sp.csr_array) -> sp.csr_array:
    A.indices = A.indices + 5
    return A


TRIPLETS = {
    "row": lambda c: c.A.tocoo().coords[0] + 1, "col": lambda c: c.A.tocoo().coords[1] + 1, "data": lambda c: c.A.data,
    "shape": lambda c: np.array(c.A.shape),
}  # fmt: skip
FROM_ONE = "they count from 1, so the manifest needs index_base = 1"
changed("indices from one", FROM_ONE, {"operators.A": "more.npz"}, TRIPLETS)
in_arrays("indices beyond the matrix", "indices do not fit the shape 12×12", A=lambda c: moved(c.A))
in_arrays("not a number", "operators.f.affine.0: 1 of its entries are not finite",
          mass=lambda c: np.where(np.arange(SIZE) == 3, np.nan, c.mass))  # fmt: skip
NO_POINTS = "parameters.training: an array 0×2; expected P×2 with P > 0, a row per parameter$"
changed("no points", NO_POINTS, {"parameters.training": "more.npz:none"}, {"none": lambda c: np.empty((0, 2))})
# As of numbers that were stored in a type too small for them.
UNTOUCHED = "spaces.contact: 9 unknowns that B touches are not in it, the first is 1; leave it out, and they are found"
changed("contact without unknowns of constraints", UNTOUCHED, {"spaces.contact": "more.npz:few"},
        {"few": lambda c: np.array([0, 2, 2, 3], np.uint8)})  # fmt: skip


def edited(A: sp.csr_array, place: Any, to: Any) -> sp.csr_array:
    dense = A.toarray()
    dense[place] = to
    return sp.csr_array(dense)


def free(cable: Cable) -> sp.csr_array:
    """The stiffness without Dirichlet conditions."""
    return edited(cable.A, ([0, -1], [0, -1]), cable.A[0, 0] / 2.0)


FIRST = np.eye(SIZE)[0]
in_arrays("complex numbers", "operators.A: it holds complex numbers", A=lambda c: c.A * (1.0 + 0j))
in_arrays("one triangle", "has its upper triangle only; store both", A=lambda c: sp.csr_array(sp.triu(c.A)))
NOT_SYMMETRIC = "operators.A is not symmetric: entries differ by 1.0e-0?3$"
in_arrays("not symmetric", NOT_SYMMETRIC, A=lambda c: edited(c.A, (0, 5), 1e-3))
REPLACED = "rows of Dirichlet unknowns were replaced and their columns kept"
in_arrays("replaced Dirichlet row", REPLACED, A=lambda c: edited(c.A, 0, FIRST))
LEFT_IN = "couples 1 unknowns with no other, the first is 0.*rows of Dirichlet unknowns were left in"
in_arrays("Dirichlet rows left in", LEFT_IN, A=lambda c: edited(edited(c.A, 0, FIRST), (slice(None), 0), FIRST))
PENALTY = "diagonal entries of 1e.30 at 1 unknowns, the first is 0: a penalty for Dirichlet"
in_arrays("penalty left in", PENALTY, A=lambda c: edited(c.A, (0, 0), 1e30))
in_arrays("free", "constants are in its kernel: Dirichlet conditions were not applied", A=free)
in_arrays("negative stiffness", "the sign of A is the opposite one", A=lambda c: -c.A)
in_arrays("seminorm", "spaces.X_V .*; it is the product of a seminorm, without the L² part", X_V=free)
in_arrays("rectangular", "spaces.X_W: a matrix 12×11; expected a square one", X_W=lambda c: sp.csr_array(c.X_W[:, 1:]))
in_arrays("all unknowns", "operators.A: 14×14; expected 12×12; if it has the Dirichlet unknowns, too",
          A=lambda c: sp.csr_array(sp.block_diag([[[1.0]], c.A, [[1.0]]])))  # fmt: skip
in_arrays("transposed B", "operators.B: 12×5; expected 5×12; it is transposed",
          X_W=lambda c: sp.csr_array(c.X_W[:5, :5]), B=lambda c: sp.csr_array(c.B[:, :5]))  # fmt: skip
in_arrays("no constraint", "operators.B is zero: no constraint acts", B=lambda c: 0.0 * c.B)
in_arrays("other_multiplier", "probably λ has the other sign: with B u ≤ g", lam=lambda c: -c.lam)
in_arrays("other B", "probably B has the other sign", B=lambda c: -c.B)
in_arrays("other u", "probably u has the other sign", u=lambda c: -c.u)
in_arrays("energy without half", "probably the energy has no factor ½", A=lambda c: sp.csr_array(0.5 * c.A))
in_arrays("forces", "probably λ are nodal forces", lam=lambda c: c.X_W @ c.lam)
ORDER = "but that of parameter 2: the columns are in another order"
in_arrays("other order", ORDER, u=lambda c: c.u[:, ::-1], lam=lambda c: c.lam[:, ::-1])
in_arrays("inaccurate", "does not solve the problem: A u . Bᵀλ = f is violated by", lam=lambda c: 1.01 * c.lam)
TRANSPOSED = "solutions.u: an array 3×12; expected 12×3, a column per parameter; it is transposed"
in_arrays("transposed solutions", TRANSPOSED, u=lambda c: c.u.T)
MISSING = "solutions.lam has 2 columns for 5 parameters"
in_arrays("a solution is missing", MISSING, u=lambda c: c.u[:, :2], lam=lambda c: c.lam[:, :2])
in_arrays("no contact", "no constraint is active, there is nothing to reduce", lam=lambda c: 0.0 * c.lam)
OTHER_G = {"operators.g.affine.0.theta": "-depth"}
BELOW = "operators: at mu = .4.0, 0.2.: row 3 of B is zero and g is -0.0154 there: no u satisfies 0 ≤ -0.0154"
changed("zero row below its bound", BELOW, OTHER_G,
        B=lambda c: sp.csr_array(sp.diags_array(np.arange(SIZE) != 3, dtype=float) @ c.B))  # fmt: skip
VARIES = "operators.g: row 11 of term 0 is infinite, and its coefficient is no positive constant: give the infinite"
changed("infinite bound with a coefficient that varies", VARIES, {"operators.g.affine.0.array": "more.npz:g"},
        {"g": lambda c: np.append(c.mass[:-1], np.inf)})  # fmt: skip
OTHER_WAY = "probably the constraints are B u ≥ g: write B and g with the other sign"
changed("other constraint", OTHER_WAY, OTHER_G, B=lambda c: -c.B)
BOTH_WAYS = "probably the constraints are B u ≥ g and λ ≤ 0"
changed("other constraint and multiplier", BOTH_WAYS, OTHER_G, B=lambda c: -c.B, lam=lambda c: -c.lam)
DUAL_HALF = {"operators": ..., "solutions.u": ...}
ONE = np.arange(SIZE * 3).reshape(SIZE, 3) == 10
changed("both signs", "solutions.lam has both signs", DUAL_HALF, lam=lambda c: np.where(ONE, -c.lam, c.lam))
changed("negative snapshots", "solutions.lam is negative: λ has the other sign", DUAL_HALF, lam=lambda c: -c.lam)

ROWS = {"kind": "interval", "rows": "more.npz:rows", "radius": 1.0}
simple("disc", "K.0.kind: Input should be 'interval'", "K", [{"kind": "disc", "radius": 1.0}])
simple("no radius", "K.0.radius: required, but not given", "K", [{"kind": "interval"}])
for radius in (0.0, -1.0):
    simple(
        f"radius {radius}", "K.0: a radius is not positive and finite", "K", [{"kind": "interval", "radius": radius}]
    )
simple("radius not a number", "K.0.radius", "K", [{"kind": "interval", "radius": float("nan")}])
simple("radius elsewhere", "pack': K.0.rows: the file 'more.npz' does not exist", "K", [ROWS])
changed("as many radii as rows", "K.0.radius: 3; expected 2", {"K": [ROWS | {"radius": "more.npz:c"}]},
        {"rows": lambda c: np.array([0, 4]), "c": lambda c: np.ones(3)})  # fmt: skip
changed("infinite radius", "K.0.radius: 1 of its entries are not finite", {"K": [ROWS | {"radius": "more.npz:c"}]},
        {"rows": lambda c: np.array([0, 4]), "c": lambda c: np.array([1.0, np.inf])})  # fmt: skip
changed("row beyond the others", "K.0.rows", {"K": [ROWS]}, {"rows": lambda c: np.array([0, SIZE])})
changed("row in two intervals", "K: a row of the dual set is in two blocks", {"K": [ROWS, ROWS]},
        {"rows": lambda c: np.array([0, 4])})  # fmt: skip
changed("snapshots outside K", "solutions.lam leaves K by .*: in K are intervals",
        DUAL_HALF | {"K": [{"kind": "interval", "radius": 1e-3}]})  # fmt: skip
changed("solutions outside K", "does not solve the problem: A u . Bᵀλ = f is violated",
        {"K": [{"kind": "interval", "radius": 1e-3}]})  # fmt: skip


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Function that writes a pack with a mistake; 16 MiB of arrays are read at most."""
    monkeypatch.setattr(reader, "memory_limit", lambda: 2**24)

    def write(name: str) -> Path:
        folder, cable = tmp_path / "pack", Cable()
        folder.mkdir()
        AFTER.clear()
        content = MISTAKES[name][1](cable, folder)
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


def study_on(folder: Path, validation: int) -> Content:
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
    assert read_study(study, {"validation": [2]}).validation == 2
