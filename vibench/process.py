"""The state of a process that the code of plugins may change, and how it is put back."""

from __future__ import annotations

import locale
import os
import random
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np


@contextmanager
def put_back() -> Iterator[list[str]]:
    """Put back what the block changes in this process; at its end the list has the names of that."""
    before, changed = _state(), list[str]()
    try:
        yield changed
    finally:
        changed += [name for name, (value, _) in _state().items() if value != before[name][0]]
        for value, back in map(before.__getitem__, changed):
            back(value)


def _state() -> dict[str, tuple[Any, Callable[[Any], object]]]:
    """The state as it is now, and how every part is put back."""
    name, key, *rest = np.random.get_state()  # noqa: NPY002  plugins may use it
    left = signal.getitimer(signal.ITIMER_REAL)[0]
    ends = left and round(time.monotonic() + left, -2)
    handlers = {number: signal.getsignal(number) for number in signal.valid_signals()}
    return {
        "sys.path": (sys.path[:], lambda known: setattr(sys, "path", known)),
        "the recursion limit": (sys.getrecursionlimit(), sys.setrecursionlimit),
        "numpy.seterr": (np.geterr(), lambda known: np.seterr(**known)),
        "warnings.filters": (warnings.filters[:], lambda known: setattr(warnings, "filters", known)),
        "the working directory": (_folder(), os.chdir),
        "the environment": (os.environ.copy(), _set_environment),
        "the state of random": (random.getstate(), random.setstate),
        "the state of numpy.random": ((name, np.asarray(key).tolist(), *rest), np.random.set_state),
        "the handlers of signals": (handlers, _set_handlers),
        # A timer that goes off later ends the work of others.
        "the timer": (ends, lambda known: signal.setitimer(signal.ITIMER_REAL, known and known - time.monotonic())),
        "the locale": (locale.setlocale(locale.LC_ALL), lambda known: locale.setlocale(locale.LC_ALL, known)),
    }


def _folder() -> str:
    try:
        return str(Path.cwd())
    except OSError:
        return os.sep  # it has been removed


def _set_environment(known: Mapping[str, str]) -> None:
    os.environ.clear()
    os.environ.update(known)


def _set_handlers(known: Mapping[signal.Signals, Any]) -> None:
    for number, handler in known.items():
        # `None` stands for a handler of a library, which Python cannot set.
        if handler is not None and signal.getsignal(number) is not handler:
            signal.signal(number, handler)
