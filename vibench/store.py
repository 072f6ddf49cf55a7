"""Artefacts: results of stages, each a file under the hash of its inputs."""

from __future__ import annotations

import os
import pickle
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vibench.provenance import machine
from vibench.timing import Seconds

ARTEFACTS = "artefacts"
"""Folder of the artefacts within a run folder."""


@dataclass(frozen=True)
class History:
    """One convergence history: what is plotted against the steps of an algorithm.

    Attributes
    ----------
    key
        The columns of the histories table that say whose it is.
    quantity
        "error", "sigma", …
    values
        One per step.
    """

    key: dict[str, Any]
    quantity: str
    values: tuple[float, ...]


@dataclass(frozen=True)
class Artefact:
    """Result of a stage, the seconds it took where it was measured, and its histories."""

    value: Any
    seconds: Seconds
    histories: tuple[History, ...]
    machine: str


class Store:
    """The artefacts of a run folder.

    An artefact of another machine counts as missing: its seconds would not compare.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._recent: dict[str, Artefact] = {}

    def get(self, key: str) -> Artefact | None:
        """The artefact stored under a key, or `None`."""
        if key in self._recent:
            return self._recent[key]
        try:
            with self._path(key).open("rb") as file:
                artefact = pickle.load(file)
        except (OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError, ValueError, IndexError):
            return None  # not there, cut off, or written by other code: it is made again
        if not isinstance(artefact, Artefact) or artefact.machine != machine():
            return None
        if len(self._recent) >= 64:
            self._recent.pop(next(iter(self._recent)))
        self._recent[key] = artefact
        return artefact

    def put(self, key: str, value: Any, seconds: Seconds, histories: tuple[History, ...]) -> None:
        """Store an artefact: written beside its place, then renamed, so that it is whole or not there."""
        self.folder.mkdir(parents=True, exist_ok=True)
        artefact = Artefact(value, seconds, histories, machine())
        handle, name = tempfile.mkstemp(dir=self.folder, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                pickle.dump(artefact, file, protocol=pickle.HIGHEST_PROTOCOL)
            Path(name).replace(self._path(key))
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.pickle"
