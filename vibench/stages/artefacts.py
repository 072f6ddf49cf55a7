"""Artefacts: results of stages, each a file under the hash of its inputs, shared by all runs."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Iterable, Iterator
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

CACHE_VARIABLE = "VIBENCH_CACHE"
"""Environment variable that sets the cache folder, in which artefacts are kept."""

SUFFIX = ".artefact"
"""Suffix of artefact files: each holds a digest (SHA-256) of its name and of the content that follows."""

OTHERS, ANYBODY = 0o022, 0o002
"""Permission bits of all but the owner to write; of those outside the group alone."""

DIGEST = hashlib.sha256().digest_size

LOCK = "lock"
"""Lock file: shared by runs, exclusive for `clear`."""

KEPT = 2**28
"""Bytes of artefacts that a store keeps in memory, by the size of their files, unless it is told otherwise."""


@storable
@dataclass(frozen=True)
class History:
    """One convergence history: a quantity ("error", "sigma", …) over the steps of an algorithm, one value per step.

    `stage` is the column of the histories table. `first_step` is not 0 where several stages hold parts of one history
    (`Stage.partial`).
    """

    stage: str
    quantity: str
    values: tuple[float, ...]
    first_step: int = 0

    @classmethod
    def of(cls, stage: str, quantity: object, values: Iterable[Any], first_step: int = 0) -> History:
        """The history of a quantity that a plugin may have named and evaluated: its name is one printable line.

        Raises a `TypeError`, a `ValueError` or an `OverflowError` if a value is no number, or too large for one.
        """
        return cls(stage, one_line(str(quantity)), tuple(map(float, values)), first_step)


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
        """The artefact that `dumps` wrote.

        Raises a `DamagedArtefactError` if the content is anything else.
        """
        artefact = loads(content)
        if not isinstance(artefact, cls):
            raise DamagedArtefactError("no artefact")
        seconds, histories = artefact.seconds, artefact.histories
        right = isinstance(seconds, Seconds) and isinstance(histories, tuple) and isinstance(artefact.machine, str)
        if not right or not all(isinstance(history, History) for history in histories):
            raise DamagedArtefactError("an artefact with members of other types")
        return artefact


def default_folder() -> Path:
    """Where artefacts are kept: `$VIBENCH_CACHE`, or the user's cache folder."""
    return Path(os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_dir("vibench")).absolute() / "artefacts"


class Store:
    """The artefacts in a folder, of which those used last are kept in memory.

    Parameters
    ----------
    folder
        Where their files are.
    kept
        Bytes of files whose artefacts are kept in memory at most; a larger artefact is read whenever it is asked for.
    """

    def __init__(self, folder: Path, kept: int = KEPT) -> None:
        self.folder = folder
        self._recent: LRUCache[str, tuple[Artefact, int]] = LRUCache(kept, getsizeof=lambda one: one[1])

    def get(self, key: str) -> Artefact | None:
        """The artefact stored under a key; `None` if it is missing or damaged.

        Raises a `StorageError` if the folder cannot be read.
        """
        if (recent := self._recent.get(key)) is not None:
            return recent[0]
        try:
            with self._path(key).open("rb") as file:
                digest, content = file.read(DIGEST), file.read()
            if digest != _digest(key, content):
                return None  # truncated, corrupted or renamed
            artefact = Artefact.read(content)
        except (FileNotFoundError, DamagedArtefactError):
            return None
        except OSError as error:
            raise StorageError(f"artefacts cannot be read from '{self.folder}': {error.strerror}") from None
        if len(content) <= self._recent.maxsize:
            self._recent[key] = artefact, len(content)
        return artefact

    def put(self, key: str, value: Any, seconds: Seconds, histories: tuple[History, ...]) -> None:
        """Store an artefact atomically: it is written to a temporary file, synced and renamed.

        Raises a `NumericalError` if the value holds anything but arrays and data, and a `StorageError` if it cannot be
        written.
        """
        content = encoded(key, Artefact(value, seconds, histories, machine()))
        self._recent.pop(key, None)
        try:
            self.folder.mkdir(0o700, parents=True, exist_ok=True)
            write_atomically(self._path(key), content, durable=True)
        except OSError as error:
            raise StorageError(f"artefacts cannot be written to '{self.folder}': {error.strerror}") from None

    @contextlib.contextmanager
    def used(self) -> Iterator[None]:
        """Keep the store from being cleared inside the block.

        Raises a `RequestError` if it is being cleared now, or cannot be written.
        """
        with locked(self.folder / LOCK, shared=True, busy=f"the artefacts in '{self.folder}' are being removed"):
            yield

    def contents(self) -> list[tuple[str, int, float]]:
        """The stored artefacts: label of the stage, bytes, and age in seconds."""
        listed = []
        for path in sorted(self.folder.glob(f"*{SUFFIX}")):
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                listed.append((path.name.rpartition("-")[0], status.st_size, time.time() - status.st_mtime))
        return listed

    def clear(self, older_than: float = 0.0) -> int:
        """Remove artefacts older than so many seconds, and temporary files of killed runs; returns the bytes freed.

        Raises a `RequestError` if a run uses the store.
        """
        freed = 0
        if not self.folder.is_dir():
            return freed
        with locked(self.folder / LOCK, busy=f"a run uses the artefacts in '{self.folder}'"):
            for path in [*self.folder.glob(f"*{SUFFIX}"), *self.folder.glob(f"{TEMPORARY}*{PART}")]:
                with contextlib.suppress(FileNotFoundError):
                    status = path.lstat()
                    if path.suffix == PART or time.time() - status.st_mtime >= older_than:
                        path.unlink()
                        freed += status.st_size
        return freed

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}{SUFFIX}"


def encoded(key: str, artefact: Artefact) -> bytes:
    """An artefact as it is stored under a key."""
    content = dumps(artefact)
    return _digest(key, content) + content


def _digest(key: str, content: bytes) -> bytes:
    """Digest of the name and the content of an artefact."""
    code = hashlib.sha256(key.encode() + b"\0")
    code.update(content)
    return code.digest()


def usable_store() -> Store:
    """The store all runs share.

    Raises a `RequestError` if its folder cannot be created, or others may write into it.
    """
    store = Store(default_folder())
    try:
        store.folder.mkdir(0o700, parents=True, exist_ok=True)
        # Whoever may write could plant false numbers. A folder that is named on purpose may be shared by a group.
        if store.folder.stat().st_mode & (ANYBODY if os.environ.get(CACHE_VARIABLE) else OTHERS):
            raise RequestError(
                f"others may write into the folder for artefacts, '{store.folder}': run `chmod go-w` on it, "
                f"or set {CACHE_VARIABLE} to another one"
            )
    except OSError as error:
        raise RequestError(
            f"the folder for artefacts, '{store.folder}', cannot be made: {error.strerror}; "
            f"set {CACHE_VARIABLE} to another one"
        ) from None
    return store
