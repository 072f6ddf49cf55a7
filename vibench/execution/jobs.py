"""Messages between a supervisor and its worker processes: jobs, the batches they are done in, and reports."""

from __future__ import annotations

import mmap
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

from vibench.provenance import libraries, numerical_code
from vibench.stages.base import Failed, ItemwiseStage, Stage

OUT_OF_MEMORY = "out of memory: the limit is memory_gib"
"""Prefix of the reason of a job that exceeds the memory limit; the limit follows."""


def code_here() -> str:
    """The code of vibench that determines numbers, and the libraries, in this process."""
    return f"{numerical_code()}; {libraries()}"


@dataclass(frozen=True)
class Job:
    """A stage to be run: the folder of artefacts, the limits of a query and of the stage, and the code expected.

    `lost` are dispensable stages that failed, by key.
    """

    store: str
    stage: Stage
    query_seconds: float
    cell_seconds: float
    memory_gib: float
    lost: Mapping[str, Failed] = field(default_factory=dict)
    code: str = field(default_factory=code_here)


@dataclass(frozen=True)
class Batch:
    """Work that one process does in succession: items of a stage by their numbers, or a stage without items.

    Third-party packages share no process: the items of a stage may need several. `ends` is true if the stage ends with
    the batch.
    """

    packages: frozenset[str]
    numbers: tuple[int, ...]
    ends: bool


def batches(stage: Stage, done: Container[int]) -> Iterator[Batch]:
    """The rest of a stage, in the order of its items without those in `done`."""
    if not isinstance(stage, ItemwiseStage):
        yield Batch(stage.packages, (), ends=True)
        return
    left = [number for number in range(stage.items) if number not in done]
    grouped = [(packages, tuple(ks)) for packages, ks in groupby(left, lambda k: stage.stage_of(k).packages)]
    grouped = grouped or [(stage.packages, ())]
    for k, (packages, numbers) in enumerate(grouped, 1):
        yield Batch(packages, numbers, ends=k == len(grouped))


@dataclass
class Progress:
    """Values of the items of a stage that are done, and reasons of those that are lost, by their numbers."""

    done: dict[int, Any] = field(default_factory=dict)
    lost: dict[int, Failed] = field(default_factory=dict)


class CurrentItem:
    """The current item of a worker, in memory shared with its supervisor.

    A message would wake the supervisor before and after every query, which takes longer than a small query.

    `file` is the descriptor of an open file of 8 bytes.
    """

    def __init__(self, file: int) -> None:
        # One number, because it is written at once: count of changes (31 bits), item (31), has a time limit (1).
        self._memory = memoryview(mmap.mmap(file, 8)).cast("q")

    def leave(self) -> None:
        """Reset: the worker is in no item."""
        self._memory[0] = 0

    def enter(self, number: int, *, limited: bool) -> None:
        """Set the item; `limited` inside an operation that has a time limit of its own."""
        # The supervisor sees from the count that an operation has ended, although the next one looks the same.
        changes = (self._memory[0] >> 32) % 2**30 + 1
        self._memory[0] = changes << 32 | number << 1 | limited

    def read(self) -> tuple[int, int | None, bool]:
        """Count of changes, the item, and whether its current operation has a time limit."""
        state = self._memory[0]
        return state >> 32, state % 2**32 >> 1 if state else None, bool(state & 1)


@dataclass(frozen=True)
class Begun:
    """The worker has received its job."""


@dataclass(frozen=True)
class FractionDone:
    """The worker has done this fraction of its stage."""

    fraction: float


@dataclass(frozen=True)
class ItemDone:
    """The worker has done an item."""

    number: int
    value: Any


@dataclass(frozen=True)
class BatchDone:
    """The worker has done a batch that does not end its stage."""


@dataclass(frozen=True)
class OutOfMemory:
    """The worker has to be replaced: it has no memory left for its work (`failed`) or for another job."""

    failed: Failed | None
