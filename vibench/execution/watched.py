"""Work of plugins outside studies, item by item in a watched process; what ends the process costs itself alone."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from vibench.execution.jobs import Job
from vibench.execution.supervisor import Supervisor
from vibench.qp.status import Status
from vibench.stages.base import Done, Failed, Items, ItemwiseStage
from vibench.storage.artefacts import Store
from vibench.study.spec import Limits


@dataclass(frozen=True)
class WatchedWork(ItemwiseStage, Items):
    """Items of work; a subclass says how many `items` there are, and how one is done.

    It is sent to the process that does the items; what they share is a cached property there.
    """

    label = "work"

    @abstractmethod
    def do(self, number: int, done: Mapping[int, Any]) -> Any:
        """The value of an item; `done` has those of the items before it, also where another process did them."""

    def instead(self, number: int, failed: Failed) -> Any:  # noqa: ARG002
        """The value of an item that raised an exception, exceeded its time limit or ended the process."""
        return failed

    @cached_property
    def _done(self) -> dict[int, Any]:
        return {}

    def begin(self, store: Store) -> Items:  # noqa: ARG002
        """Nothing to prepare."""
        return self

    def resume(self, done: Mapping[int, tuple[int, Any]]) -> None:
        """Keep the values of the items that another process did."""
        self._done.update(done.values())

    def item(self, number: int, watch: Callable[[bool], None]) -> tuple[int, Any]:
        """Do an item under its time limit; gives its number and value."""
        watch(True)
        self._done[number] = self.do(number, self._done)
        return number, self._done[number]

    def lost(self, number: int, failed: Failed) -> tuple[int, Any]:
        """Keep what stands for the value of an item that failed; gives its number and that."""
        self._done[number] = self.instead(number, failed)
        return number, self._done[number]

    def finish(self, items: Sequence[tuple[int, Any]]) -> list[Any]:
        """The values of all items."""
        return [value for _, value in items]


def watched(
    work: WatchedWork,
    seconds: float,
    observe: Callable[[Any], None] = lambda _: None,
    *,
    in_all: float | None = None,
    supervisor: Supervisor | None = None,
) -> list[Any] | Failed:
    """Do work in a watched process.

    Parameters
    ----------
    work
        The work.
    seconds
        Time limit of an item; wall seconds.
    observe
        Gets the values of items as soon as they are there; those of items that ended the process come last.
    in_all
        Time limit of all items together; by default that of an item.
    supervisor
        Whose process to use; by default one that ends with the work.

    Returns
    -------
    list or Failed
        The values of all items, or why none could be done.
    """
    told: set[int] = set()

    def tell(item: tuple[int, Any]) -> None:
        told.add(item[0])
        observe(item[1])

    job = Job("", work, seconds, max(in_all or seconds, 1.0), Limits().memory_gib)
    if supervisor is None:
        with closing(Supervisor()) as own:
            answer = own.run(job, tell)
    else:
        answer = supervisor.run(job, tell)
    if not isinstance(answer, Done):
        return Failed(answer.status if isinstance(answer, Failed) else Status.ERROR, answer.reason)
    values: list[Any] = answer.value
    for number, value in enumerate(values):
        if number not in told:
            observe(value)
    return values
