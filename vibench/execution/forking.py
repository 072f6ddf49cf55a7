"""Worker processes forked from a server that has imported what all of them need, and has seen no problem.

The imports of a process take more than a second, a fork takes milliseconds. Only Linux has a server: the libraries of
macOS do not survive a fork.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import pickle
import selectors
import signal
import socket
import struct
import subprocess
import sys
import traceback
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from multiprocessing.connection import wait
from pathlib import Path
from pkgutil import iter_modules

import numpy as np

from vibench import guardian, stages
from vibench.errors import UnsupportedError
from vibench.qp.solve import load_qpsolvers


class Forked:
    """A process that a server has forked; what `subprocess.Popen` is to a supervisor.

    Over `status` the server tells its id, and its exit code in the end. Raises an `OSError` if it tells no id.
    """

    def __init__(self, status: socket.socket) -> None:
        self.returncode: int | None = None
        self._status = status
        if (pid := self._number()) < 0:
            raise BrokenPipeError("the server has ended")
        self.pid = pid

    def _number(self) -> int:
        # Of a server that was killed nothing is heard; its processes are given up.
        content = self._status.recv(8)
        return int(struct.unpack("q", content)[0]) if content else -signal.SIGKILL

    def poll(self) -> int | None:
        """The exit code, `None` while the process runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """The exit code; raises a `TimeoutExpired` if the process does not end within so many seconds."""
        if self.returncode is None:
            if not wait([self._status], timeout):
                raise subprocess.TimeoutExpired("a forked process", timeout or 0.0)
            self.returncode = self._number()
            self._status.close()
        return self.returncode


def fork_worker(descriptor: int, log: str, environment: Mapping[str, str]) -> Forked:
    """A worker process, forked by the server of this process; raises an `OSError` where there is none."""
    if not hasattr(os, "pidfd_open"):
        raise OSError("this system has no files for processes")
    server, (ours, theirs) = _server(os.getpid()), socket.socketpair()
    try:
        with theirs:
            request = str(Path.cwd()), sys.path, log, dict(environment)
            socket.send_fds(server, [pickle.dumps(request)], [theirs.fileno(), descriptor])
        # A server may have to wait for a disk, as a new interpreter does.
        ours.settimeout(100.0)
        return Forked(ours)
    except OSError:
        ours.close()
        raise


def worker_environment() -> dict[str, str]:
    """The environment of a worker process, which keeps freed memory."""
    # With these (bytes) glibc keeps up to 1 GiB of it: large arrays are not mapped anew page by page.
    memory = {"MMAP_THRESHOLD": "33554432", "TRIM_THRESHOLD": "1073741824", "TOP_PAD": "67108864"}
    return guardian.new_environment() | {f"MALLOC_{name}_": size for name, size in memory.items()}


@cache
def _server(process: int) -> socket.socket:
    """The server of a process; one that is forked starts its own."""
    # One message of such a socket is one request.
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    options = guardian.guarded(__name__, str(theirs.fileno()), environment=worker_environment())
    # It needs no guardian, and leaves the pipe to its processes: nothing in it could keep it from ending.
    options["args"].remove(guardian.__name__)
    with theirs:
        server = subprocess.Popen(**options, pass_fds=[theirs.fileno()])

    def end() -> None:
        if os.getpid() == process:
            ours.shutdown(socket.SHUT_RDWR)
            server.wait()

    atexit.register(end)
    return ours


def main() -> None:
    """Fork a process for every request, until the parent of the server or the other end of its socket has ended."""
    requests, parent = socket.socket(fileno=int(sys.argv[1])), os.getppid()
    import_module("vibench.execution.worker")
    for module in iter_modules(stages.__path__, f"{stages.__name__}."):
        import_module(module.name)
    with contextlib.suppress(UnsupportedError):
        load_qpsolvers()
    # Collections in the processes leave alone what they share.
    gc.freeze()
    ready = selectors.DefaultSelector()
    ready.register(requests, selectors.EVENT_READ)
    while os.getppid() == parent:
        for key, _ in ready.select(1.0):
            if key.data is not None:
                process, client = key.data
                ready.unregister(key.fd)
                os.close(key.fd)
                number = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
            else:
                content, files, *_ = socket.recv_fds(requests, 2**20, 2)
                if not content:
                    return
                client, number = socket.socket(fileno=files[0]), _forked(content, files[1])
                ready.register(os.pidfd_open(number), selectors.EVENT_READ, (number, client))
            with contextlib.suppress(OSError):
                client.sendall(struct.pack("q", number))
            if key.data is not None:
                client.close()


def _forked(content: bytes, connection: int) -> int:
    """Fork a worker process, which serves the other end of a connection; returns its number."""
    if process := os.fork():
        # It leads a group of its own, whoever is first to say so.
        with contextlib.suppress(PermissionError, ProcessLookupError):
            os.setpgid(process, process)
        os.close(connection)
        return process
    try:
        os.setpgid(0, 0)
        # Whoever waits for the end of the server would wait for this process, too.
        os.dup2(connection, 3)
        os.closerange(4, os.sysconf("SC_OPEN_MAX"))
        # Numbers drawn without a seed must not be those of the next process.
        np.random.seed()  # noqa: NPY002  plugins may use the old generator
        folder, sys.path[:], log, environment = pickle.loads(content)
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        guardian.mark()
        guardian.guard()
        sys.argv[1:] = ["3", log]
        import_module("vibench.execution.worker").main()
        os._exit(0)
    except BaseException:  # noqa: BLE001  as an interpreter prints it
        traceback.print_exc()
    finally:
        os._exit(1)


if __name__ == "__main__":
    main()
