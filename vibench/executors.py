"""Where stages run: on this machine, or on the workers of a dask cluster; each in a process that a keeper watches."""

from __future__ import annotations

import secrets
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from vibench.errors import RequestError
from vibench.isolation import Job, Keeper, interrupts_held
from vibench.provenance import core_code, machine
from vibench.stage import Done, Failed, Unstored

Outcome = Done | Failed | Unstored

_of_thread = threading.local()


class Executor(ABC):
    """Runs jobs, `slots` of them at a time."""

    slots: int
    """How many jobs run at a time."""
    machines: frozenset[str]
    """The machines they run on."""

    @abstractmethod
    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a job."""

    @abstractmethod
    def close(self) -> None:
        """Stop whatever still runs."""


class Local(Executor):
    """Worker processes on this machine.

    Parameters
    ----------
    slots
        How many.
    log
        File that takes what plugins print.
    """

    def __init__(self, slots: int, log: Path) -> None:
        self.slots, self.machines = slots, frozenset({machine()})
        self._log = log
        self._keepers: list[Keeper] = []
        self._threads = ThreadPoolExecutor(slots, initializer=self._initialise)

    def _initialise(self) -> None:
        _of_thread.keeper = Keeper(self._log)
        self._keepers.append(_of_thread.keeper)

    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a job in a worker process that is free."""
        return self._threads.submit(_run, job)

    def close(self) -> None:
        """End the worker processes."""
        for keeper in self._keepers:
            keeper.close()
        self._threads.shutdown(cancel_futures=True)
        if self._log.is_file() and not self._log.stat().st_size:
            self._log.unlink()


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
        self._cluster: Any = None
        if scheduler is None:
            resource_tracker.ensure_running()  # whose start lets Ctrl-C through again
            with interrupts_held():
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
        self.slots, self.machines = self._check(store)

    def _check(self, store: Path) -> tuple[int, frozenset[str]]:
        """How many workers there are, and on which machines; refuses those that cannot do the work."""
        token = store / f"{secrets.token_hex(8)}.part"
        token.touch()
        try:
            found: dict[str, tuple[bool, str, str]] = self._client.run(_describe, str(token))
        except Exception as error:  # noqa: BLE001  whatever a worker without vibench answers
            raise RequestError(f"the dask workers cannot run vibench: {type(error).__name__}: {error}") from None
        finally:
            token.unlink()
        if not found:
            raise RequestError("the dask cluster has no workers")
        for address, (sees, code, _) in found.items():
            if not sees:
                raise RequestError(f"the dask worker {address} does not see the artefacts in '{store}'")
            if code != core_code():
                raise RequestError(f"the dask worker {address} has another vibench: {code} instead of {core_code()}")
        return len(found), frozenset(where for _, _, where in found.values())

    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a job on a worker."""
        result: Future[Outcome] = Future()
        theirs = self._client.submit(_run_alone, job, pure=False)
        theirs.add_done_callback(lambda done: _hand_over(done, result))
        return result

    def close(self) -> None:
        """Leave the cluster, and end it if it is ours."""
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()


def _hand_over(theirs: Any, ours: Future[Outcome]) -> None:
    """Give the result of a dask future to one of the standard library's, for which `concurrent.futures.wait` works."""
    if theirs.cancelled():
        ours.cancel()
    elif (error := theirs.exception()) is not None:
        ours.set_exception(error)
    else:
        ours.set_result(theirs.result())


def _run(job: Job) -> Outcome:
    """Run a job with the keeper of this thread."""
    keeper: Keeper = _of_thread.keeper
    return keeper.run(job)


def _run_alone(job: Job) -> Outcome:
    """Run a job with the keeper of this dask worker."""
    if not hasattr(_of_thread, "keeper"):
        _of_thread.keeper = Keeper()
    return _run(job)


def _describe(token: str) -> tuple[bool, str, str]:
    """What a run wants to know of a dask worker: whether it sees a file, its code, its machine."""
    return Path(token).exists(), core_code(), machine()


def executor(name: str, scheduler: str | None, slots: int, store: Path, log: Path) -> Executor:
    """The executor a run asks for: "local", or "dask" with the address of a scheduler or `None`."""
    makers: dict[str, Callable[[], Executor]] = {
        "local": lambda: Local(slots, log),
        "dask": lambda: Dask(scheduler, slots, store),
    }
    return makers[name]()
