"""Artefacts: results of stages, each a file under the hash of its inputs, shared by all runs."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import platformdirs
from cachetools import LRUCache

from vibench.errors import RequestError, StorageError
from vibench.locking import locked
from vibench.provenance import machine
from vibench.text import one_line
from vibench.timing import Seconds

CACHE_VARIABLE = "VIBENCH_CACHE"
"""Environment variable that sets the cache folder, in which artefacts are kept."""

SUFFIX = ".artefact"
"""Suffix of artefact files: each holds a SHA-256 digest and then the pickle that it belongs to."""

LOCK = "lock"
"""Lock file: shared by runs, exclusive for `clear`."""


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

        Raises
        ------
        TypeError, ValueError, OverflowError
            If a value is no number, or too large for one.
        """
        return cls(stage, one_line(str(quantity)), tuple(map(float, values)), first_step)


@dataclass(frozen=True)
class Artefact:
    """Result of a stage, the seconds it took on the machine where it was measured, and its histories."""

    value: Any
    seconds: Seconds
    histories: tuple[History, ...]
    machine: str


def default_folder() -> Path:
    """Where artefacts are kept: `$VIBENCH_CACHE`, or the user's cache folder."""
    return Path(os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_dir("vibench")).absolute() / "artefacts"


class Store:
    """The artefacts in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._recent: LRUCache[str, Artefact] = LRUCache(maxsize=64)

    def get(self, key: str) -> Artefact | None:
        """The artefact stored under a key; `None` if it is missing or damaged.

        Raises
        ------
        StorageError
            If the folder cannot be read.
        """
        if key in self._recent:
            return self._recent[key]
        try:
            whole = memoryview(self._path(key).read_bytes())
            size = hashlib.sha256().digest_size
            digest, content = whole[:size], whole[size:]
            if hashlib.sha256(content).digest() != digest:
                return None  # truncated or corrupted
            artefact = pickle.loads(content)
        except (FileNotFoundError, pickle.UnpicklingError, EOFError, AttributeError, ImportError):
            return None  # missing, or pickled with classes that no longer exist
        except OSError as error:
            raise StorageError(f"artefacts cannot be read from '{self.folder}': {error.strerror}") from None
        if not isinstance(artefact, Artefact):
            return None
        self._recent[key] = artefact
        return artefact

    def put(self, key: str, value: Any, seconds: Seconds, histories: tuple[History, ...]) -> None:
        """Store an artefact atomically: it is written to a temporary file, synced and renamed.

        Raises
        ------
        StorageError
            If it cannot be written.
        """
        content = pickle.dumps(Artefact(value, seconds, histories, machine()), protocol=pickle.HIGHEST_PROTOCOL)
        self._recent.pop(key, None)
        part = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            handle, part = tempfile.mkstemp(dir=self.folder, suffix=".part")
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(content).digest())
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            Path(part).replace(self._path(key))
        except OSError as error:
            raise StorageError(f"artefacts cannot be written to '{self.folder}': {error.strerror}") from None
        finally:
            if part is not None:
                Path(part).unlink(missing_ok=True)

    @contextlib.contextmanager
    def used(self) -> Iterator[None]:
        """Keep the store from being cleared inside the block.

        Raises
        ------
        RequestError
            If it is being cleared now, or cannot be written.
        """
        with locked(self.folder / LOCK, shared=True, busy=f"the artefacts in '{self.folder}' are being removed"):
            yield

    def contents(self) -> list[tuple[str, int, float]]:
        """The stored artefacts: label of the stage, bytes, and age in seconds."""
        found = []
        for path in sorted(self.folder.glob(f"*{SUFFIX}")):
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                found.append((path.name.rpartition("-")[0], status.st_size, time.time() - status.st_mtime))
        return found

    def clear(self, older_than: float = 0.0) -> int:
        """Remove artefacts older than so many seconds, and temporary files of killed runs; returns the bytes freed.

        Raises
        ------
        RequestError
            If a run uses the store.
        """
        freed = 0
        if not self.folder.is_dir():
            return freed
        with locked(self.folder / LOCK, busy=f"a run uses the artefacts in '{self.folder}'"):
            for path in [*self.folder.glob(f"*{SUFFIX}"), *self.folder.glob("*.part")]:
                with contextlib.suppress(FileNotFoundError):
                    status = path.stat()
                    if path.suffix == ".part" or time.time() - status.st_mtime >= older_than:
                        path.unlink()
                        freed += status.st_size
        return freed

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}{SUFFIX}"


def usable_store() -> Store:
    """The store all runs share.

    Raises
    ------
    RequestError
        If its folder cannot be created.
    """
    store = Store(default_folder())
    try:
        store.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RequestError(
            f"the folder for artefacts, '{store.folder}', cannot be made: {error.strerror}; "
            f"set {CACHE_VARIABLE} to another one"
        ) from None
    return store
