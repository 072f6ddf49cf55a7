"""Where stages run: on this machine, or on the workers of a dask cluster; each in a process that a keeper watches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

from vibench.execution.supervisor import Job, Supervisor
from vibench.provenance import machine
from vibench.stages.base import Done, Failed, Unstored

Outcome = Done | Failed | Unstored


class Executor(ABC):
    """Runs jobs, `slots` of them at a time."""

    slots: int
    """How many jobs run at a time."""
    machines: frozenset[str]
    """The machines they run on."""

    @abstractmethod
    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a job."""

    def check(self) -> None:  # noqa: B027  nothing to check where jobs run in our own threads
        """Make sure that jobs can still end.

        Raises
        ------
        ExecutorError
            If whoever runs them is gone.
        """

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
        self._keepers = [Supervisor(log) for _ in range(slots)]
        self._free: SimpleQueue[Supervisor] = SimpleQueue()
        for keeper in self._keepers:
            self._free.put(keeper)
        self._threads = ThreadPoolExecutor(slots)

    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a job in a worker process that is free."""
        return self._threads.submit(self._run, job)

    def _run(self, job: Job) -> Outcome:
        keeper = self._free.get()
        try:
            return keeper.run(job)
        finally:
            self._free.put(keeper)

    def close(self) -> None:
        """End the worker processes."""
        for keeper in self._keepers:
            keeper.stop()
        self._threads.shutdown(cancel_futures=True)
        for keeper in self._keepers:
            keeper.close()
        if self._log.is_file() and not self._log.stat().st_size:
            self._log.unlink()
