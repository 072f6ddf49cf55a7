"""Arrays in files of others, read as data: .npz, .npy, Matrix Market and HDF5, inside one folder and within memory."""

from __future__ import annotations

import codecs
import contextlib
import gzip
import io
import math
import resource
import stat
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import IO, Any

import numpy as np
import scipy.io
import scipy.sparse as sp

from vibench.arrays import Array, Indices, SparseMatrix
from vibench.errors import RequestError, foreign, placed, unknown_name
from vibench.provenance import memory


def safe_path(folder: Path, name: str) -> Path:
    """Path of a file in a folder; a `RequestError` if the name leads elsewhere, or it is a link or no regular file."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or "\0" in name:
        raise RequestError(f"'{name}' is not the name of a file inside the pack's folder")
    path = folder
    mode = folder.stat().st_mode
    try:
        for part in parts:
            path /= part
            # Of every folder on the way, too: a link among them would lead elsewhere.
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                raise RequestError(f"'{name}' is a symbolic link; a pack holds its files itself")
    except OSError as error:
        where = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"
        raise RequestError(f"the file '{name}' {where}") from None
    if not stat.S_ISREG(mode):
        raise RequestError(f"'{name}' is not a regular file")
    return path


def memory_limit() -> int:
    """Bytes that the arrays of a pack may take: half of the memory of the machine, or of the limit of the process."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return (memory() if limit == resource.RLIM_INFINITY else min(memory(), limit)) // 2


class ArrayFiles:
    """The arrays in the files of a folder. "FILE" refers to the only array of a file, "FILE:NAME" to one of several.

    A sparse matrix is a Matrix Market file, or several arrays: those of `scipy.sparse.save_npz`, or a group NAME of
    `data`, `indices`, `indptr`, `shape` and `format` ("csr" or "csc"), or of `row`, `col`, `data` and `shape`. The
    sizes that files declare are added up before anything is read, and may be `limit` bytes. `index_base`, 0 or 1, is
    the first index of index arrays, of `row` and of `col`.
    """

    def __init__(self, folder: Path, index_base: int, limit: int) -> None:
        self._folder, self._base, self._limit = folder, index_base, limit
        self.left = limit  # bytes that arrays may still take

    def dense(self, reference: str, what: str, infinite: bool = False) -> Array:
        """A dense array; a sparse matrix of one column or row is a vector. It may have +inf where that is allowed."""
        with self._reading(reference, what):
            stored = self._read(reference)
            if isinstance(stored, Mapping) or sp.issparse(stored):
                matrix = self._matrix(stored)
                if 1 not in matrix.shape:
                    raise RequestError(f"a sparse matrix {size_of(matrix.shape)}; expected a dense array")
                # A sparse vector may declare any length, whatever the size of its file.
                self.take(8 * max(matrix.shape))
                stored = matrix.toarray()
            return self._real(stored, infinite)

    def vector(self, reference: str, what: str, infinite: bool = False) -> Array:
        """A vector (k,); one row or column counts as one."""
        array = self.dense(reference, what, infinite)
        if array.ndim == 2 and 1 in array.shape:
            return array.ravel()
        if array.ndim != 1:
            raise RequestError(f"{what}: an array {size_of(array.shape)}; expected a vector")
        return array

    def sparse(self, reference: str, what: str) -> SparseMatrix:
        """A sparse matrix in the format of its rows or columns, its entries in the order of the file."""
        with self._reading(reference, what):
            stored = self._read(reference)
            if not isinstance(stored, Mapping) and not sp.issparse(stored):
                if stored.ndim != 2:
                    raise RequestError(f"an array {size_of(stored.shape)}; expected a matrix")
                stored = sp.csr_array(self._real(stored))
            matrix = self._matrix(stored)
            matrix.data = self._real(matrix.data)
            return matrix

    def indices(self, reference: str, what: str, count: int) -> Indices:
        """Indices (k,) below `count`, from 0 whatever the index base of the pack."""
        values = self.vector(reference, what)
        with self._reading(reference, what):
            return self._based(values, count)

    @contextlib.contextmanager
    def _reading(self, reference: str, what: str) -> Iterator[None]:
        # NumPy, SciPy, zipfile and h5py raise anything for damaged files.
        with foreign(f"{what}: '{reference}' is damaged", RequestError), placed(what):
            yield

    def _read(self, reference: str) -> Any:
        """A dense array, or the arrays of a sparse matrix by name, or a matrix."""
        name, _, inner = reference.partition(":")
        formats = (".npz", ".npy", ".mtx", ".mtx.gz", ".h5", ".hdf5")
        suffix = next((ending for ending in formats if name.endswith(ending)), "")
        if not suffix:
            raise RequestError(f"'{name}' has a format that is not read; expected one of {', '.join(formats)}")
        path = safe_path(self._folder, name)
        match suffix:
            case ".npz":
                return self._npz(path, inner)
            case ".npy":
                with path.open("rb") as file:
                    return self._array(file, path.stat().st_size)
            case ".mtx" | ".mtx.gz":
                return self._matrix_market(path)
        return self._hdf5(path, inner)

    def _npz(self, path: Path, inner: str) -> Any:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            prefix = f"{inner}/" if inner else ""
            parts = [inner] if inner in members else [name for name in members if name.startswith(prefix)]
            if inner and not parts:
                raise unknown_name(f"array in '{path.name}'", inner, sorted(members)[:20])
            # A file of `scipy.sparse.save_npz` is one matrix of several arrays.
            if not inner and len(members) > 1 and "data" not in members:
                raise RequestError(f"'{path.name}' has several arrays: name one, as in '{path.name}:{parts[0]}'")

            def read(name: str) -> Any:
                with archive.open(members[name]) as file:
                    return self._array(file, members[name].file_size)

            arrays = {name.removeprefix(prefix): read(name) for name in parts}
        return next(iter(arrays.values())) if len(parts) == 1 else arrays

    def _array(self, file: IO[bytes], size: int) -> Array:
        """A .npy file of so many bytes; sizes are checked before it is read, and Python objects are refused."""
        # The header is read by hand: `np.load` would allocate what it declares.
        first = np.lib.format.read_magic(file) == (1, 0)
        read_header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read_header(file)
        if dtype.hasobject or dtype.kind not in "biufcS":
            objects = "Python objects (a pickle), which are not loaded"
            raise RequestError(
                f"it holds {objects if dtype.hasobject else f'values of type {dtype}'}; expected numbers"
            )
        if min(shape, default=0) < 0:
            raise RequestError(f"its shape {size_of(shape)} is negative: it is damaged")
        count = math.prod(map(int, shape))
        if count * dtype.itemsize > size:
            raise RequestError(f"the array {size_of(shape)} is larger than its file: it is damaged or cut off")
        self.take(_bytes(count, dtype))
        # A bytearray, since SciPy sorts in place.
        flat = np.frombuffer(bytearray(file.read(count * dtype.itemsize)), dtype, count)
        return flat.reshape(shape, order="F" if fortran else "C")

    def _matrix_market(self, path: Path) -> Any:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            comments = 2**16
            head = file.read(comments).removeprefix(codecs.BOM_UTF8)
            rows, columns, entries, layout, field, symmetry = scipy.io.mminfo(io.BytesIO(head))
            if field == "pattern":
                raise RequestError("the Matrix Market file has the field 'pattern', it holds no values")
            if field == "complex":
                raise RequestError("it holds complex numbers; expected real ones")
            if min(rows, columns, entries) < 0:
                raise RequestError(f"the Matrix Market file declares {entries} entries of {rows}×{columns}")
            # Indices and values as triplets and as rows, and the pointers; what is read as text is given back.
            self.take((40 + 40 * (symmetry != "general")) * entries + 8 * min(rows, columns) + 16 * max(rows, columns))
            # An entry takes at most 128 bytes: a longer file holds more entries than it declares.
            text = head + file.read(min(entries * 128, self.left) + 1)
            if len(text) > entries * 128 + comments:
                raise RequestError(f"the Matrix Market file is longer than the {entries} entries that it declares")
        self.take(len(text))
        matrix = scipy.io.mmread(io.BytesIO(text))
        # The text is released, the matrix stays.
        self.left += len(text)
        return np.asarray(matrix) if layout == "array" else _checked(sp.csr_array(matrix))

    def _hdf5(self, path: Path, inner: str) -> Any:
        with foreign("HDF5 files need h5py (pip install 'vibench[hdf5]')", RequestError):
            import h5py  # noqa: PLC0415  optional
        with h5py.File(path, "r") as file:
            node: Any = file
            for part in [part for part in inner.split("/") if part]:
                link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
                if link is None:
                    raise RequestError(f"'{path.name}' has no dataset '{inner}'")
                # Soft and external links may lead out of the file.
                if not isinstance(link, h5py.HardLink):
                    raise RequestError(f"'{inner}' in '{path.name}' is a link; a pack holds its arrays itself")
                node = node[part]
            if isinstance(node, h5py.Dataset):
                return self._dataset(node)
            if any(not isinstance(node.get(name, getlink=True), h5py.HardLink) for name in node):
                raise RequestError(f"'{inner}' in '{path.name}' contains a link; a pack holds its arrays itself")
            datasets = {name: each for name, each in node.items() if isinstance(each, h5py.Dataset)}
            if "data" not in datasets:
                raise RequestError(f"'{path.name}:{inner}' is a group; name a dataset or a group with 'data'")
            return {name: self._dataset(each) for name, each in datasets.items()}

    def _dataset(self, dataset: Any) -> Array:
        if dataset.is_virtual or dataset.external:
            raise RequestError("the dataset refers to other files; a pack holds its arrays itself")
        if dataset.dtype.kind not in "biufcS" or dataset.shape is None:
            raise RequestError(f"it holds values of type {dataset.dtype}; expected numbers")
        self.take(_bytes(dataset.size, dataset.dtype))
        return np.asarray(dataset[()])

    def _matrix(self, stored: Any) -> SparseMatrix:
        if sp.issparse(stored):
            return stored
        compressed = stored.keys() >= {"indices", "indptr"}
        if not (stored.keys() >= {"data", "shape"} and (compressed or stored.keys() >= {"row", "col"})):
            right = "a sparse matrix has data and shape, and either row and col, or indices and indptr"
            raise RequestError(f"it has the arrays {', '.join(sorted(stored)) or 'none'}; {right}")
        rows, columns = whole(stored["shape"], "shape", 0, np.iinfo(np.int64).max, 2).tolist()
        self.take(8 * (rows + columns))
        data = self._real(np.ravel(stored["data"]))
        if not compressed:
            i, j = np.ravel(stored["row"]), np.ravel(stored["col"])
            if not len(i) == len(j) == len(data):
                raise RequestError(f"row, col and data have {len(i)}, {len(j)} and {len(data)} entries")
            self.take(16 * len(data))
            places = (self._based(i, rows), self._based(j, columns))
            return _checked(sp.csr_array(sp.coo_array((data, places), shape=(rows, columns))))
        written = np.ravel(stored.get("format", b"csr")).tolist()
        if written not in ([b"csr"], [b"csc"]):
            raise RequestError(f"its format is {written}; expected 'csr' or 'csc'")
        kind, long, short = (sp.csc_array, columns, rows) if written == [b"csc"] else (sp.csr_array, rows, columns)
        pointers = whole(stored["indptr"], "indptr", 0, len(data), long + 1)
        fits = f"the shape {size_of((rows, columns))} and the {len(data)} values"
        if pointers[0] != 0 or np.any(np.diff(pointers) < 0):
            raise RequestError(f"indptr does not fit {fits}")
        # SciPy may have allocated more entries than it uses.
        used = int(pointers[-1])
        indices = np.ravel(stored["indices"])[:used]
        with placed(f"indices do not fit {fits}"):
            indices = whole(indices, "indices", 0, short - 1, used)
        return _checked(kind((data[:used], indices, pointers), shape=(rows, columns)))

    def _based(self, values: Any, count: int) -> Indices:
        # Any integer of 63 bits, so that the message below may name the base.
        values, low, high = whole(values, "it", -(2**62), 2**62), self._base, self._base + count - 1
        if len(values) and (values.min() < low or values.max() > high):
            fault = f"it has indices from {values.min()} to {values.max()}; expected {low} to {high}"
            # Indices that fit the other base were probably written with it.
            other = 1 - self._base
            if other <= values.min() and values.max() <= other + count - 1:
                fault += f": they count from {other}, so the manifest needs index_base = {other}"
            raise RequestError(fault)
        return np.asarray(values - self._base, dtype=np.intp)

    def _real(self, values: Array, infinite: bool = False) -> Array:
        if values.dtype.kind == "c":
            raise RequestError("it holds complex numbers; expected real ones")
        if values.dtype.kind == "S":
            raise RequestError("it holds text; expected numbers")
        wrong = np.count_nonzero(~(np.isfinite(values) | (infinite & (values == np.inf))))
        if wrong:
            allowed = "nan or -inf; inf means a row that constrains nothing" if infinite else "nan or inf"
            raise RequestError(f"{wrong} of its entries are not finite ({allowed})")
        return np.asarray(values, dtype=float)

    def take(self, count: int) -> None:
        """Count bytes that are about to be taken; a `RequestError` if they are more than are left."""
        self.left -= count
        if self.left < 0:
            needed, limit = (f"{size / 2**30:.3g} GiB" for size in (self._limit - self.left, self._limit))
            raise RequestError(f"too big for memory: the arrays of the pack take {needed}, {limit} are allowed")


def whole(values: Any, what: str, low: int, high: int, count: int | None = None) -> Indices:
    """Integers of any type as int64; compiled code checks neither types nor ranges of indices."""
    values = np.ravel(values)
    if values.dtype.kind not in "iuf" or np.any(values != np.round(values)):
        raise RequestError(f"{what} has values that are no whole numbers; expected indices")
    if count is not None and len(values) != count:
        raise RequestError(f"{what} has {len(values)} entries; expected {count}")
    least, most = (int(values.min()), int(values.max())) if len(values) else (low, low)
    if len(values) and not low <= least <= most <= high:
        raise RequestError(f"{what} has values from {least} to {most}; expected {low} to {high}")
    return np.asarray(values, dtype=np.int64)


def _bytes(count: int, dtype: np.dtype[Any]) -> int:
    """Bytes of an array as it is stored, and as the doubles or 64-bit integers that it becomes."""
    return int(count * (dtype.itemsize + 8 * (dtype != np.float64)))


def _checked(matrix: SparseMatrix) -> SparseMatrix:
    """A matrix whose indices SciPy has checked one by one; what is wrong raises a ValueError."""
    # Products in compiled code would read beyond arrays.
    matrix.check_format(full_check=True)
    return matrix


def size_of(shape: Any) -> str:
    """A shape in words, "3×4"."""
    return "×".join(map(str, shape)) or "of no dimension"
