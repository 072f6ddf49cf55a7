"""What a supervisor and its worker processes say to each other: jobs, the batches they are done in, and reports."""

from __future__ import annotations

import mmap
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

from vibench.provenance import libraries, numerical_code
from vibench.stages.base import Failed, ItemwiseStage, Stage

OUT_OF_MEMORY = "out of memory: the limit is memory_gib"
"""Beginning of the reason of what a worker has no memory for; the limit follows."""


def code_here() -> str:
    """The code of vibench that determines numbers, and the libraries, in this process."""
    return f"{numerical_code()}; {libraries()}"


@dataclass(frozen=True)
class Job:
    """A stage to be run: where artefacts are, the limits of a query and of the stage, and with what code."""

    store: str
    stage: Stage
    query_seconds: float
    cell_seconds: float
    memory_gib: float
    lost: Mapping[str, Failed] = field(default_factory=dict)
    """Dispensable stages that failed, by key."""
    code: str = field(default_factory=code_here)


@dataclass(frozen=True)
class Batch:
    """What one process does in succession: items of a stage, or a stage that has none.

    Packages of third parties share no process, and the items of a stage may need several.

    Attributes
    ----------
    packages
        Packages whose code it runs.
    numbers
        The items.
    ends
        Whether the stage ends with it.
    """

    packages: frozenset[str]
    numbers: tuple[int, ...]
    ends: bool


def batches(stage: Stage, done: Container[int]) -> Iterator[Batch]:
    """What is left of a stage, in the order of its items; those in `done` are not."""
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
    """The values of the items of a stage that are done, and the items that are lost, by their numbers."""

    done: dict[int, Any] = field(default_factory=dict)
    lost: dict[int, Failed] = field(default_factory=dict)


class CurrentItem:
    """The item that a worker is in, in memory that it shares with its supervisor.

    A message would wake the supervisor before and after every query, which takes longer than a small one.

    Parameters
    ----------
    file
        Descriptor of an open file of `SIZE` bytes.
    """

    SIZE = 8
    """One number, which is written at once: of changes (31 bits), the item (31) and whether it is watched (1)."""

    def __init__(self, file: int) -> None:
        self._memory = memoryview(mmap.mmap(file, self.SIZE)).cast("q")

    def leave(self) -> None:
        """Note that the worker is in no item; changes are counted anew."""
        self._memory[0] = 0

    def enter(self, number: int, *, watched: bool) -> None:
        """Note that it is in an item; `watched` while it is in an operation with a time limit of its own."""
        changes = (self._memory[0] >> 32) % 2**30 + 1
        self._memory[0] = changes << 32 | number << 1 | watched

    def read(self) -> tuple[int, int | None, bool]:
        """How often that was noted, the item, and whether it is watched."""
        noted = self._memory[0]
        return noted >> 32, noted % 2**32 >> 1 if noted else None, bool(noted & 1)


@dataclass(frozen=True)
class Begun:
    """A worker has received its job."""


@dataclass(frozen=True)
class Share:
    """A worker has done this share of its stage."""

    share: float


@dataclass(frozen=True)
class ItemDone:
    """A worker has done an item."""

    number: int
    value: Any


@dataclass(frozen=True)
class BatchDone:
    """A batch is done that does not end its stage."""


@dataclass(frozen=True)
class OutOfMemory:
    """A worker has no memory left, for its work (`failed`) or for another job, and has to be replaced."""

    failed: Failed | None
