"""Reading a model pack: its manifest, its arrays, and the digest of both."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError, RequestError, placed
from vibench.files import file_digest
from vibench.interfaces.absent_rows import without_infinities
from vibench.interfaces.affine import Expression, normal_names
from vibench.interfaces.dual_sets import BlockKind, Blocks, DualSet
from vibench.interfaces.outputs import Output
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import MEMBERS
from vibench.linalg.inner_product import InnerProduct
from vibench.packs import manifest as schema
from vibench.packs.array_files import ArrayFiles, memory_limit, safe_path, size_of, whole
from vibench.packs.manifest import FILE, Manifest, read_manifest, references
from vibench.packs.meshes import read_mesh
from vibench.packs.pack import Listing, ModelPack, PackMember, PackMesh, PackSolutions, TabulatedTheta
from vibench.signatures import bordered


@bordered
def pack_digest(path: str | Path) -> str:
    """Digest of the manifest and of the files it names; a `RequestError` if that is invalid, or a file is missing.

    Parameters
    ----------
    path
        Folder of the pack.
    """
    content = hashlib.sha256()
    with naming(path) as folder:
        manifest = read_manifest(folder)
        for place, reference in (("manifest", FILE), *references(manifest)):
            for file in _files(folder, place, reference.partition(":")[0], manifest.index_base):
                content.update(file_digest(file))
    return content.hexdigest()[:16]


def _files(folder: Path, place: str, name: str, first: int) -> list[Path]:
    """The files of a name; for `each`, those that a {} in it numbers from the first one, as far as there are any."""
    numbered = "{}" in name and place.endswith(".each")
    with placed(place):
        files = [safe_path(folder, name.replace("{}", str(first)) if numbered else name)]
        while numbered and os.path.lexists(folder / (each := name.replace("{}", str(first + len(files))))):
            files.append(safe_path(folder, each))
    return files


@contextlib.contextmanager
def naming(path: str | Path) -> Iterator[Path]:
    """The folder of a pack; errors raised in the block name it. A `RequestError` if it is no folder."""
    if not os.path.isdir(path):  # noqa: PTH112  methods of Path raise OSError for names too long for a file
        raise RequestError(f"pack '{path}': there is no such folder")
    with placed(f"pack '{path}'"):
        yield Path(path)


class PackReader:
    """Reads the arrays of a manifest; every array is checked against the dimensions known so far."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self._folder, self._manifest = folder, manifest
        self._files = ArrayFiles(folder, manifest.index_base, memory_limit())
        self._names = normal_names(manifest.parameters.names)
        self._box: ParameterBox | None = None  # where its bounds are given
        self._free: Indices | None = None

    def pack(self) -> ModelPack:
        """The pack; a `RequestError` names what is wrong with an array, and what would be right."""
        given, spaces, operators = self._manifest.parameters, self._manifest.spaces, self._manifest.operators
        solutions, mesh = self._manifest.solutions, self._manifest.mesh
        if operators is None and (solutions is None or spaces.free or mesh):
            raise RequestError("without the table [operators] a pack consists of [spaces] X_W and [solutions] lam")
        # The dual half of a pack needs X_W alone.
        if operators is not None and spaces.X_V is None:
            raise RequestError("spaces.X_V: required with [operators], but not given; A at one parameter is a choice")
        training, validation, box = self._domain(given)
        W = self._inner_product(self._files.sparse(spaces.X_W, "spaces.X_W"), "X_W")
        V = None if operators is None or spaces.X_V is None else self._primal_space(spaces.X_V)
        n, m = 0 if V is None else V.dim, W.dim
        members = {} if operators is None else self._members(operators, n, m)
        blocks = tuple(self._block(block, f"K.{k}", m) for k, block in enumerate(self._manifest.K))
        with placed("K"):
            K = DualSet(blocks)
        if not all(member.everywhere for member in members.values()):
            if validation is None:
                why = "since arrays or tables are given at listed parameters only: list the last of these there"
                raise RequestError(f"parameters.validation: required, {why}")
            _refuse_repeated(self._listing, "parameters.training and parameters.validation together")
            box = replace(box, listed=self._listed)
        outputs = self._manifest.outputs
        if outputs and not n:
            raise RequestError("outputs need the table [operators]")
        return ModelPack(
            self._manifest, box, training, validation, V, W, members, self._contact(members, n),
            None if spaces.integrals is None else self._vector(spaces.integrals, "spaces.integrals", m),
            None if solutions is None else self._reference(solutions, n, m),
            None if mesh is None else self._mesh(mesh, n, m),
            tuple(Output(
                one.name, one.unit,
                None if one.u is None else self._kept(self._vector(one.u, f"outputs.{k}.u", self._all)),
                None if one.lam is None else self._vector(one.lam, f"outputs.{k}.lam", m),
            ) for k, one in enumerate(outputs)),
            K=K,
        )  # fmt: skip

    def _domain(self, given: schema.Parameters) -> tuple[Array, Array | None, ParameterBox]:
        units = tuple(given.units or ["1"] * len(self._names))
        if given.lower is not None:
            self._box = ParameterBox(self._names, np.array(given.lower), np.array(given.upper), units)
        roles = [("training", given.training), ("validation", given.validation)]
        sets = {role: self._parameters(points, f"parameters.{role}") for role, points in roles if points is not None}
        self._listed, self._training = np.vstack([*sets.values()]), len(sets["training"])
        box = self._box or ParameterBox(self._names, self._listed.min(axis=0), self._listed.max(axis=0), units)
        self._listing = Listing(self._listed, box.widths)
        for role, mus in sets.items():
            _refuse_repeated(Listing(mus, box.widths), f"parameters.{role}")
        return sets["training"], sets.get("validation"), box

    def _parameters(self, given: schema.PointSet, what: str) -> Array:
        box, d = self._box, len(self._names)
        if given.grid is not None and box is not None:
            if len(given.grid) != d:
                raise RequestError(f"{what}.grid has {len(given.grid)} counts for {d} parameters")
            self._files.take(8 * (2 * d + 1) * math.prod(given.grid) + 8 * sum(given.grid))
            return box.grid(*given.grid)
        if given.array is not None:
            mus = self._files.dense(given.array, what)
            mus = mus[:, None] if mus.ndim == 1 and d == 1 else mus
        elif any(len(point) != d for point in given.points or ()):
            raise RequestError(f"{what}: every point needs {d} values, one for each of {', '.join(self._names)}")
        else:
            mus = np.array(given.points, dtype=float)
        if mus.ndim != 2 or mus.shape[1] != d or not len(mus):
            transposed = "; it is transposed" if mus.ndim == 2 and mus.shape[0] == d != mus.shape[1] else ""
            expected = f"P×{d} with P > 0, a row per parameter"
            raise RequestError(f"{what}: an array {size_of(mus.shape)}; expected {expected}{transposed}")
        if box is not None:
            for k, i in np.argwhere(box.outside(mus))[:1]:
                sides, name = f"[{box.lower[i]:g}, {box.upper[i]:g}]", self._names[i]
                raise RequestError(f"{what}: point {k} has '{name}' = {mus[k, i]:g}, outside the box {sides}")
        return mus

    def _primal_space(self, reference: str) -> InnerProduct:
        X = self._files.sparse(reference, "spaces.X_V")
        self._all = int(X.shape[0])
        if self._manifest.spaces.free is not None:
            self._free = self._files.indices(self._manifest.spaces.free, "spaces.free", self._all)
            if len(np.unique(self._free)) < len(self._free):
                raise RequestError("spaces.free names an unknown twice")
            X = sp.csr_array(X)[self._free][:, self._free] if X.shape[0] == X.shape[1] else X
        return self._inner_product(X, "X_V")

    @staticmethod
    def _inner_product(X: Any, name: str) -> InnerProduct:
        rows, columns = X.shape
        if rows != columns:
            raise RequestError(f"spaces.{name}: a matrix {rows}×{columns}; expected a square one")
        one_triangle(X, f"spaces.{name}")
        try:
            return InnerProduct(X, f"spaces.{name}")
        except NumericalError as error:
            # Constants are in the kernel of a seminorm.
            constants = np.abs(X @ np.ones(rows)).max(initial=0.0) <= 1e-10 * np.abs(X.data).max(initial=0.0)
            hint = "; it is the product of a seminorm, without the L² part" if constants and X.nnz else ""
            raise RequestError(f"{error}{hint}") from None

    def _members(self, operators: schema.Operators, n: int, m: int) -> dict[str, PackMember]:
        shapes: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
            "A": ((self._all, self._all), (n, n)), "f": ((self._all,), (n,)), "B": ((m, self._all), (m, n)),
            "g": ((m,), (m,)),
        }  # fmt: skip
        return {name: self._member(name, getattr(operators, name), *shapes[name]) for name in MEMBERS}

    def _member(self, name: str, given: schema.Member, stored: tuple[int, ...], kept: tuple[int, ...]) -> PackMember:
        what = f"operators.{name}"

        def read(reference: str, where: str) -> Any:
            vector = partial(self._files.vector, infinite=name == "g")
            array = without_infinities((self._files.sparse if len(stored) == 2 else vector)(reference, where))
            self._expect(where, array, stored)
            return array if stored == kept else self._restricted(name, array)

        if given.constant is not None:
            return PackMember((read(given.constant, what),))
        if given.affine is not None:
            terms = tuple(read(term.array, f"{what}.affine.{q}") for q, term in enumerate(given.affine))
            thetas = tuple(self._theta(term, f"{what}.affine.{q}") for q, term in enumerate(given.affine))
            return PackMember(terms, thetas)
        assert given.each is not None  # the manifest has exactly one of the three
        if "{}" in given.each:
            base = self._manifest.index_base
            references = [given.each.replace("{}", str(k + base)) for k in range(len(self._listed))]
            values = [read(reference, f"{what}, parameter {k}") for k, reference in enumerate(references)]
        elif len(stored) == 2:
            raise RequestError(f"{what}.each: '{given.each}' has no {{}} that stands for the number of the parameter")
        else:
            columns = self._columns(given.each, f"{what}.each", stored[0], len(self._listed), infinite=name == "g")
            values = [column if stored == kept else self._restricted(name, column) for column in columns.T]
        return PackMember(tuple(values), listing=self._listing)

    def _restricted(self, name: str, member: Any) -> Any:
        if name == "B":
            return sp.csr_array(member)[:, self._free]
        return member[self._free] if name == "f" else sp.csr_array(member)[self._free][:, self._free]

    def _theta(self, term: schema.Term, what: str) -> Expression | TabulatedTheta:
        if term.table is None:
            with placed(f"{what}.theta"):
                return Expression.parse(str(term.theta), self._names)
        return TabulatedTheta(self._listing, self._vector(term.table, f"{what}.table", len(self._listed)))

    def _columns(self, reference: str, what: str, rows: int, count: int | None, infinite: bool = False) -> Array:
        columns = np.asarray(without_infinities(self._files.dense(reference, what, infinite)))
        if columns.ndim != 2 or columns.shape[0] != rows or count not in (None, columns.shape[1]):
            transposed = "; it is transposed" if columns.ndim == 2 and columns.shape[1] == rows else ""
            expected = f"{rows}×{'P' if count is None else count}, a column per parameter"
            raise RequestError(f"{what}: an array {size_of(columns.shape)}; expected {expected}{transposed}")
        return columns

    def _block(self, given: schema.Block, what: str, m: int) -> Blocks:
        rows = np.arange(m) if given.rows is None else self._files.indices(given.rows, f"{what}.rows", m)
        radii = np.full(len(rows), given.radius) if isinstance(given.radius, float) else None
        if isinstance(given.radius, str):
            radii = self._vector(given.radius, f"{what}.radius", len(rows))
        with placed(what):
            return Blocks(BlockKind(given.kind), rows[:, None], radii)

    def _contact(self, members: Mapping[str, PackMember], n: int) -> Indices:
        touched = np.zeros(n, dtype=bool)
        for matrix in members["B"].arrays if members else ():
            touched[sp.csr_array(matrix).indices] = True
        if self._manifest.spaces.contact is None or not members:
            return np.flatnonzero(touched)
        named = self._files.indices(self._manifest.spaces.contact, "spaces.contact", self._all)
        numbers = np.arange(n) if self._free is None else self._free
        contact = np.isin(numbers, named)
        missing = numbers[touched & ~contact] + self._manifest.index_base
        if len(missing):
            untold = f"{len(missing)} unknowns that B touches are not in it, the first is {missing[0]}"
            raise RequestError(f"spaces.contact: {untold}; leave it out, and they are found")
        return np.flatnonzero(contact)

    def _reference(self, given: schema.Solutions, n: int, m: int) -> PackSolutions:
        lam = self._columns(given.lam, "solutions.lam", m, None)
        count = lam.shape[1]
        mus = self._listed[: self._training] if count == self._training else self._listed
        if given.parameters is not None:
            mus = self._parameters(given.parameters, "solutions.parameters")
        if len(mus) != count:
            raise RequestError(f"solutions.lam has {count} columns for {len(mus)} parameters")
        has_u = given.u is not None and n > 0
        u = self._kept(self._columns(str(given.u), "solutions.u", self._all, count)) if has_u else None
        return PackSolutions(mus, u, lam, given.tolerance)

    def _mesh(self, given: schema.Mesh, n: int, m: int) -> PackMesh:
        with placed("mesh.file"):
            points, triangles = read_mesh(safe_path(self._folder, given.file), self._files.left, 60)
        points = points.T
        self._files.take(2 * (points.nbytes + triangles.nbytes))  # as they are read, and as they are kept
        corners = whole(triangles, f"mesh.file: the triangles of '{given.file}'", 0, points.shape[1] - 1)
        drawn = self._files.indices(given.points, "mesh.points", points.shape[1])
        unknowns = np.arange(n)
        if given.unknowns is not None:
            unknowns = self._files.indices(given.unknowns, "mesh.unknowns", self._all)
            if self._free is not None:
                # The files number all unknowns, the pack the free ones.
                number = np.full(self._all, -1)
                number[self._free] = np.arange(len(self._free))
                unknowns = number[unknowns]
                if np.any(unknowns < 0):
                    raise RequestError("mesh.unknowns names an unknown that is not free")
        self._expect("mesh.points", drawn, (len(unknowns),))
        positions = self._files.dense(given.positions, "mesh.positions")
        positions = positions[:, None] if positions.ndim == 1 else positions
        if positions.shape not in ((m, 1), (m, 2)):
            raise RequestError(f"mesh.positions: an array {size_of(positions.shape)}; expected {m}×1 or {m}×2")
        return PackMesh(points, corners.reshape(-1, 3).T, drawn, unknowns, positions.T, given.value, given.multiplier)

    def _kept(self, values: Array) -> Array:
        """Values (N, …) of all unknowns of the files at the free ones (n, …)."""
        return values if self._free is None else values[self._free]

    def _vector(self, reference: str, what: str, length: int) -> Array:
        values = self._files.vector(reference, what)
        self._expect(what, values, (length,))
        return values

    def _expect(self, what: str, array: Any, shape: tuple[int, ...]) -> None:
        if array.shape == shape:
            return
        hint = "; it is transposed" if len(shape) == 2 and array.shape == shape[::-1] else ""
        if not hint and self._free is None and self._manifest.operators is not None and max(array.shape) > max(shape):
            hint = "; if it has the Dirichlet unknowns, too, leave them out, or name the free ones in spaces.free"
        raise RequestError(f"{what}: {size_of(array.shape)}; expected {size_of(shape)}{hint}")


def _refuse_repeated(listing: Listing, what: str) -> None:
    """Refuse a parameter that is listed twice: of its arrays one would be used, whatever is in the other."""
    if repeated := listing.repeated():
        i, j = sorted(repeated)
        raise RequestError(f"{what}: the points {i} and {j} are the same, {listing.parameters[i].tolist()}")


def one_triangle(matrix: Any, what: str) -> None:
    """Refuse a matrix of which one triangle is stored and the other is empty."""
    below, above = sp.tril(matrix, -1).nnz, sp.triu(matrix, 1).nnz
    if bool(below) != bool(above):
        advice = "store both, or in Matrix Market the lower one as 'symmetric'"
        raise RequestError(f"{what} has its {'lower' if below else 'upper'} triangle only; {advice}")
