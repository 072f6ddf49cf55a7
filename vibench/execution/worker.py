"""The worker process: it runs one stage at a time, on one thread, under a memory limit."""

from __future__ import annotations

import errno
import faulthandler
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from vibench import interrupts
from vibench.errors import NumericalError, StorageError, UnsupportedError, VibenchError, in_a_line, message_of
from vibench.execution.descendants import MARK, kill_marked
from vibench.execution.parts import Part, PartDone
from vibench.execution.supervisor import Begun, Finished, Job, OutOfMemory, Progress, Watch, code_here
from vibench.qp.status import Status
from vibench.stages.base import Done, Failed, Pieces, PiecewiseStage, Unstored
from vibench.storage.artefacts import Store

T = TypeVar("T")
Send = Callable[[Any], None]

OF_THIS_PROCESS = (errno.EBADF, errno.EFBIG, errno.EMFILE)
"""Errors of writing that other processes need not have."""


class _NoMemoryError(Exception):
    """The memory limit was reached; this process has to be replaced."""


def main() -> None:
    """Serve the supervisor at the other end of a socket until it closes the connection."""
    socket, log = int(sys.argv[1]), os.open(sys.argv[2], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.set_inheritable(socket, False)  # children of plugins must not hold it open
    connection = Connection(socket)
    for stream in (1, 2):  # what plugins print must not look like output of vibench
        os.dup2(log, stream)
    faulthandler.enable()
    interrupts.ignore()
    threadpool_limits(1)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    own, first = os.getpid(), True

    def send(message: Any) -> None:
        if os.getpid() != own:  # a plugin forked: the child must not use the socket
            os._exit(0)
        connection.send(message)

    while True:
        try:
            job, progress, part = connection.recv()
        except EOFError:
            return
        send(Begun())
        # The allocator keeps freed memory: a large process is replaced before the next job instead of failing it.
        if not first and not _last and _address_space() > 0.5 * job.memory_gib * 2**30:
            send(OutOfMemory(None))
            return
        first = False
        faulthandler.dump_traceback_later(2.0 * job.cell_seconds + 60.0, exit=True)  # in case the supervisor has died
        send(perform(job, progress, part, send))
        faulthandler.cancel_dump_traceback_later()


def _end_with(parent: int) -> None:
    """Kill this process and the children of plugins once the parent has died, since its limits are not enforced."""
    while os.getppid() == parent:
        time.sleep(1.0)
    kill_marked(os.environ[MARK])
    os.killpg(0, signal.SIGKILL)


def perform(job: Job, progress: Progress, part: Part, send: Send) -> Done | PartDone | Failed | Unstored | OutOfMemory:
    """Run one stage or a part of it; an exception of a plugin is the reason of a failed stage and ends no run."""
    start = time.perf_counter()

    def work() -> Done | PartDone:
        _check_code(job, part)
        store = _store(job.store)
        if isinstance(job.stage, PiecewiseStage):
            pieces = _begun(job.stage, store)
            known = {number: pieces.lost(number, failed) for number, failed in progress.lost.items()} | progress.found
            pieces.resume(known)
            found = known | _pieces(job, pieces, part, send)
            if not part.ends:
                return PartDone()
            _last.clear()
            value = pieces.finish([found[number] for number in range(job.stage.pieces)])
            return Done((), value, time.perf_counter() - start)
        result = job.stage.run(store)
        store.put(job.stage.key, result.value, result.seconds, result.histories)
        return Done(result.histories, None, time.perf_counter() - start)

    try:
        return _guarded(job.memory_gib, work)
    except StorageError as error:
        if isinstance(error.__context__, OSError) and error.__context__.errno in OF_THIS_PROCESS:
            return Failed(Status.ERROR, f"{error}; a plugin limits or closes the files of its process")
        return Unstored(str(error))
    except _NoMemoryError:
        return OutOfMemory(Failed(Status.ERROR, f"out of memory: the limit is memory_gib = {job.memory_gib:g}"))


def _check_code(job: Job, part: Part) -> None:
    """Refuse a job that was planned with other code than this process has: its artefact would have the wrong key."""
    stage = job.stage
    parts = (stage.stage_of(number) for number in part.numbers) if isinstance(stage, PiecewiseStage) else (stage,)
    # Each once: stages reach the same plugins through many of their inputs.
    used = dict.fromkeys(plugin for one in {part.key: part for part in parts}.values() for plugin in one.plugins())
    changed = [f"the {p}" for p in used if p.as_installed() != p]
    if job.code != code_here():
        changed.insert(0, "vibench or one of the libraries")
    if changed:
        raise NumericalError(f"{changed[0]} was changed since the run began; run the study again")


_last: dict[str, Pieces] = {}
"""The piecewise stage that was begun and has not ended, by its key: other processes may do parts of it meanwhile."""


def _begun(stage: PiecewiseStage, store: Store) -> Pieces:
    if stage.key not in _last:
        _last.clear()
        _last[stage.key] = stage.begin(store)
    return _last[stage.key]


def _pieces(job: Job, pieces: Pieces, part: Part, send: Send) -> dict[int, Any]:
    """Do the pieces of a part."""
    found = {}
    for number in part.numbers:

        def watch(on: bool, number: int = number) -> None:
            send(Watch(number, on))

        watch(False)
        value = _guarded(job.memory_gib, partial(pieces.piece, number, watch))
        found[number] = pieces.lost(number, value) if isinstance(value, Failed) else value
        send(Finished(number, found[number]))
    return found


def _guarded(memory_gib: float, work: Callable[[], T]) -> T | Failed:
    """The value of `work()`, or the reason of its failure."""
    try:
        with _memory_limit(memory_gib):
            return work()
    except MemoryError:
        raise _NoMemoryError from None
    except (StorageError, _NoMemoryError):
        raise
    except UnsupportedError as error:
        return Failed(Status.UNAVAILABLE, message_of(error))
    except VibenchError as error:
        return Failed(Status.ERROR, message_of(error))
    except (Exception, SystemExit, KeyboardInterrupt) as error:  # noqa: BLE001  plugins may raise anything
        return Failed(Status.ERROR, in_a_line(error))


@contextmanager
def _memory_limit(gib: float) -> Iterator[None]:
    """Limit the address space inside the block; outside it the worker needs memory to reply."""
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
    """Bytes of address space in use, 0 on systems without /proc."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[0]) * resource.getpagesize() if statm.is_file() else 0


@cache
def _store(folder: str) -> Store:
    return Store(Path(folder))


if __name__ == "__main__":
    main()
