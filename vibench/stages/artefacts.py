"""Artefacts: results of stages, each a file under the hash of its inputs, shared by all runs."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import platformdirs
from cachetools import LRUCache

from vibench.errors import RequestError, StorageError
from vibench.files import PART, TEMPORARY, locked, write_atomically
from vibench.provenance import machine
from vibench.stages.serialisation import DamagedArtefactError, dumps, loads, storable
from vibench.text import one_line
from vibench.timing import Seconds


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
            for path in [*self.folder.glob("*.artefact"), *self.folder.glob(f"{TEMPORARY}*{PART}")]:
                with contextlib.suppress(FileNotFoundError):
                    status = path.lstat()
                    if path.suffix == PART or older_than is None or status.st_mtime <= newest:
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
