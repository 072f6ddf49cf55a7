"""The state of a worker process that plugins may change: what one leaves behind is put back, and named as its fault."""

from __future__ import annotations

import os
import sys
import threading
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np


def _folder() -> str:
    try:
        return str(Path.cwd())
    except OSError:
        return os.sep  # it has been removed


def _set_environment(known: Mapping[str, str]) -> None:
    os.environ.clear()
    os.environ.update(known)


class ProcessState:
    """The state of the process at its creation."""

    # How every part is read, and how it is put back.
    parts: ClassVar[Mapping[str, tuple[Callable[[], Any], Callable[[Any], object]]]] = {
        "sys.path": (lambda: sys.path[:], lambda known: setattr(sys, "path", known)),
        "the recursion limit": (sys.getrecursionlimit, sys.setrecursionlimit),
        "numpy.seterr": (np.geterr, lambda known: np.seterr(**known)),
        "warnings.filters": (lambda: warnings.filters[:], lambda known: setattr(warnings, "filters", known)),
        "the working directory": (_folder, os.chdir),
        "the environment": (os.environ.copy, _set_environment),
    }

    def __init__(self) -> None:
        self._known = {name: read() for name, (read, _) in self.parts.items()}
        self._threads = set(threading.enumerate())

    @property
    def has_new_threads(self) -> bool:
        """Whether threads have begun since that still run, which cannot be put back."""
        return not self._threads.issuperset(threading.enumerate())

    def put_back(self) -> list[str]:
        """Put back what has changed since; returns its names."""
        changed = [name for name, known in self._known.items() if self.parts[name][0]() != known]
        for name in changed:
            self.parts[name][1](self._known[name])
        return changed
