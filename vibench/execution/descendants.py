"""Processes that plugins start: they are found by a mark in their environment, wherever they have gone."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

MARK = "VIBENCH_WORKER"
"""Variable in the environment of a worker process and of whatever is started in it; its value is unique."""

PASSES = 100
"""Searches for processes that were started during the one before."""


def kill_marked(mark: str) -> None:
    """Kill all processes with this value of `MARK` but the calling one.

    A process that became a daemon is in no group or session of the worker, and after the worker's death not among its
    children. Systems without /proc do not tell the environment of a process: only its group ends with a worker there.
    """
    for _ in range(PASSES):
        found = list(_marked(mark))
        if not found:
            return
        for process in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)


def _marked(mark: str) -> Iterator[int]:
    entry = f"{MARK}={mark}".encode()
    for folder in Path("/proc").glob("[0-9]*"):
        # Processes of others cannot be read; those that have just ended are not there, or have no environment.
        with contextlib.suppress(OSError):
            if int(folder.name) != os.getpid() and entry in (folder / "environ").read_bytes().split(b"\0"):
                yield int(folder.name)
