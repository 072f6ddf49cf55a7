"""Stages in worker processes with hard limits: whatever becomes of a process, its job has an outcome.

A supervisor owns one worker process and talks to it through a socket. It follows what the worker reports, stops it when
a limit is passed, and starts another one. Of a piecewise stage only the present piece is lost.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from vibench.provenance import NUMERICAL, core_code, libraries
from vibench.qp.status import Status
from vibench.stages.base import Done, Failed, PiecewiseStage, Stage, Unstored
from vibench.timing import KEPT_MEMORY, ONE_THREAD

POLL = 0.2
"""Seconds between two checks of the limits."""

GRACE = 2.0
"""Seconds that a process has beyond the limit of a query, for the work around it."""


def code_here() -> str:
    """The code of vibench that determines numbers, and the libraries, in this process."""
    return f"{core_code(*NUMERICAL)}; {libraries()}"


@dataclass(frozen=True)
class Job:
    """A stage to be run: where artefacts are, the limits of a query and of the stage, and with what code."""

    store: str
    stage: Stage
    query_seconds: float
    cell_seconds: float
    memory_gib: float
    code: str = field(default_factory=code_here)


@dataclass(frozen=True)
class Watch:
    """A worker is in a piece; `on` while it does something that may hang and has a limit of its own."""

    piece: int
    on: bool


@dataclass(frozen=True)
class Finished:
    """A worker has done a piece."""

    piece: int
    value: Any


@dataclass(frozen=True)
class OutOfMemory:
    """A worker has no memory left, for its work (`failed`) or for another job, and has to be replaced."""

    failed: Failed | None


@dataclass
class Progress:
    """The pieces of a stage that are done, and those that are lost."""

    found: dict[int, Any] = field(default_factory=dict)
    lost: dict[int, Failed] = field(default_factory=dict)


class StoppedError(Exception):
    """The supervisor was told to stop."""


class _WorkerLostError(Exception):
    """The worker process ended without an outcome or has to be stopped; without `failed` it is only replaced."""

    def __init__(self, failed: Failed | None) -> None:
        super().__init__()
        self.failed = failed


class _JobState:
    """What workers have reported of a job: its pieces, the present one, and when that one has to be stopped.

    Time counts in small steps: of a night in which the run was suspended only one step counts.
    """

    def __init__(self, job: Job) -> None:
        self.job, self.progress = job, Progress()
        self.seconds, self._last = 0.0, time.monotonic()
        self.begin()

    def begin(self) -> Progress:
        """Another process, or another piece, begins; returns what the process has to know."""
        self.piece: int | None = None
        self.piece_limit = float("inf")
        return self.progress

    def tick(self) -> None:
        """Count the seconds since the last call."""
        now = time.monotonic()
        self.seconds += min(now - self._last, 5.0 * POLL)
        self._last = now

    def update(self, message: Any) -> Done | Failed | Unstored | None:
        """Take in a message of the worker; returns the outcome if it is one."""
        match message:
            case Watch():
                self.piece = message.piece
                self.piece_limit = self.seconds + self.job.query_seconds + GRACE if message.on else float("inf")
            case Finished():
                self.progress.found[message.piece] = message.value
                self.begin()
            case OutOfMemory():
                raise _WorkerLostError(message.failed)
            case Done() | Failed() | Unstored():
                return message
        return None


class Supervisor:
    """Runs stages, one at a time, in a worker process that it starts, watches and replaces.

    Parameters
    ----------
    log
        File that takes what plugins print; `None` to drop it.
    """

    def __init__(self, log: Path | None = None) -> None:
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._stop = threading.Event()

    def run(self, job: Job) -> Done | Failed | Unstored:
        """Run a stage to its end, or to the end of its limits.

        Raises
        ------
        StoppedError
            If `stop` is called meanwhile.
        """
        try:
            return self._run(job)
        except BaseException:
            self._kill()
            raise

    def stop(self) -> None:
        """Let `run`, which may go on in another thread, end soon."""
        self._stop.set()

    def close(self) -> None:
        """Stop, and end the worker process."""
        self.stop()
        self._kill()

    def _run(self, job: Job) -> Done | Failed | Unstored:
        state, limit, retried = _JobState(job), job.cell_seconds, False
        found, lost = state.progress.found, state.progress.lost
        while True:
            try:
                return self._attempt(state, limit)
            except _WorkerLostError as error:
                self._kill()
                if error.failed is None:
                    continue
                if state.piece is not None:
                    lost[state.piece] = error.failed
                if not isinstance(job.stage, PiecewiseStage) or not (found or lost) or limit > job.cell_seconds:
                    return error.failed
                if state.seconds > job.cell_seconds:  # one more process may finish the stage with the pieces there are
                    limit += state.seconds
                    for late in set(range(job.stage.pieces)) - found.keys():
                        lost.setdefault(late, _beyond("cell_seconds", job.cell_seconds))
                elif state.piece is None and retried:  # it dies outside of any piece, again and again
                    return error.failed
                retried = retried or state.piece is None

    def _attempt(self, state: _JobState, limit: float) -> Done | Failed | Unstored:
        """What one process makes of the rest of a stage."""
        job = state.job
        try:
            connection, process = self._worker()
        except OSError as error:
            return Failed(Status.CRASHED, f"no worker process could be started: {error.strerror}")
        try:
            connection.send((job, state.begin()))
            while not self._stop.is_set():
                if connection.poll(POLL):
                    outcome = state.update(connection.recv())
                    if outcome is not None:
                        return outcome
                elif process.poll() is not None:  # a process that it started may hold the socket open
                    raise EOFError
                state.tick()
                if state.seconds > limit:
                    raise _WorkerLostError(_beyond("cell_seconds", job.cell_seconds))
                if state.seconds > state.piece_limit:
                    raise _WorkerLostError(_beyond("query_seconds", job.query_seconds))
        except (EOFError, OSError):  # the other end of the socket is closed
            if not self._stop.is_set():
                raise _WorkerLostError(Failed(Status.CRASHED, _cause_of_death(process))) from None
        raise StoppedError

    def _worker(self) -> tuple[Connection, subprocess.Popen[bytes]]:
        """The worker process, started where there is none, and the connection to it.

        It leads a process group of its own: Ctrl-C on the terminal does not reach it, and what plugins start ends too.
        """
        if self._connection is None or self._process is None:
            ours, theirs = socket.socketpair()
            command = ["-P", "-m", "vibench.execution.worker", str(theirs.fileno()), str(self._log or os.devnull)]
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, *command],
                    env=_environment(os.environ),
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    process_group=0,
                )
            self._connection = Connection(ours.detach())
        return self._connection, self._process

    def _kill(self) -> None:
        process, connection = self._process, self._connection
        self._process = self._connection = None
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        if connection is not None:
            connection.close()


def _beyond(name: str, limit: float) -> Failed:
    return Failed(Status.TIMEOUT, f"stopped after {name} = {limit:g} s")


def _cause_of_death(process: subprocess.Popen[bytes]) -> str:
    try:
        code = process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        return "the worker process closed its connection"
    if code >= 0:
        return f"the worker process died with exit code {code}"
    known = {number.value: number.name for number in signal.Signals}
    return f"the worker process died with signal {known.get(-code, -code)}"


def _environment(parent: Mapping[str, str]) -> dict[str, str]:
    """One thread for numerical libraries, freed memory kept, and the modules that this process finds."""
    path = os.pathsep.join(folder for folder in sys.path if folder)
    return {**parent, **ONE_THREAD, **KEPT_MEMORY, "PYTHONPATH": path}
