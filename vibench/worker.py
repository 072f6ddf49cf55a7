"""What happens inside a worker process: one stage at a time, on one thread, under a memory limit."""

from __future__ import annotations

import os
import resource
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from vibench.errors import VibenchError
from vibench.qp import Status
from vibench.queries import QueriesStage
from vibench.stage import Stage
from vibench.store import History, Store


@dataclass(frozen=True)
class Done:
    """A stage that went through: its histories, its value if the parent needs it, and how long it kept its worker."""

    histories: tuple[History, ...]
    value: Any
    wall: float


@dataclass(frozen=True)
class Failed:
    """A stage that did not: the status its cells get, and why."""

    status: Status
    reason: str


def initialise() -> None:
    """Prepare a worker: one thread, Ctrl-C left to the parent, and no life after the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(1)
    threading.Thread(target=_follow, args=(os.getppid(),), daemon=True).start()


def _follow(parent: int) -> None:
    """End this process once its parent has: nobody would enforce its limits or want its results."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def perform(folder: str, stage: Stage, memory_gib: float) -> Done | Failed:
    """Run one stage; what a plugin raises becomes a reason, so that the rest of the matrix goes on."""
    start = time.perf_counter()
    try:
        with _memory_limit(memory_gib):
            store = _store(folder)
            result = stage.run(store)
            queries = isinstance(stage, QueriesStage)
            if not queries:
                store.put(stage.key, result.value, result.seconds, result.histories)
    except MemoryError:
        return Failed(Status.ERROR, f"out of memory: the limit is memory_gib = {memory_gib:g}")
    except (Exception, SystemExit) as error:  # noqa: BLE001  plugins may raise anything; the row says what
        name = "" if isinstance(error, VibenchError) else f"{type(error).__name__}: "
        return Failed(Status.ERROR, " ".join(f"{name}{error}".split()))
    return Done(result.histories, result.value if queries else None, time.perf_counter() - start)


@contextmanager
def _memory_limit(gib: float) -> Iterator[None]:
    """No more address space than this while a stage runs; outside, the worker must be able to answer."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = int(gib * 2**30)
    if _address_space() > limit:
        raise MemoryError
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _address_space() -> int:
    """Bytes of address space in use, 0 where the system does not tell."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[0]) * resource.getpagesize() if statm.is_file() else 0


@cache
def _store(folder: str) -> Store:
    return Store(Path(folder))
