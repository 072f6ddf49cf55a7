"""Stages on the workers of a dask cluster, each in a process that a supervisor watches."""

from __future__ import annotations

import contextlib
import secrets
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from vibench.errors import ExecutorError, RequestError, in_a_line
from vibench.execution.executors import Executor, Outcome
from vibench.execution.supervisor import Job, Supervisor, code_here
from vibench.provenance import machine
from vibench.qp.status import Status
from vibench.stages.base import Failed


class Dask(Executor):
    """The workers of a dask cluster, one job at a time on each.

    They must have the same vibench installed and see the folder of the artefacts under the same path. The job of a
    worker that dies is done again by another one, for stages are pure.

    Parameters
    ----------
    scheduler
        Address of the scheduler; `None` for a cluster of processes on this machine, over TCP.
    slots
        How many workers a cluster on this machine gets.
    store
        Folder of the artefacts.

    Raises
    ------
    RequestError
        If dask.distributed is not installed, the scheduler does not answer, or a worker is of no use.
    """

    def __init__(self, scheduler: str | None, slots: int, store: Path) -> None:
        try:
            from distributed import Client, LocalCluster  # noqa: PLC0415  an optional dependency
        except ImportError:
            raise RequestError(
                "the executor 'dask' needs dask.distributed: install vibench with its extra 'cluster'"
            ) from None
        self._token = secrets.token_hex(8)
        self._cluster: Any = None
        if scheduler is None:
            resource_tracker.ensure_running()  # whose start lets Ctrl-C through again
            with _interrupts_held():
                self._cluster = LocalCluster(
                    n_workers=slots,
                    threads_per_worker=1,
                    processes=True,
                    protocol="tcp",
                    dashboard_address="127.0.0.1:0",
                    memory_limit=0,
                    silence_logs="CRITICAL",
                )
        try:
            self._client = Client(self._cluster or scheduler, timeout="10s", set_as_default=False)
        except (OSError, ValueError) as error:
            raise RequestError(f"no dask scheduler answers at '{scheduler}': {error}") from None
        self.slots, self.machines = self._check_workers(store)

    def _check_workers(self, store: Path) -> tuple[int, frozenset[str]]:
        """How many workers there are, and on which machines; refuses those that cannot do the work."""
        token = store / f"{self._token}.part"
        token.touch()
        try:
            found: dict[str, tuple[bool, str, str]] = self._client.run(_describe, str(token))
        except Exception as error:  # noqa: BLE001  whatever a worker without vibench answers
            raise RequestError(f"the dask workers cannot run vibench: {in_a_line(error)}") from None
        finally:
            token.unlink()
        if not found:
            raise RequestError("the dask cluster has no workers")
        for address, (sees, code, _) in found.items():
            if not sees:
                raise RequestError(f"the dask worker {address} does not see the artefacts in '{store}'")
            if code != code_here():
                raise RequestError(f"the dask worker {address} has other code: {code} instead of {code_here()}")
        return len(found), frozenset(where for _, _, where in found.values())

    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a job on a worker."""
        result: Future[Outcome] = Future()
        theirs = self._client.submit(_run_for, self._token, job, pure=False)
        theirs.add_done_callback(lambda done: _hand_over(done, result))
        return result

    def check(self) -> None:
        """The scheduler answers."""
        if self._client.status != "running":
            raise ExecutorError("the dask scheduler is gone; the same command goes on from here")

    def close(self) -> None:
        """End the jobs, leave the cluster as it was found, and end it if it is ours."""
        with contextlib.suppress(Exception):  # a cluster that is gone has nothing to be ended
            if self._client.status == "running":
                self._client.run(_dismiss, self._token)
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Processes started meanwhile never see Ctrl-C: they inherit what is blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _hand_over(theirs: Any, ours: Future[Outcome]) -> None:
    """Give the end of a dask future to one of the standard library's, for which `concurrent.futures.wait` works."""
    try:
        ours.set_result(theirs.result())
    except BaseException as error:  # noqa: BLE001  in a thread of dask's: whoever waits has to hear of it
        line = in_a_line(error)
        if type(error).__name__ == "KilledWorker":
            ours.set_result(Failed(Status.CRASHED, f"dask gave up on it: {line}"))
        else:
            ours.set_exception(ExecutorError(f"the dask cluster was lost: {line}; the same command goes on from here"))


_supervisors: dict[tuple[str, int], Supervisor] = {}
"""In a dask worker: the supervisors of every run, one per thread."""


def _run_for(token: str, job: Job) -> Outcome:
    """Run a job of a run with the supervisor that this thread of a dask worker has for it."""
    return _supervisors.setdefault((token, threading.get_ident()), Supervisor()).run(job)


def _dismiss(token: str) -> None:
    """End what a dask worker does for a run."""
    for key in [key for key in _supervisors if key[0] == token]:
        _supervisors.pop(key).close()


def _describe(token: str) -> tuple[bool, str, str]:
    """What a run wants to know of a dask worker: whether it sees a file, its code, its machine."""
    return Path(token).exists(), code_here(), machine()
