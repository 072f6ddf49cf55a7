"""Processes that end with the one that started them, however that died and whatever they are doing.

`python -m vibench.guardian MODULE …` is `python -m MODULE …` in such a process, whose standard input is a pipe.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import runpy
import secrets
import select
import signal
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

# Variable in the environment of a guarded process and of whatever is started in it; its value is unique.
MARK = "VIBENCH_WORKER"
# Environment in which numerical libraries start with one thread.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1")


def new_environment() -> dict[str, str]:
    """The environment of a new process on one thread, with the path of this one and a new `MARK`."""
    path = os.pathsep.join(filter(None, sys.path))
    return os.environ | ONE_THREAD | {MARK: secrets.token_hex(8), "PYTHONPATH": path}


def guarded(module: str, *arguments: str, environment: Mapping[str, str]) -> dict[str, Any]:
    """Arguments of `subprocess.Popen` for a guarded process that runs a module; the environment has a `MARK`."""
    command = [sys.executable, "-P", "-m", __name__, module, *arguments]
    return {"args": command, "env": environment, "stdin": _line(os.getpid())[0], "process_group": 0}


@cache
def _line(process: int) -> tuple[int, int]:  # noqa: ARG001  a forked process has a line of its own
    """A pipe whose writing end only this process has, until it dies."""
    return os.pipe()


def mark() -> None:
    """Show others the `MARK` of this process, which has been forked, in the environment that they see, if any."""
    # On systems with /proc it is in memory between two places, as at the start of the parent.
    stat, entry = Path("/proc/self/stat"), f"{MARK}=".encode()
    if stat.is_file():
        first, end = map(int, stat.read_text().rpartition(")")[2].split()[47:49])
        place = first + ctypes.string_at(first, end - first).index(entry) + len(entry)
        ctypes.memmove(place, os.environ[MARK].encode(), 16)


def fork() -> int:
    """Fork a process that leads a group, has a mark of its own, and ends with this one; as `os.fork`."""
    line = _line(os.getpid())
    if process := os.fork():
        return process
    os.setpgid(0, 0)
    os.close(line[1])
    os.dup2(line[0], 0)
    os.environ[MARK] = f"{os.environ.get(MARK, '')} {os.getpid()}"
    guard()
    return 0


def guard() -> None:
    """Fork a guardian, which kills the group and the descendants of this process once that or its parent has died.

    A thread could not, as plugins may hold the interpreter. Standard input, a pipe from the parent, becomes empty.
    """
    own = os.getpid()
    if os.fork():
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        return
    # Whoever reads what the guarded process writes would wait for this one, too.
    os.closerange(1, os.sysconf("SC_OPEN_MAX"))
    while os.getppid() == own and not select.select([0], [], [], 1.0)[0]:
        pass
    kill_marked(os.environ[MARK])
    os.killpg(0, signal.SIGKILL)


def kill_marked(mark: str) -> None:
    """Kill all processes with this value of `MARK` but the calling one, daemons included, on systems with /proc."""
    entry, found = f"{MARK}={mark}".encode(), True
    # Processes may be started during a search. The number is bounded in case one multiplies for ever.
    for _ in range(100):
        found, searched = False, found
        for folder in Path("/proc").glob("[0-9]*") if searched else ():
            # Processes of others cannot be read; those that have just ended are not there, or have no environment.
            with contextlib.suppress(OSError):
                # Compare whole entries: the mark could be a part of another variable.
                if int(folder.name) != os.getpid() and entry in (folder / "environ").read_bytes().split(b"\0"):
                    found = True
                    os.kill(int(folder.name), signal.SIGKILL)


if __name__ == "__main__":
    guard()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
