"""What a stage is: a pure function of its true inputs, shared by every cell that needs it; what is told of its end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property, lru_cache
from typing import Any

from vibench.errors import NumericalError
from vibench.interfaces.problem import Problem
from vibench.provenance import core_code, libraries
from vibench.qp.status import Status
from vibench.stages.artefacts import History, Store
from vibench.study.cells import Plugin, digest
from vibench.timing import NO_TIME, Seconds


@lru_cache(maxsize=4)
def build_problem(plugin: Plugin) -> Problem:
    """The problem of a stage; one instance per process."""
    problem = plugin.create()
    assert isinstance(problem, Problem)  # `plugins.load` refuses anything else
    return problem


@dataclass(frozen=True)
class Result:
    """What a stage gives: its value, the seconds that count as its own, and histories."""

    value: Any
    seconds: Seconds = NO_TIME
    histories: tuple[History, ...] = ()


@dataclass(frozen=True)
class Done:
    """A stage that went through: its histories, its value if nobody else stores it, and how long it took in all."""

    histories: tuple[History, ...]
    value: Any
    wall: float


@dataclass(frozen=True)
class Failed:
    """A stage, or a piece of one, that did not: the status its rows get, and why."""

    status: Status
    reason: str


@dataclass(frozen=True)
class Unstored:
    """A stage whose result could not be stored, and why: nothing else could be, either."""

    reason: str


class Stage(ABC):
    """One stage; subclasses are frozen dataclasses."""

    @cached_property
    def key(self) -> str:
        """Name of the stage's artefact: its kind, and a hash of all that determines it, code and libraries included."""
        name = type(self).__name__.lower()
        return f"{name}-{digest([name, core_code(), libraries(), asdict(self)])}"  # type: ignore[call-overload]

    def plugins(self) -> Iterator[Plugin]:
        """The plugins that the stage and those it is described by depend on."""
        for part in fields(self):  # type: ignore[arg-type]
            value = getattr(self, part.name)
            if isinstance(value, Plugin):
                yield value
            elif isinstance(value, Stage):
                yield from value.plugins()

    @abstractmethod
    def inputs(self) -> tuple[Stage, ...]:
        """Stages whose artefacts `run` reads."""

    @abstractmethod
    def run(self, store: Store) -> Result:
        """Do the work; inputs are in the store."""


class Pieces(ABC):
    """The work of a piecewise stage, begun: pieces can be done in any order, and by several processes."""

    @abstractmethod
    def piece(self, number: int, watch: Callable[[bool], None]) -> Any:
        """Do one piece; `watch(True)` is called before whatever has a limit of its own, `watch(False)` after it."""

    @abstractmethod
    def lost(self, number: int, failed: Failed) -> Any:
        """What stands in the place of a piece that hung or died."""

    @abstractmethod
    def finish(self, pieces: Sequence[Any]) -> Any:
        """The value of the stage."""


class PiecewiseStage(Stage):
    """A stage whose pieces are kept one by one: a process that dies or hangs costs one piece. It is not stored."""

    @property
    @abstractmethod
    def pieces(self) -> int:
        """How many pieces there are."""

    @abstractmethod
    def begin(self, store: Store) -> Pieces:
        """Do what the pieces have in common; inputs are in the store."""

    def run(self, store: Store) -> Result:
        """All pieces in this process, in their order."""
        work = self.begin(store)
        return Result(work.finish([work.piece(number, lambda _: None) for number in range(self.pieces)]))


def value_of(store: Store, stage: Stage) -> Any:
    """The stored value of a stage that has been run."""
    artefact = store.get(stage.key)
    if artefact is None:
        raise NumericalError(f"the artefact {stage.key} is missing")
    return artefact.value
