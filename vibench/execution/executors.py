"""Executors run stages: in worker processes of this machine, or in such processes on the workers of a dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import resource
import secrets
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeAlias

from vibench import interrupts
from vibench.errors import ExecutorError, RequestError, foreign, in_a_line
from vibench.execution.supervisor import Job, Supervisor, code_here
from vibench.provenance import machine
from vibench.qp.status import Status
from vibench.stages.base import Done, Failed, Unstored

StageOutcome: TypeAlias = Done | Failed | Unstored


class Executor(ABC):
    """Runs jobs, at most `slots` at a time, on some `machines`."""

    slots: int
    machines: frozenset[str]

    @abstractmethod
    def submit(self, job: Job) -> Future[StageOutcome]:
        """Begin a job."""

    def fractions_done(self) -> Mapping[str, float]:
        """Fractions of running stages that are done, by their keys, where they are known."""
        return {}

    def check(self) -> None:  # noqa: B027  nothing to check where jobs run in our own threads
        """Raise an `ExecutorError` if the processes that run the submitted jobs were lost."""

    @abstractmethod
    def close(self) -> None:
        """Stop all jobs."""


class Local(Executor):
    """Worker processes on this machine; the output of plugins goes to the file `log`."""

    def __init__(self, slots: int, log: Path) -> None:
        self.slots, self.machines = slots, frozenset({machine()})
        self._log = log
        self._supervisors = [Supervisor(log) for _ in range(slots)]
        self._free: SimpleQueue[Supervisor] = SimpleQueue()
        for supervisor in self._supervisors:
            self._free.put(supervisor)
        self._threads = ThreadPoolExecutor(slots)

    def submit(self, job: Job) -> Future[StageOutcome]:
        return self._threads.submit(self._run, job)

    def _run(self, job: Job) -> StageOutcome:
        supervisor = self._free.get()
        try:
            return supervisor.run(job)
        finally:
            self._free.put(supervisor)

    def fractions_done(self) -> Mapping[str, float]:
        return dict(supervisor.fraction_done for supervisor in self._supervisors)

    def close(self) -> None:
        # Stop them first: `shutdown` waits for running jobs.
        for supervisor in self._supervisors:
            supervisor.stop()
        self._threads.shutdown(cancel_futures=True)
        for supervisor in self._supervisors:
            supervisor.close()
        if self._log.is_file() and not self._log.stat().st_size:
            self._log.unlink()


class Dask(Executor):
    """The workers of a dask cluster, one job at a time on each.

    They must have the same vibench installed and see the folder of the artefacts, `store`, under the same path. Another
    worker repeats the job of a worker that dies. Without a `scheduler`, a cluster of `slots` processes on this machine
    is started, with temporary credentials for TLS; those for a scheduler tls://… come from the configuration of dask.

    Raises a `RequestError` if dask cannot be used, does not answer, or has a worker that cannot run the jobs.
    """

    def __init__(self, scheduler: str | None, slots: int, store: Path) -> None:
        needs = "the executor 'dask' needs dask.distributed and cryptography, of vibench's extra 'cluster'"
        with foreign(needs, RequestError):
            from distributed import Client, LocalCluster  # noqa: PLC0415  an optional dependency
            from distributed.security import Security  # noqa: PLC0415

            # Anybody who can connect to a scheduler can run code on its workers: keep out other users of this machine.
            own = Security.temporary() if scheduler is None else None
        credentials = Security().get_connection_args("client")
        if scheduler is not None and is_authenticated(scheduler) and credentials["ssl_context"] is None:
            raise RequestError(f"the scheduler '{scheduler}' asks for credentials: set distributed.comm.tls of dask")
        _allow_open_files(slots if scheduler is None else 0)
        if scheduler is not None:
            _greet(scheduler, 10.0)
        self._token = secrets.token_hex(8)
        self._cluster: Any = None
        if scheduler is None:
            with foreign("dask cannot start its workers", RequestError), interrupts.held():
                self._cluster = LocalCluster(
                    n_workers=slots, threads_per_worker=1, processes=True, host="127.0.0.1", protocol="tls",
                    security=own, dashboard_address="127.0.0.1:0", memory_limit=0, silence_logs="CRITICAL",
                )  # fmt: skip
        with foreign(f"no dask scheduler answers at '{scheduler}'", RequestError):
            self._client = Client(self._cluster or scheduler, timeout="10s", set_as_default=False)
        self.slots, self.machines = self._check_workers(store)

    def _check_workers(self, store: Path) -> tuple[int, frozenset[str]]:
        """Number of workers and their machines; refuses workers with other code or without access to the artefacts."""
        token = store / f"{self._token}.part"
        token.touch()
        try:
            with foreign("the dask workers cannot run vibench", RequestError):
                workers: dict[str, tuple[bool, str, str]] = self._client.run(_describe, str(token))
        finally:
            token.unlink()
        if not workers:
            raise RequestError("the dask cluster has no workers")
        for address, (sees, code, _) in workers.items():
            if not sees:
                raise RequestError(f"the dask worker {address} does not see the artefacts in '{store}'")
            if code != code_here():
                raise RequestError(f"the dask worker {address} has other code: {code} instead of {code_here()}")
        return len(workers), frozenset(where for _, _, where in workers.values())

    def submit(self, job: Job) -> Future[StageOutcome]:
        result: Future[StageOutcome] = Future()
        # Not pure: dask would return an earlier result for an equal job.
        theirs = self._client.submit(_run_for, self._token, job, pure=False)
        theirs.add_done_callback(lambda done: _hand_over(done, result))
        return result

    def check(self) -> None:
        if self._client.status != "running":
            raise ExecutorError("the dask scheduler is not connected any more; run the same command again to continue")

    def close(self) -> None:
        # A cluster that was lost has no jobs to end.
        with contextlib.suppress(Exception):
            if self._client.status == "running":
                self._client.run(_dismiss, self._token)
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()


def _greet(scheduler: str, seconds: float) -> None:
    """Shake hands with a scheduler: a client would wait for ever for an answer, and trust any size it receives."""
    from distributed.comm.core import connect  # noqa: PLC0415
    from distributed.security import Security  # noqa: PLC0415

    async def greet() -> None:
        credentials = Security().get_connection_args("client")
        (await asyncio.wait_for(connect(scheduler, timeout=seconds, **credentials), seconds)).abort()

    # In another thread: a notebook has an event loop in this one.
    with ThreadPoolExecutor(1) as other:
        try:
            other.submit(lambda: asyncio.run(greet())).result()
        except Exception as error:  # noqa: BLE001  whatever answers may say anything
            why = f"nothing within {seconds:g} s" if isinstance(error, TimeoutError) else in_a_line(error)
            raise RequestError(f"no dask scheduler answers at '{scheduler}': {why}") from None


def _allow_open_files(workers: int) -> None:
    """Raise the soft limit of open files as far as a cluster needs it: below that, dask retries for ever."""
    # /proc shows about 30 files and sockets of a cluster, and 11 for each worker.
    needed = 64 + workers * 16
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    if hard != resource.RLIM_INFINITY and hard < needed:
        remedy = f"raise it (`ulimit -n {needed}`), ask for fewer --jobs, or use the executor 'local'"
        raise RequestError(f"the executor 'dask' needs {needed} open files, the limit is {hard}: {remedy}")
    resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))


def is_authenticated(scheduler: str) -> bool:
    return scheduler.startswith(("tls://", "wss://"))


def _hand_over(theirs: Any, ours: Future[StageOutcome]) -> None:
    """Pass the result of a dask future that is done to a standard one, which `concurrent.futures.wait` needs."""
    while not ours.done():
        try:
            # A client that closes never answers: do not block the thread of the callbacks of all clients.
            ours.set_result(theirs.result(timeout=5.0))
        except BaseException as error:  # noqa: BLE001  this thread is dask's: pass it to the waiting thread
            # A `TimeoutError` may be the job's own.
            if isinstance(error, TimeoutError) and theirs.status != "error" and theirs.client.status == "running":
                continue
            line = in_a_line(error)
            # The job has killed several workers in turn: it fails, and the run goes on.
            if type(error).__name__ == "KilledWorker":
                ours.set_result(Failed(Status.CRASHED, f"dask does not repeat the job again: {line}"))
            else:
                why = f"the dask cluster was lost: {line}; run the same command again to continue"
                ours.set_exception(ExecutorError(why))


_supervisors: dict[tuple[str, int], Supervisor] = {}
"""Supervisors of a dask worker, by the token of a run and the thread."""


def _run_for(token: str, job: Job) -> StageOutcome:
    return _supervisors.setdefault((token, threading.get_ident()), Supervisor()).run(job)


def _dismiss(token: str) -> None:
    for key in [key for key in _supervisors if key[0] == token]:
        _supervisors.pop(key).close()


def _describe(token: str) -> tuple[bool, str, str]:
    """Describe a dask worker: whether it sees a file, its code, its machine."""
    return Path(token).exists(), code_here(), machine()
