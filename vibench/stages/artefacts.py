"""Artefacts: results of stages, each a file under the hash of its inputs, shared by all runs.

Values are arrays and JSON in the safetensors format, from which nothing but data can be read.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import platformdirs
import safetensors
import safetensors.numpy
import scipy.sparse as sp
from cachetools import LRUCache

from vibench.arrays import SparseMatrix, frozen
from vibench.errors import NumericalError, RequestError, StorageError, VibenchError
from vibench.files import TEMPORARY, locked, write_atomically
from vibench.provenance import machine
from vibench.text import one_line
from vibench.timing import Seconds

SPARSE = {
    "csr": ("data", "indices", "indptr"), "csc": ("data", "indices", "indptr"), "bsr": ("data", "indices", "indptr"),
    "coo": ("row", "col", "data"), "dia": ("data", "offsets"),
}  # fmt: skip
"""The arrays of a sparse matrix, by its format; matrices of other formats are stored as `coo`."""

_classes: dict[str, type] = {}

ClassT = TypeVar("ClassT", bound=type)


class DamagedArtefactError(VibenchError):
    """Bytes that `dumps` did not write."""


def storable(kind: ClassT, *others: type) -> ClassT:
    """Add classes to the closed list of those whose objects may be stored; may be used as a decorator of one."""
    # A dataclass is stored by its fields, an enumeration by the name of the member, any other class by the value of
    # `__getstate__` without cached properties. A module that defines a stage lists the classes of its value.
    # Files name classes without their modules.
    kinds: tuple[type, ...] = (kind, *others)
    for one in kinds:
        if _classes.setdefault(one.__name__, one) is not one:
            raise TypeError(f"two storable classes are called {one.__name__}")
    return kind


def dumps(value: Any) -> bytes:
    """A value as bytes: `None`, booleans, numbers, texts, tuples, lists, dictionaries, arrays, `storable` objects."""
    writer = _Writer()
    text = json.dumps(writer.described(value), allow_nan=False, separators=(",", ":"))
    # One tensor holds the JSON text; the others are the arrays it refers to, by their numbers.
    return safetensors.numpy.save(writer.arrays | {"structure": np.frombuffer(text.encode("ascii"), np.uint8)})


def loads(content: bytes) -> Any:
    """The value that `dumps` wrote, dense arrays read-only; a `DamagedArtefactError` for any other content."""
    try:
        arrays = safetensors.numpy.load(content)
        text = arrays.pop("structure").tobytes().decode("ascii")
        return _Reader(arrays).value(json.loads(text, object_pairs_hook=_no_duplicates, parse_constant=_refuse))
    # Factorisations are computed again, which may fail with a `VibenchError`.
    except (
        safetensors.SafetensorError, LookupError, TypeError, ValueError, AttributeError, RecursionError, MemoryError,
        VibenchError,
    ) as error:  # fmt: skip
        raise DamagedArtefactError(one_line(str(error))) from None


class _Writer:
    """Describes a value in JSON; arrays are stored apart, and what occurs twice, if only as a copy, is stored once."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray[Any, Any]] = {}
        # Numbers of arrays by their identity, or by type, shape and digest of their content.
        self._numbers: dict[object, str] = {}
        # Keep described objects alive: identities of collected ones are reused.
        self._alive: list[Any] = []

    def described(self, value: Any) -> Any:
        """JSON of a value: itself, or an object with the kind of the value as its only key."""
        if value is None or type(value) in (bool, int, str):
            return value
        if type(value) is float:
            # JSON knows no infinity and no NaN.
            return value if math.isfinite(value) else {"float": repr(value)}
        if sp.issparse(value):
            return self._sparse(value)
        if isinstance(value, Mapping):
            return {"dict": [[self.described(key), self.described(part)] for key, part in value.items()]}
        if type(value) in (tuple, list):
            return {type(value).__name__: [self.described(part) for part in value]}
        return self._array(value) if type(value) is np.ndarray or isinstance(value, np.generic) else self._object(value)

    def _array(self, value: Any, *, alone: bool = False) -> Any:
        """An array, or a number of NumPy; one that is `alone` shares its memory with no copy when it is read."""
        # Booleans, signed and unsigned integers and floats of at most 8 bytes: safetensors has no other type.
        if value.dtype.kind not in "biuf" or value.dtype.itemsize > 8:
            raise NumericalError(f"an array of the type {value.dtype} cannot be stored")
        columnwise = value.flags.f_contiguous and not value.flags.c_contiguous
        kind = "scalar" if isinstance(value, np.generic) else "columnwise" if columnwise else "array"
        if id(value) not in self._numbers:
            stored = value.T if columnwise else np.asarray(value, order="C")
            digest = b"" if alone else hashlib.sha256(stored.data).digest()
            content = (value.dtype.str, stored.shape, digest) if digest else id(value)
            number = self._numbers.setdefault(content, str(len(self.arrays)))
            self._numbers[id(value)] = number
            self._alive.append(value)
            self.arrays.setdefault(number, stored)
        return {kind: self._numbers[id(value)]}

    def _sparse(self, value: SparseMatrix) -> Any:
        kind = value.format if value.format in SPARSE else "coo"
        stored = value.asformat(kind)
        self._alive.append(stored)
        # SciPy sorts the arrays of a matrix in place.
        parts = [self._array(np.asarray(getattr(stored, name)), alone=True) for name in SPARSE[kind]]
        return {"sparse": [value.format, kind, isinstance(value, sp.sparray), list(value.shape), parts]}

    def _object(self, value: Any) -> Any:
        kind, name = type(value), type(value).__name__
        if _classes.get(name) is not kind:
            raise NumericalError(f"a value of the type {kind.__module__}.{kind.__qualname__} cannot be stored")
        if isinstance(value, Enum):
            return {"member": [name, value.name]}
        if is_dataclass(value):
            state = {field.name: getattr(value, field.name) for field in fields(value)}
        else:
            cached = {key for key in value.__getstate__() if isinstance(getattr(kind, key, None), cached_property)}
            state = {key: part for key, part in value.__getstate__().items() if key not in cached}
        return {"object": [name, {key: self.described(part) for key, part in state.items()}]}


class _Reader:
    """Makes a value from its description and its arrays."""

    def __init__(self, arrays: dict[str, np.ndarray[Any, Any]]) -> None:
        self._arrays, self._views = arrays, dict[str, np.ndarray[Any, Any]]()
        self._kinds: dict[str, Callable[[Any], Any]] = {
            "float": lambda text: {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}[text],
            "tuple": lambda parts: tuple(map(self.value, parts)), "list": lambda parts: list(map(self.value, parts)),
            "dict": lambda parts: {self.value(key): self.value(part) for key, part in parts}, "array": self._read_only,
            "columnwise": lambda number: self._read_only(number).T, "scalar": lambda number: self._arrays[number][()],
            "sparse": lambda parts: self._sparse(*parts), "member": lambda parts: _class(parts[0], Enum)[parts[1]],
            "object": lambda parts: self._object(*parts),
        }  # fmt: skip

    def value(self, described: Any) -> Any:
        if not isinstance(described, dict):
            if isinstance(described, list):
                raise TypeError("a list without its kind")
            return described
        ((kind, content),) = described.items()
        return self._kinds[kind](content)

    def _read_only(self, number: str) -> np.ndarray[Any, Any]:
        """A view of an array, the same one wherever it occurs."""
        # A process keeps values for several stages: a plugin that wrote into them would change the results of others.
        if number not in self._views:
            self._views[number] = self._arrays[number].view()
            self._views[number].flags.writeable = False
        return self._views[number]

    def _part(self, described: tuple[str, str]) -> np.ndarray[Any, Any]:
        kind, number = described
        if kind not in ("array", "columnwise"):
            raise TypeError("a sparse matrix without arrays")
        # Writable: SciPy sorts indices in place.
        return self._arrays[number].T if kind == "columnwise" else self._arrays[number]

    def _sparse(self, wanted: str, kind: str, array: bool, shape: list[int], parts: list[Any]) -> SparseMatrix:
        arrays = [self._part(*part.items()) for part in parts]
        if kind not in SPARSE or wanted not in {*SPARSE, "lil", "dok"} or len(arrays) != len(SPARSE[kind]):
            raise ValueError("no format of a sparse matrix")
        make = getattr(sp, f"{kind}_{'array' if array else 'matrix'}")
        given = (arrays[2], (arrays[0], arrays[1])) if kind == "coo" else tuple(arrays)
        matrix = make(given, shape=tuple(shape))
        if kind in ("csr", "csc", "bsr"):
            if not arrays[1].dtype.kind == arrays[2].dtype.kind == "i":
                raise ValueError("indices that are no integers")
            # Compiled loops trust the indices.
            matrix.check_format(full_check=True)
            # The constructor may have converted them.
            matrix.indices, matrix.indptr = arrays[1], arrays[2]
        return frozen(matrix) if wanted == kind else matrix.asformat(wanted)

    def _object(self, name: str, described: dict[str, Any]) -> Any:
        kind = make = _class(name, object)
        state = {key: self.value(part) for key, part in described.items()}
        if is_dataclass(kind):
            if state.keys() != {field.name for field in fields(kind)}:
                raise TypeError(f"other fields than those of {name}")
            return make(**state)
        made = object.__new__(kind)
        getattr(made, "__setstate__", made.__dict__.update)(state)
        return made


def _class(name: str, base: type) -> Any:
    named = _classes[name]
    if issubclass(named, Enum) is not (base is Enum):
        raise TypeError(f"{name} is another kind of class")
    return named


def _no_duplicates(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    pairs = list(pairs)
    unique = dict(pairs)
    # The reader must not depend on which of two entries JSON keeps.
    if len(unique) != len(pairs):
        raise ValueError("a name that occurs twice")
    return unique


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


@storable
@dataclass(frozen=True)
class History:
    """One convergence history: a quantity ("error", "sigma", …) over the steps of an algorithm, one value per step."""

    # `stage` is the column of the histories table. `first_step` is not 0 where several stages hold parts of one history
    # (`Stage.partial`).

    stage: str
    quantity: str
    values: tuple[float, ...]
    first_step: int

    @classmethod
    def of(cls, stage: str, quantity: object, values: Iterable[Any], first_step: int | None = None) -> History:
        """The history of a quantity that a plugin may have named and evaluated; `first_step` is 0 by default."""
        # The name must be one printable line: it goes to tables and terminals.
        return cls(stage, one_line(str(quantity)), tuple(map(float, values)), first_step or 0)


storable(Seconds)


@storable
@dataclass(frozen=True)
class Artefact:
    """Result of a stage, the seconds it took on the machine where it was measured, and its histories."""

    value: Any
    seconds: Seconds
    histories: tuple[History, ...]
    machine: str

    @classmethod
    def read(cls, content: bytes) -> Artefact:
        """The artefact that `dumps` wrote; raises a `DamagedArtefactError` if the content is anything else."""
        artefact = loads(content)
        if not isinstance(artefact, cls):
            raise DamagedArtefactError("no artefact")
        seconds, histories = artefact.seconds, artefact.histories
        right = isinstance(seconds, Seconds) and isinstance(histories, tuple) and isinstance(artefact.machine, str)
        if not right or not all(isinstance(history, History) for history in histories):
            raise DamagedArtefactError("an artefact with members of other types")
        return artefact


def default_folder() -> Path:
    """Folder of the artefacts: `$VIBENCH_CACHE`, or the user's cache folder."""
    return Path(os.environ.get("VIBENCH_CACHE") or platformdirs.user_cache_dir("vibench")).absolute() / "artefacts"


class Store:
    """The artefacts in a folder, with a cache of those used last."""

    # `cached_bytes` limits the files of cached artefacts, 256 MiB by default; a larger artefact is read at each use. Of
    # the running stage it knows the dispensable inputs that were `lost`, by key, and the callback for its `progress`,
    # the fraction of it that is done.

    def __init__(self, folder: Path, cached_bytes: int | None = None) -> None:
        self.folder = folder
        size = 2**28 if cached_bytes is None else cached_bytes
        self._recent: LRUCache[str, tuple[Artefact, int]] = LRUCache(size, getsizeof=lambda one: one[1])
        self.lost: Mapping[str, Any] = {}
        self.progress: Callable[[float], None] = lambda _: None

    @property
    def lock(self) -> Path:
        """Lock file: shared by runs, exclusive for `clear`."""
        return self.folder / "lock"

    def get(self, key: str) -> Artefact | None:
        """The artefact stored under a key; `None` if it is missing or damaged."""
        if (recent := self._recent.get(key)) is not None:
            return recent[0]
        try:
            with self._path(key).open("rb") as file:
                digest, content = file.read(hashlib.sha256().digest_size), file.read()
            # Truncated, corrupted or renamed: the stage runs again.
            if digest != _digest(key, content):
                return None
            artefact = Artefact.read(content)
        except (FileNotFoundError, DamagedArtefactError):
            return None
        except OSError as error:
            raise StorageError(f"artefacts cannot be read from '{self.folder}': {error.strerror}") from None
        if len(content) <= self._recent.maxsize:
            self._recent[key] = artefact, len(content)
        return artefact

    def put(self, key: str, value: Any, seconds: Seconds, histories: tuple[History, ...]) -> None:
        """Store an artefact atomically: it is written to a temporary file, synced and renamed."""
        content = encoded(key, Artefact(value, seconds, histories, machine()))
        self._recent.pop(key, None)
        try:
            self.folder.mkdir(0o700, parents=True, exist_ok=True)
            write_atomically(self._path(key), content, durable=True)
        except OSError as error:
            raise StorageError(f"artefacts cannot be written to '{self.folder}': {error.strerror}") from None

    @contextlib.contextmanager
    def used(self) -> Iterator[None]:
        """Keep the store from being cleared inside the block."""
        with locked(self.lock, shared=True, busy=f"the artefacts in '{self.folder}' are being removed"):
            yield

    def contents(self) -> list[tuple[str, int, float]]:
        """The stored artefacts: label of the stage, bytes, and age in seconds."""
        listed = []
        for path in sorted(self.folder.glob("*.artefact")):
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                listed.append((path.name.rpartition("-")[0], status.st_size, time.time() - status.st_mtime))
        return listed

    def clear(self, older_than: float | None = None) -> int:
        """Remove artefacts (older than some seconds) and temporary files of killed runs; returns the bytes freed."""
        freed, newest = 0, time.time() - (older_than or 0.0)
        if not self.folder.is_dir():
            return freed
        with locked(self.lock, busy=f"a run uses the artefacts in '{self.folder}'"):
            for path in [*self.folder.glob("*.artefact"), *self.folder.glob(f"{TEMPORARY}*.part")]:
                with contextlib.suppress(FileNotFoundError):
                    status = path.lstat()
                    if path.suffix == ".part" or older_than is None or status.st_mtime <= newest:
                        path.unlink()
                        freed += status.st_size
        return freed

    def _path(self, key: str) -> Path:
        # The file holds a digest (SHA-256) of its name and of the content that follows.
        return self.folder / f"{key}.artefact"


def encoded(key: str, artefact: Artefact) -> bytes:
    """The bytes of the file of an artefact."""
    content = dumps(artefact)
    return _digest(key, content) + content


def _digest(key: str, content: bytes) -> bytes:
    # With the key: a renamed file must not pass for another artefact.
    return hashlib.sha256(key.encode() + b"\0" + content).digest()


def usable_store() -> Store:
    """The store all runs share."""
    store = Store(default_folder())
    try:
        store.folder.mkdir(0o700, parents=True, exist_ok=True)
        # Whoever may write could plant false numbers. A folder that is named on purpose may be shared by a group.
        if store.folder.stat().st_mode & (0o002 if os.environ.get("VIBENCH_CACHE") else 0o022):
            others = f"others may write into the folder for artefacts, '{store.folder}'"
            raise RequestError(f"{others}: run `chmod go-w` on it, or set VIBENCH_CACHE to another one")
    except OSError as error:
        failed = f"the folder for artefacts, '{store.folder}', cannot be made: {error.strerror}"
        raise RequestError(f"{failed}; set VIBENCH_CACHE to another one") from None
    return store
