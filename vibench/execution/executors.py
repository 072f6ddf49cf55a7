"""Executors run stages: here the interface and the worker processes of this machine; `dask` has the other one."""

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
        """Check that submitted jobs can still finish.

        Raises
        ------
        ExecutorError
            If the processes that run them were lost.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop all jobs."""


class Local(Executor):
    """Worker processes on this machine.

    Parameters
    ----------
    slots
        Number of worker processes.
    log
        File for the output of plugins.
    """

    def __init__(self, slots: int, log: Path) -> None:
        self.slots, self.machines = slots, frozenset({machine()})
        self._log = log
        self._supervisors = [Supervisor(log) for _ in range(slots)]
        self._free: SimpleQueue[Supervisor] = SimpleQueue()
        for supervisor in self._supervisors:
            self._free.put(supervisor)
        self._threads = ThreadPoolExecutor(slots)

    def submit(self, job: Job) -> Future[Outcome]:
        """Begin a job in a worker process that is free."""
        return self._threads.submit(self._run, job)

    def _run(self, job: Job) -> Outcome:
        supervisor = self._free.get()
        try:
            return supervisor.run(job)
        finally:
            self._free.put(supervisor)

    def close(self) -> None:
        """End the worker processes."""
        for supervisor in self._supervisors:  # stopped first, because `shutdown` waits for running jobs
            supervisor.stop()
        self._threads.shutdown(cancel_futures=True)
        for supervisor in self._supervisors:
            supervisor.close()
        if self._log.is_file() and not self._log.stat().st_size:
            self._log.unlink()
