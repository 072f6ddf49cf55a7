"""The worker process: it runs one stage at a time, on one thread, under a memory limit."""

from __future__ import annotations

import errno
import faulthandler
import io
import os
import resource
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from vibench import interrupts
from vibench.errors import NumericalError, StorageError, UnsupportedError, VibenchError, in_a_line, message_of
from vibench.execution import supervisor
from vibench.execution.supervisor import Batch, Job, Progress
from vibench.process import put_back
from vibench.qp.status import Status
from vibench.stages.artefacts import Store
from vibench.stages.base import Done, Failed, Items, ItemwiseStage, Unstored
from vibench.stages.snapshots import unchanged
from vibench.timing import Stopwatch

T = TypeVar("T")
Send = Callable[[Any], None]
Enter = Callable[[int, bool], None]  # sets the current item, and whether its operation has a time limit of its own


class _NoMemoryError(Exception):
    """The memory limit was reached; this process has to be replaced."""


def main() -> None:
    """Serve the supervisor at the other end of a socket until it closes the connection."""
    log = os.open(sys.argv[2], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    ours = socket.socket(fileno=int(sys.argv[1]))
    # Children of plugins must not hold the socket open.
    ours.set_inheritable(False)
    _, (shared,), *_ = socket.recv_fds(ours, 1, 1)
    current = supervisor.CurrentItem(shared)
    os.close(shared)
    connection = Connection(ours.detach())
    # The output of plugins must not look like output of vibench, and must not be lost with a buffer in a crash.
    for stream in (1, 2):
        os.dup2(log, stream)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)
    # A crash leaves its traceback in the log.
    faulthandler.enable()
    # Ctrl-C is for the command, which ends its workers itself.
    interrupts.ignore()
    # Seconds are those of one thread.
    threadpool_limits(1)
    own, first = os.getpid(), True

    def end_in_child() -> None:
        # A plugin has forked: the child must not talk to the supervisor.
        if os.getpid() != own:
            os._exit(0)

    def send(message: Any) -> None:
        end_in_child()
        connection.send(message)

    def enter(number: int, limited: bool) -> None:
        end_in_child()
        current.enter(number, limited=limited)

    while True:
        try:
            job, progress, batch = connection.recv()
        except EOFError:
            return
        send(supervisor.Begun())
        # The allocator keeps freed memory: replace a large process before the next job, which it might fail. A process
        # of other packages is replaced after anything that has failed in it: who knows what that has left behind.
        if not first and (_failed or (not _last and _address_space() > 0.5 * job.memory_gib * 2**30)):
            send(supervisor.OutOfMemory(None))
            return
        first = False
        send(perform(job, progress, batch, send, enter))


def perform(
    job: Job, progress: Progress, batch: Batch, send: Send, enter: Enter
) -> Done | supervisor.BatchDone | Failed | Unstored | supervisor.OutOfMemory:
    """Run a batch of a stage; an exception of a plugin fails the stage and not the run."""
    watch = Stopwatch()

    def work() -> Done | supervisor.BatchDone:
        _check_code(job, batch)
        # Artefacts that were read stay in memory: at most 1 GiB, and an eighth of the limit.
        store = _store(job.store, min(2**30, int(0.125 * job.memory_gib * 2**30)))
        store.lost = job.lost
        if not isinstance(job.stage, ItemwiseStage):
            store.progress = lambda fraction: send(supervisor.FractionDone(fraction))
            with unchanged(job.stage):
                result = job.stage.run(store)
            store.put(job.stage.key, result.value, result.seconds, result.histories)
            return Done(result.histories, None, watch.seconds(), result.seconds)
        with unchanged(job.stage):
            if job.stage.key not in _last:
                _last.clear()
                _last[job.stage.key] = job.stage.begin(store)
            items = _last[job.stage.key]
            earlier = {number: items.failed(number, failed) for number, failed in progress.lost.items()} | progress.done
            done = earlier | _done(job, items, batch, send, enter)
            if not batch.ends:
                return supervisor.BatchDone()
            _last.clear()
            value = items.collect([done[number] for number in range(job.stage.items)])
        if job.stage.has_failed(value) and job.stage.packages:
            _failed.append(job.stage.key)
        return Done((), value, watch.seconds())

    try:
        return _guarded(job, work)
    except StorageError as error:
        # Other processes can still write: the fault is one of this process.
        own = (errno.EBADF, errno.EFBIG, errno.EMFILE)
        if isinstance(error.__context__, OSError) and error.__context__.errno in own:
            return Failed(Status.ERROR, f"{error}; a plugin limits or closes the files of its process")
        return Unstored(str(error))
    except _NoMemoryError:
        return supervisor.OutOfMemory(Failed(Status.ERROR, f"{supervisor.OUT_OF_MEMORY} = {job.memory_gib:g}"))


def _check_code(job: Job, batch: Batch) -> None:
    """Refuse a job that was planned with other code than this process has: its artefact would get the wrong key."""
    stage = job.stage
    stages = [stage.stage_of(number) for number in batch.numbers] if isinstance(stage, ItemwiseStage) else [stage]
    # Check every plugin once: stages reach the same ones through many of their inputs.
    used = dict.fromkeys(plugin for one in {one.key: one for one in stages}.values() for plugin in one.plugins)
    changed = [f"the {plugin}" for plugin in used if plugin.as_installed() != plugin]
    if job.code != supervisor.code_here():
        changed.insert(0, "vibench or one of the libraries")
    if changed:
        raise NumericalError(f"{changed[0]} was changed since the run began; run the study again")


# Keys of the stages of other packages that failed in this process, of which it is the last one then.
_failed: list[str] = []

# Items of the stage that this process has begun and not ended, by its key; other processes may do batches of it.
_last: dict[str, Items] = {}


def _done(job: Job, items: Items, batch: Batch, send: Send, enter: Enter) -> dict[int, Any]:
    done = {}
    for number in batch.numbers:

        @contextmanager
        def time_limit(number: int = number) -> Iterator[None]:
            enter(number, True)
            try:
                yield
            finally:
                enter(number, False)

        enter(number, False)
        value = _guarded(job, partial(items.run_item, number, time_limit))
        done[number] = items.failed(number, value) if isinstance(value, Failed) else value
        send(supervisor.ItemDone(number, done[number]))
    return done


def _guarded(job: Job, work: Callable[[], T]) -> T | Failed:
    """The outcome of some work; what plugins of other packages have changed in this process is put back after it."""
    if not job.stage.packages:
        return _outcome(job.memory_gib, work)
    threads = set(threading.enumerate())
    with put_back() as changed:
        outcome = _outcome(job.memory_gib, work)
    # Threads cannot be put back.
    whole = all(changed.values()) and threads.issuperset(threading.enumerate())
    if isinstance(outcome, Failed) or not whole:
        _failed.append(job.stage.key)
    if isinstance(outcome, Failed) and changed:
        return Failed(outcome.status, f"{outcome.reason}; before that it changed {', '.join(changed)}")
    return outcome


def _outcome(memory_gib: float, work: Callable[[], T]) -> T | Failed:
    try:
        with _memory_limit(memory_gib):
            return work()
    # This process may hold garbage of the failed work: it is replaced.
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
    """Limit the address space inside the block; outside it the worker needs memory for its reply."""
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
def _store(folder: str, cached_bytes: int) -> Store:
    return Store(Path(folder), cached_bytes)


if __name__ == "__main__":
    main()
