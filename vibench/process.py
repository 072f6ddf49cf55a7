"""The state of a process that the code of plugins may change, and how it is put back."""

from __future__ import annotations

import contextlib
import locale
import os
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np


@contextlib.contextmanager
def put_back() -> Iterator[dict[str, bool]]:
    """Put back what the block changes in this process; at its end there are the names of that, and if it is back."""
    before, changed = [(name, read, write, read()) for name, (read, write) in _parts().items()], dict[str, bool]()
    modules = dict(sys.modules)
    try:
        yield changed
    finally:
        for name, read, write, value in before:
            if read() != value:
                # Limits may go one way alone, and a library may have a handler that Python cannot set.
                with contextlib.suppress(OSError, ValueError, TypeError):
                    write(value)
                changed[name] = read() == value
        if lost := {name: one for name, one in modules.items() if sys.modules.get(name) is not one}:
            sys.modules.update(lost)
            changed["sys.modules"] = True


def _parts() -> dict[str, tuple[Callable[[], Any], Callable[[Any], object]]]:
    """How every part of the state is read and put back; those come first that reading the others needs."""
    owned = {sys: ("path", "meta_path", "path_hooks", "stdin", "stdout", "stderr"), warnings: ("filters",)}
    return {
        "the recursion limit": (sys.getrecursionlimit, sys.setrecursionlimit),
        **{
            # A function that a plugin replaces there makes the numbers of others wrong in silence.
            module.__name__: (partial(_functions, module), vars(module).update)
            for module in map(sys.modules.get, ("builtins", "time", "numpy", "numpy.linalg", "scipy.linalg"))
            if module is not None
        },
        "sys.settrace": (sys.gettrace, sys.settrace), "sys.setprofile": (sys.getprofile, sys.setprofile),
        **{
            f"{owner.__name__}.{name}": (partial(_copy, owner, name), partial(setattr, owner, name))
            for owner, names in owned.items()
            for name in names
        },
        "numpy.seterr": (np.geterr, lambda known: np.seterr(**known)),
        **{
            f"the limit {name}": (partial(resource.getrlimit, one), partial(resource.setrlimit, one))
            for name, one in vars(resource).items()
            if name.startswith("RLIMIT_")
        },
        "the umask": (_umask, os.umask),
        "the working directory": (_folder, os.chdir), "the environment": (os.environ.copy, _set_environment),
        "the folder of temporary files": (tempfile.gettempdir, partial(setattr, tempfile, "tempdir")),
        "the state of random": (random.getstate, random.setstate),
        "the state of numpy.random": (_numpy_random, np.random.set_state),
        **{f"the handler of {one}": (partial(signal.getsignal, one), partial(signal.signal, one))
           for one in signal.valid_signals()},
        # A timer that goes off later ends the work of others.
        **{f"the timer {one}": (partial(_ends, one), partial(_set_timer, one)) for one in range(3)},
        "the locale": (partial(locale.setlocale, locale.LC_ALL), partial(locale.setlocale, locale.LC_ALL)),
    }  # fmt: skip


def _functions(module: ModuleType) -> dict[str, Any]:
    # Submodules are added as they are imported.
    return {name: one for name, one in vars(module).items() if callable(one)}


def _copy(owner: Any, name: str) -> Any:
    value = getattr(owner, name)
    return value[:] if isinstance(value, list) else value


def _umask() -> int:
    # It cannot be read without being set.
    os.umask(mask := os.umask(0o077))
    return mask


def _folder() -> str:
    try:
        return str(Path.cwd())
    except OSError:
        return os.sep  # it has been removed


def _set_environment(known: Mapping[str, str]) -> None:
    os.environ.clear()
    os.environ.update(known)


def _numpy_random() -> tuple[Any, ...]:
    name, key, *rest = np.random.get_state()  # noqa: NPY002  plugins may use it
    return (name, np.asarray(key).tolist(), *rest)


def _now(timer: int) -> float:
    return time.monotonic() if timer == signal.ITIMER_REAL else time.process_time()


def _ends(timer: int) -> float:
    """When a timer goes off, in hundreds of seconds; 0 if never."""
    left = signal.getitimer(timer)[0]
    return left and round(_now(timer) + left, -2)


def _set_timer(timer: int, ends: float) -> None:
    signal.setitimer(timer, ends and max(ends - _now(timer), 1.0))
