import builtins
import os
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from vibench.process import put_back


def lower(name: str, soft: int) -> None:
    limit = getattr(resource, name)
    resource.setrlimit(limit, (soft, resource.getrlimit(limit)[1]))


# What is done, and how it is seen afterwards.
ACTS: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
    "sys.path": (lambda: setattr(sys, "path", []), lambda: sys.path[:]),
    "sys.meta_path": (lambda: setattr(sys, "meta_path", []), lambda: sys.meta_path[:]),
    "sys.path_hooks": (lambda: setattr(sys, "path_hooks", []), lambda: sys.path_hooks[:]),
    "sys.stdout": (lambda: setattr(sys, "stdout", None), lambda: sys.stdout),
    "sys.setprofile": (lambda: sys.setprofile(lambda *_: None), sys.getprofile),
    "sys.modules": (lambda: sys.modules.pop("tempfile"), lambda: sys.modules.get("tempfile")),
    "builtins": (lambda: setattr(builtins, "sorted", None), lambda: sorted),
    "warnings.filters": (lambda: warnings.simplefilter("ignore"), lambda: warnings.filters[:]),
    "the recursion limit": (lambda: sys.setrecursionlimit(10**6), sys.getrecursionlimit),
    "the limit RLIMIT_FSIZE": (lambda: lower("RLIMIT_FSIZE", 4096), lambda: resource.getrlimit(resource.RLIMIT_FSIZE)),
    "the limit RLIMIT_NOFILE": (lambda: lower("RLIMIT_NOFILE", 64), lambda: resource.getrlimit(resource.RLIMIT_NOFILE)),
    "the umask": (lambda: os.umask(0o777), lambda: os.umask(mask := os.umask(0o077)) and mask),
    "the folder of temporary files": (lambda: setattr(tempfile, "tempdir", "/no"), tempfile.gettempdir),
    f"the handler of {signal.SIGUSR1}": (
        lambda: signal.signal(signal.SIGUSR1, signal.SIG_IGN), lambda: signal.getsignal(signal.SIGUSR1)
    ),
    "the timer 1": (lambda: signal.setitimer(signal.ITIMER_VIRTUAL, 1e3), lambda: signal.getitimer(1)),
    "time": (lambda: setattr(time, "process_time", float), lambda: time.process_time),
    "numpy": (lambda: setattr(np, "argmax", np.argmin), lambda: np.argmax),
    "numpy.linalg": (lambda: setattr(np.linalg, "norm", np.size), lambda: np.linalg.norm),
    "scipy.linalg": (lambda: setattr(scipy.linalg, "cholesky", np.zeros_like), lambda: scipy.linalg.cholesky),
    "numpy.seterr": (lambda: np.seterr(all="raise"), np.geterr),
}  # fmt: skip


@pytest.mark.parametrize("what", ACTS)
def test_what_is_changed_is_put_back_and_named(what: str) -> None:
    act, seen = ACTS[what]
    before = seen()
    with put_back() as changed:
        act()
    assert changed == {what: True}
    assert seen() == before


def test_what_cannot_be_put_back_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "chdir", lambda _: None)
    before = os.getcwd()  # noqa: PTH109
    try:
        with put_back() as changed:
            os.fchdir(os.open("/", os.O_RDONLY))
        assert changed == {"the working directory": False}
    finally:
        monkeypatch.undo()
        os.chdir(before)
