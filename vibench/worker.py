"""What happens inside a worker process: one stage at a time, on one thread, under a memory limit."""

from __future__ import annotations

import resource
import signal
import time
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


def initialise(memory_gib: float) -> None:
    """Prepare a worker: one thread, no more memory than allowed, and Ctrl-C left to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    limit, hard = int(memory_gib * 2**30), resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
    threadpool_limits(1)


def perform(folder: str, stage: Stage) -> Done | Failed:
    """Run one stage; what a plugin raises becomes a reason, so that the rest of the matrix goes on."""
    store = _store(folder)
    start = time.perf_counter()
    try:
        result = stage.run(store)
        queries = isinstance(stage, QueriesStage)
        if not queries:
            store.put(stage.key, result.value, result.seconds, result.histories)
    except MemoryError:
        return Failed(Status.ERROR, "out of memory: the limit memory_gib was reached")
    except Exception as error:  # noqa: BLE001  plugins may raise anything; the row says what
        name = "" if isinstance(error, VibenchError) else f"{type(error).__name__}: "
        return Failed(Status.ERROR, " ".join(f"{name}{error}".split()))
    return Done(result.histories, result.value if queries else None, time.perf_counter() - start)


@cache
def _store(folder: str) -> Store:
    return Store(Path(folder))
