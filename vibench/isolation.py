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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from vibench.qp import Status
from vibench.stage import Done, Failed, PiecewiseStage, Stage, Unstored
from vibench.timing import ONE_THREAD

POLL = 0.2
"""Seconds between two looks at the clock."""

GRACE = 2.0
"""Seconds a process is given beyond a limit, for what it does before and after it looks at the clock itself."""


@dataclass(frozen=True)
class Job:
    """A stage to be run: where artefacts are, and what a query and the whole of it may take."""

    store: str
    stage: Stage
    query_seconds: float
    cell_seconds: float
    memory_gib: float


@dataclass(frozen=True)
class Watch:
    """A worker is about to do something in a piece that may hang, or (`on` is false) is back from it."""

    piece: int
    on: bool


@dataclass(frozen=True)
class Finished:
    """A worker has done a piece."""

    piece: int
    value: Any


@dataclass
class Progress:
    """What is known of the pieces of a stage."""

    found: dict[int, Any] = field(default_factory=dict)
    lost: dict[int, Failed] = field(default_factory=dict)


class StoppedError(Exception):
    """The keeper was told to stop."""


class _DeathError(Exception):
    """The worker process ended without an answer, or had to be stopped; with what is to be said about it."""

    def __init__(self, failed: Failed, piece: int | None) -> None:
        super().__init__(failed.reason)
        self.failed, self.piece = failed, piece


class Keeper:
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
            If `close` is called meanwhile.
        """
        progress, deadline, late = Progress(), time.monotonic() + job.cell_seconds, False
        while True:
            try:
                return self._attempt(job, progress, deadline)
            except StoppedError:
                self._kill()
                raise
            except _DeathError as death:
                self._kill()
                if not isinstance(job.stage, PiecewiseStage) or late:
                    return death.failed
                late = time.monotonic() > deadline
                missing = [death.piece] if death.piece is not None else []
                if late:  # one more process may write down what there is
                    deadline = time.monotonic() + job.cell_seconds
                    missing = [k for k in range(job.stage.pieces) if k not in progress.found]
                elif not missing:
                    return death.failed
                for piece in missing:
                    progress.lost.setdefault(piece, death.failed)

    def close(self) -> None:
        """Stop the worker, and `run` if it goes on in another thread."""
        self._stop.set()
        self._kill()

    def _attempt(self, job: Job, progress: Progress, deadline: float) -> Done | Failed | Unstored:
        piece, own, patience = None, float("inf"), job.query_seconds + GRACE
        try:
            connection = self._worker()
            connection.send((job, progress))
            while True:
                if connection.poll(POLL):
                    message = connection.recv()
                    if isinstance(message, Done | Failed | Unstored):
                        return message
                    if isinstance(message, Watch):
                        piece, own = message.piece, time.monotonic() + patience if message.on else float("inf")
                    else:
                        progress.found[message.piece] = message.value
                        piece, own = None, float("inf")
                elif self._stop.is_set():
                    raise StoppedError
                elif time.monotonic() > min(own, deadline):
                    name = "query_seconds" if own < deadline else "cell_seconds"
                    limit = job.query_seconds if own < deadline else job.cell_seconds
                    raise _DeathError(Failed(Status.TIMEOUT, f"stopped after {name} = {limit:g} s"), piece)
        except (EOFError, OSError):  # the other end of the socket is gone
            if self._stop.is_set():
                raise StoppedError from None
            raise _DeathError(Failed(Status.CRASHED, self._obituary()), piece) from None

    def _worker(self) -> Connection:
        """The connection to the worker process, which is started if there is none."""
        if self._connection is None:
            ours, theirs = socket.socketpair()
            with theirs, interrupts_held():
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "vibench.worker", str(theirs.fileno()), str(self._log or os.devnull)],
                    env=_environment(os.environ),
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                )
            self._connection = Connection(ours.detach())
        return self._connection

    def _obituary(self) -> str:
        code = self._process.wait(timeout=10) if self._process is not None else 0
        by = f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"
        return f"the worker process died with {by}"

    def _kill(self) -> None:
        process, connection = self._process, self._connection
        self._process = self._connection = None
        if process is not None:
            process.kill()
            process.wait()
        if connection is not None:
            connection.close()


def _environment(parent: Mapping[str, str]) -> dict[str, str]:
    """One thread for numerical libraries, and the modules this process finds."""
    return {**parent, **ONE_THREAD, "PYTHONPATH": os.pathsep.join(folder for folder in sys.path if folder)}


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Processes started meanwhile never see Ctrl-C: they inherit what is blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
