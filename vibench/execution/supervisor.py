"""Stages in worker processes with hard limits: every job has an outcome, even if its process dies or hangs.

A supervisor runs one job at a time, in a worker process for the packages that the job needs. It follows the reports of
the worker, kills it when a limit is exceeded, and starts another one. A stage with items loses only the current item.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from vibench.execution.forking import Forked, fork_worker, worker_environment
from vibench.guardian import MARK, guarded, kill_marked
from vibench.provenance import libraries, numerical_code
from vibench.qp.status import Status
from vibench.stages.base import Done, Failed, ItemwiseStage, Stage, Unstored

# Prefix of the reason of a job that exceeds the memory limit; the limit follows.
OUT_OF_MEMORY = "out of memory: the limit is memory_gib"


def code_here() -> str:
    """The code of vibench that determines numbers, and the libraries, in this process."""
    return f"{numerical_code()}; {libraries()}"


@dataclass(frozen=True)
class Job:
    """A stage to be run, the folder of artefacts, the limits, `lost` dispensable stages, and the code expected."""

    store: str
    stage: Stage
    query_seconds: float
    cell_seconds: float
    memory_gib: float
    lost: Mapping[str, Failed] = field(default_factory=dict)
    code: str = field(default_factory=code_here)


@dataclass(frozen=True)
class Batch:
    """Work of one process: items of a stage by their numbers, or a stage without items, which may end with it.

    Third-party packages share no process: the items of a stage may need several.
    """

    packages: frozenset[str]
    numbers: tuple[int, ...]
    ends: bool


def batches(stage: Stage, done: Container[int]) -> Iterator[Batch]:
    """The rest of a stage, in the order of its items without those in `done`."""
    if not isinstance(stage, ItemwiseStage):
        yield Batch(stage.packages, (), ends=True)
        return
    left = [number for number in range(stage.items) if number not in done]
    grouped = [(packages, tuple(ks)) for packages, ks in groupby(left, lambda k: stage.stage_of(k).packages)]
    grouped = grouped or [(stage.packages, ())]
    for k, (packages, numbers) in enumerate(grouped, 1):
        yield Batch(packages, numbers, ends=k == len(grouped))


@dataclass
class Progress:
    """Values of the items of a stage that are done, and reasons of those that are lost, by their numbers."""

    done: dict[int, Any] = field(default_factory=dict)
    lost: dict[int, Failed] = field(default_factory=dict)


class CurrentItem:
    """The current item of a worker, in memory shared with its supervisor by an open file of 8 bytes.

    A message would wake the supervisor before and after every query, which takes longer than a small query.
    """

    def __init__(self, file: int) -> None:
        # One number, because it is written at once: count of changes (31 bits), item (31), has a time limit (1).
        self._memory = memoryview(mmap.mmap(file, 8)).cast("q")

    def leave(self) -> None:
        """Reset: the worker is in no item."""
        self._memory[0] = 0

    def enter(self, number: int, *, limited: bool) -> None:
        """Set the item; `limited` inside an operation that has a time limit of its own."""
        # The supervisor sees from the count that an operation has ended, although the next one looks the same.
        changes = (self._memory[0] >> 32) % 2**30 + 1
        self._memory[0] = changes << 32 | number << 1 | limited

    def read(self) -> tuple[int, int | None, bool]:
        """Count of changes, the item, and whether its current operation has a time limit."""
        state = self._memory[0]
        return state >> 32, state % 2**32 >> 1 if state else None, bool(state & 1)


class Begun:
    """The worker has received its job."""


@dataclass(frozen=True)
class FractionDone:
    """The worker has done this fraction of its stage."""

    fraction: float


@dataclass(frozen=True)
class ItemDone:
    """The worker has done an item."""

    number: int
    value: Any


class BatchDone:
    """The worker has done a batch that does not end its stage."""


@dataclass(frozen=True)
class OutOfMemory:
    """The worker has to be replaced: it has no memory left for its work (`failed`) or for another job."""

    failed: Failed | None


class StoppedError(Exception):
    """The supervisor was told to stop."""


class _WorkerLostError(Exception):
    """The worker process ended without an outcome or has to be stopped; without `failed` it is only replaced."""

    def __init__(self, failed: Failed | None) -> None:
        super().__init__()
        self.failed = failed


class _JobState:
    """Reports of workers on a job: finished items, the fraction done, the deadline of the current item."""

    # Seconds of the start of a worker process and its imports; on a busy machine that may exceed the limit of a job.
    start_seconds = 300.0
    # Seconds beyond the limit of a query, for the work before and after the solver.
    grace = 2.0

    def __init__(self, job: Job) -> None:
        self.job, self.progress = job, Progress()
        self.seconds = self.fraction = 0.0
        self.start(Batch(frozenset(), (), ends=False), None)

    def start(self, batch: Batch, current: CurrentItem | None) -> Progress:
        """Begin a batch of the job in a process; returns the values of other processes that it needs."""
        if current is not None:
            current.leave()
        self.batch, self._current = batch, current
        self._last, self._begun, self._starting = time.monotonic(), False, 0.0
        self._changes, self._item_limit = 0, float("inf")
        return self.progress if batch.ends else Progress()

    @property
    def item(self) -> int | None:
        """The current item of the worker, or the last one before it died."""
        number = None if self._current is None else self._current.read()[1]
        return None if number in self.progress.done else number

    def tick(self, limit: float) -> None:
        """Add the seconds since the last call; raises a `_WorkerLostError` beyond a limit, `limit` for the stage."""
        now = time.monotonic()
        # Steps are of bounded length, so that a suspended machine does not exhaust the limits.
        step = min(now - self._last, 1.0)
        self._last = now
        if not self._begun:
            self._starting += step
            if self._starting > self.start_seconds:
                reason = f"no worker process began within {self.start_seconds:g} s"
                raise _WorkerLostError(Failed(Status.CRASHED, reason))
            return
        self.seconds += step
        changes, _, limited = (0, None, False) if self._current is None else self._current.read()
        # An operation has begun or ended since the last call.
        if changes != self._changes:
            self._changes = changes
            self._item_limit = self.seconds + self.job.query_seconds + self.grace if limited else float("inf")
        if self.seconds > limit:
            raise _WorkerLostError(_beyond("cell_seconds", self.job.cell_seconds))
        if self.seconds > self._item_limit:
            raise _WorkerLostError(_beyond("query_seconds", self.job.query_seconds))

    def update(self, message: Any) -> Done | Failed | Unstored | BatchDone | None:
        """Process a message of the worker, which is returned if it is an outcome."""
        match message:
            case Begun():
                self._begun, self._last = True, time.monotonic()
            case FractionDone():
                self.fraction = message.fraction
            case ItemDone():
                self.progress.done[message.number] = message.value
            case OutOfMemory():
                raise _WorkerLostError(message.failed)
            case Done() | Failed() | Unstored() | BatchDone():
                return message
        return None


Process = subprocess.Popen[bytes] | Forked
# The connection to a worker process, the process, the mark of its descendants, and its current item.
_Worker = tuple[Connection, Process, str, CurrentItem]


class Supervisor:
    """Runs stages, one at a time, in worker processes that it starts, monitors and replaces.

    Every set of third-party packages has a process of its own: whatever they do to it concerns no others. The output of
    plugins goes to the file `log`, if any. `environment` has variables of worker processes beside those of this one.
    """

    def __init__(self, log: Path | None = None, environment: Mapping[str, str] | None = None) -> None:
        self._log, self._environment = log, environment or {}
        # The most recently used worker comes last.
        self._workers: OrderedDict[frozenset[str], _Worker] = OrderedDict()
        self._session = 0
        self._state: _JobState | None = None
        self._stop = threading.Event()

    def run(self, job: Job) -> Done | Failed | Unstored:
        """Run a stage until it ends or exceeds its limits; raises a `StoppedError` if `stop` is called meanwhile."""
        # A session is timed in cold processes: caches of earlier ones must not make it faster.
        if job.stage.session > self._session:
            self._kill()
            self._session = job.stage.session
        try:
            return self._run(job)
        except BaseException:
            self._kill()
            raise

    @property
    def fraction_done(self) -> tuple[str, float]:
        """The key of the running stage, and the fraction of it known to be done."""
        state = self._state
        return ("", 0.0) if state is None else (state.job.stage.key, state.fraction)

    def stop(self) -> None:
        """Make `run`, which may be active in another thread, return soon."""
        self._stop.set()

    def close(self) -> None:
        """Stop, and end the worker process."""
        self.stop()
        self._kill()

    def _run(self, job: Job) -> Done | Failed | Unstored:
        state, limit, retried = _JobState(job), job.cell_seconds, False
        self._state = state
        done, lost = state.progress.done, state.progress.lost
        # Idle processes hold memory, each with the imports of its packages: keep the last four.
        while len(self._workers) > 4:
            self._kill(next(iter(self._workers)))
        while True:
            try:
                return self._attempt(state, limit)
            except _WorkerLostError as error:
                self._kill(state.batch.packages)
                if error.failed is None:
                    continue
                if state.item is not None:
                    lost[state.item] = error.failed
                if not isinstance(job.stage, ItemwiseStage) or not (done or lost) or limit > job.cell_seconds:
                    return error.failed
                if state.seconds > job.cell_seconds:
                    # Give up the remaining items, and let another process collect what is done within a second limit.
                    limit += state.seconds
                    for late in set(range(job.stage.items)) - done.keys():
                        lost.setdefault(late, _beyond("cell_seconds", job.cell_seconds))
                elif state.item is None and retried:
                    # Outside any item a process may die by chance once, the second time it is the stage.
                    return error.failed
                retried = retried or state.item is None

    def _attempt(self, state: _JobState, limit: float) -> Done | Failed | Unstored:
        for batch in batches(state.job.stage, state.progress.done.keys() | state.progress.lost.keys()):
            outcome = self._attempt_batch(state, limit, batch)
            if not isinstance(outcome, BatchDone):
                return outcome
        raise AssertionError("the last batch ends the stage")

    def _attempt_batch(self, state: _JobState, limit: float, batch: Batch) -> Done | Failed | Unstored | BatchDone:
        try:
            connection, process, _, current = self._worker(batch.packages)
        except OSError as error:
            return Failed(Status.CRASHED, f"no worker process could be started: {error.strerror}")
        try:
            connection.send((state.job, state.start(batch, current), batch))
            while not self._stop.is_set():
                if connection.poll(0.2):
                    outcome = state.update(connection.recv())
                    if outcome is not None:
                        return outcome
                elif process.poll() is not None:
                    # It is dead, although a child process of it may hold the socket open.
                    raise EOFError
                state.tick(limit)
        # The other end of the socket is closed.
        except (EOFError, OSError):
            if not self._stop.is_set():
                raise _WorkerLostError(Failed(Status.CRASHED, _cause_of_death(process))) from None
        raise StoppedError

    def _worker(self, packages: frozenset[str]) -> _Worker:
        """The worker process of some packages, started if there is none."""
        if packages not in self._workers:
            (ours, theirs), environment = socket.socketpair(), {**worker_environment(), **self._environment}
            # Two interpreters have two orders of sets, which shows whether results of a package depend on it.
            forks = not packages and not self._environment
            with theirs, tempfile.TemporaryFile() as shared:
                shared.truncate(8)
                socket.send_fds(ours, [b"+"], [shared.fileno()])
                current = CurrentItem(shared.fileno())
                process = start_worker(theirs.fileno(), str(self._log or os.devnull), environment, forks=forks)
            self._workers[packages] = Connection(ours.detach()), process, environment[MARK], current
        self._workers.move_to_end(packages)
        return self._workers[packages]

    def _kill(self, *sets: frozenset[str]) -> None:
        for packages in sets or tuple(self._workers):
            if (worker := self._workers.pop(packages, None)) is None:
                continue
            connection, process, mark, _ = worker
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            kill_marked(mark)
            connection.close()


def start_worker(descriptor: int, log: str, environment: Mapping[str, str], *, forks: bool) -> Process:
    """A worker process that serves the other end of a socket; the output of plugins goes to `log`.

    It is a new interpreter unless it is forked, where there is a server.
    """
    if forks:
        with contextlib.suppress(OSError):
            return fork_worker(descriptor, log, environment)
    # It leads its own process group: Ctrl-C on the terminal does not reach it, and children of plugins die with it, as
    # do those in other groups, by their mark.
    options = guarded("vibench.execution.worker", str(descriptor), log, environment=environment)
    return subprocess.Popen(**options, pass_fds=[descriptor])


def _beyond(name: str, limit: float) -> Failed:
    return Failed(Status.TIMEOUT, f"stopped after {name} = {limit:g} s")


def _cause_of_death(process: Process) -> str:
    try:
        return f"the worker process died with {manner_of_death(process.wait(timeout=5.0))}"
    except subprocess.TimeoutExpired:
        return "the worker process closed its connection"


def manner_of_death(code: int) -> str:
    names = {number.value: number.name for number in signal.Signals}
    return f"exit code {code}" if code >= 0 else f"signal {names.get(-code, -code)}"
