"""Stages in a process of their own, with hard limits: whatever becomes of the process, there is an answer.

A keeper owns one worker process and talks to it through a socket. It follows what the worker announces, stops it where
a limit is passed, and starts another one. Of a piecewise stage only the piece in hand is lost.
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

from vibench.provenance import core_code, libraries
from vibench.qp.status import Status
from vibench.stages.base import Done, Failed, PiecewiseStage, Stage, Unstored
from vibench.timing import KEPT_MEMORY, ONE_THREAD

POLL = 0.2
"""Seconds between two looks at the clock."""

GRACE = 2.0
"""Seconds a process is given beyond the limit of a query, for what it does around it."""


def code_here() -> str:
    """The code of vibench and of the libraries in this process."""
    return f"{core_code()}; {libraries()}"


@dataclass(frozen=True)
class Job:
    """A stage to be run: where artefacts are, what a query and the whole of it may take, and with what code."""

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
class Spent:
    """A worker has no memory left: for what it did (`failed`), or for anything new. It wants to be replaced."""

    failed: Failed | None


@dataclass
class Progress:
    """What is known of the pieces of a stage."""

    found: dict[int, Any] = field(default_factory=dict)
    lost: dict[int, Failed] = field(default_factory=dict)


class StoppedError(Exception):
    """The keeper was told to stop."""


class _DeathError(Exception):
    """The worker process ended without an answer, or has to be stopped; with what is to be said about it."""

    def __init__(self, failed: Failed | None) -> None:
        super().__init__()
        self.failed = failed


class _Clock:
    """Seconds of a job that went by while somebody looked: a night in which the run was suspended is one look."""

    def __init__(self) -> None:
        self.seconds, self._last = 0.0, time.monotonic()

    def tick(self) -> float:
        """Look at the clock; gives the seconds so far."""
        now = time.monotonic()
        self.seconds += min(now - self._last, 5.0 * POLL)
        self._last = now
        return self.seconds


class _Talk:
    """What workers have said of a job so far: its pieces, the one in hand, and when that one has to be stopped."""

    def __init__(self, job: Job) -> None:
        self.job, self.progress, self.clock = job, Progress(), _Clock()
        self.begin()

    def begin(self) -> Progress:
        """Another process begins; gives what it has to know."""
        self.piece: int | None = None
        self.own_limit = float("inf")
        return self.progress

    def hear(self, message: Any) -> Done | Failed | Unstored | None:
        """Take a message of the worker in; gives the last one."""
        match message:
            case Watch():
                self.piece = message.piece
                self.own_limit = self.clock.seconds + self.job.query_seconds + GRACE if message.on else float("inf")
            case Finished():
                self.progress.found[message.piece] = message.value
                self.begin()
            case Spent():
                raise _DeathError(message.failed)
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
        talk, limit, retried = _Talk(job), job.cell_seconds, False
        found, lost = talk.progress.found, talk.progress.lost
        while True:
            try:
                return self._attempt(talk, limit)
            except _DeathError as death:
                self._kill()
                if death.failed is None:  # it only had to be replaced
                    continue
                if talk.piece is not None:
                    lost[talk.piece] = death.failed
                if not isinstance(job.stage, PiecewiseStage) or not (found or lost) or limit > job.cell_seconds:
                    return death.failed
                if talk.clock.seconds > job.cell_seconds:  # one more process may write down what there is
                    limit += talk.clock.seconds
                    for late in set(range(job.stage.pieces)) - found.keys():
                        lost.setdefault(late, _beyond("cell_seconds", job.cell_seconds))
                elif talk.piece is None and retried:
                    return death.failed
                retried = retried or talk.piece is None

    def _attempt(self, talk: _Talk, limit: float) -> Done | Failed | Unstored:
        """One process's try at what is left of a stage."""
        job = talk.job
        try:
            connection, process = self._worker()
        except OSError as error:
            return Failed(Status.CRASHED, f"no worker process could be started: {error.strerror}")
        try:
            connection.send((job, talk.begin()))
            while not self._stop.is_set():
                if connection.poll(POLL):
                    answer = talk.hear(connection.recv())
                    if answer is not None:
                        return answer
                elif process.poll() is not None:  # what it left behind may hold the socket open
                    raise EOFError
                if talk.clock.tick() > limit:
                    raise _DeathError(_beyond("cell_seconds", job.cell_seconds))
                if talk.clock.seconds > talk.own_limit:
                    raise _DeathError(_beyond("query_seconds", job.query_seconds))
        except (EOFError, OSError):  # the other end of the socket is gone
            if not self._stop.is_set():
                raise _DeathError(Failed(Status.CRASHED, _obituary(process))) from None
        raise StoppedError

    def _worker(self) -> tuple[Connection, subprocess.Popen[bytes]]:
        """The worker process, which is started if there is none, and the connection to it.

        It leads a group of its own: Ctrl-C on the terminal is not for it, and what plugins start ends with it.
        """
        if self._connection is None or self._process is None:
            ours, theirs = socket.socketpair()
            with theirs:
                self._process = subprocess.Popen(
                    [
                        sys.executable,
                        "-P",
                        "-m",
                        "vibench.execution.worker",
                        str(theirs.fileno()),
                        str(self._log or os.devnull),
                    ],
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


def _obituary(process: subprocess.Popen[bytes]) -> str:
    """What a process that hung up died of."""
    try:
        code = process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        return "the worker process hung up"
    if code >= 0:
        return f"the worker process died with exit code {code}"
    known = {number.value: number.name for number in signal.Signals}
    return f"the worker process died with signal {known.get(-code, -code)}"


def _environment(parent: Mapping[str, str]) -> dict[str, str]:
    """One thread for numerical libraries, memory that is kept, and the modules this process finds."""
    path = os.pathsep.join(folder for folder in sys.path if folder)
    return {**parent, **ONE_THREAD, **KEPT_MEMORY, "PYTHONPATH": path}
